"""An opened file: its scene, ready to be shown, and where a viewer begins."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu import data
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.io.safe_json_toml import read_toml
from lapgs_wgpu.motion.playback.playback import Playback, playback_of
from lapgs_wgpu.motion.scene_file import SceneFile, read_scene
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.gaussians import switched
from lapgs_wgpu.viewer.camera import ViewCamera, orbit_views
from lapgs_wgpu.viewer.clock import Clock
from lapgs_wgpu.viewer.moving_files import MANIFEST, SampledPlayback, open_moving
from lapgs_wgpu.viewer.render_modes import AHEAD, BACKGROUNDS


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedScene:
    """path: where it came from; of a training under way, its checkpoint. initial_view: camera, focus, up and frames to
    begin with. file: its content, None for a training, and for moving files of others."""

    path: Path
    playback: Playback
    initial_view: InitialView
    file: SceneFile | None = None

    def camera(self) -> ViewCamera:
        """Make a camera where the viewer begins."""
        return ViewCamera(self.initial_view.camera, self.initial_view.focus, self.initial_view.up)

    def around(self, count: int, time: float | None) -> Iterator[tuple[Camera, float]]:
        """Cameras around the focus, in the size of the captured images; time as of `orbit_views`."""
        captured = self.initial_view.camera
        return orbit_views(self.camera(), (captured.width, captured.height), count, time, self.initial_view.arc)

    def clock(self) -> Clock:
        """Make the clock of the clip, at its start."""
        fps = float(self.playback.metadata.get("fps", 30))
        return Clock(self.initial_view.frames if self.playback.moves else 1, fps=fps)

    @cached_property
    def views(self) -> tuple[data.View, ...]:
        """The views of the capture that the config.toml beside a checkpoint names, those held out first; none where the
        scene is of no run, or the capture is not here."""
        try:
            given = read_toml(self.path.parent / "config.toml")["data"]
            dataset = data.load_dataset(
                Path(given["path"]),
                image_size=int(given["size"]) or None,
                undistort=bool(given.get("undistort", True)),
                movers=given.get("movers") or None,  # which tell where the scene lies
            )
        except (OSError, ValueError, KeyError, TypeError, OverflowError):  # InputError is a ValueError
            return ()
        return (*dataset.test, *dataset.train)

    def view_number(self, wanted: str) -> int:
        """The number in `views` of the one with this name or number. Raises InputError."""
        names = [view.name for view in self.views]
        if wanted not in names and wanted not in map(str, range(len(names))):
            config = self.path.parent / "config.toml"
            raise InputError(f"--view {wanted}: is none of the {len(names)} views of a capture that {config} names.")
        return names.index(wanted) if wanted in names else int(wanted)

    @property
    def background(self) -> tuple[float, float, float]:
        """The background of the training; black where it is not known."""
        return BACKGROUNDS.get(self.playback.metadata.get("background", ""), BACKGROUNDS["black"])


def load_scene(
    path: Path, device: Callable[[], Device], *, up: str | None = None, antialiased: bool | None = None
) -> LoadedScene:
    """Open a checkpoint, a compact scene, any 3DGS .ply, or a moving file of others. Raises InputError.

    path: file, or a folder: of frames, of a sequence, or of one .ply, which is opened.
    device: is asked for when the file has been read. up: axis of AHEAD that points up, antialiased: how the Gaussians
    are drawn; both otherwise as the file says.
    """
    playback: Playback
    stills = list(path.glob("*.ply"))  # none where it is a file
    if (path / MANIFEST).is_file():
        path = path / MANIFEST
    elif len(stills) == 1:
        path = stills[0]
    moving, file = open_moving(path), None
    if moving is not None:
        playback, frames = SampledPlayback(device(), moving, antialiased), moving.frames
    else:
        file = read_scene(path)
        file = dataclasses.replace(file, antialiased=switched(file.antialiased, antialiased))
        playback, frames = playback_of(file, device()), None
    stored = InitialView.from_json(playback.metadata.get("view", ""))
    view = stored if stored and up is None else guess_view(playback, up or playback.metadata.get("up"))
    return LoadedScene(path, playback, view._replace(frames=frames or (stored or view).frames), file)


def given_scene(given: Any, device: Callable[[], Device]) -> LoadedScene:
    """Open the file as the options of lapgs-view say. Raises InputError, also where a mode has nothing to show."""
    antialiased = {"yes": True, "no": False}.get(given.antialiased)
    scene = load_scene(Path(given.file), device, up=given.up, antialiased=antialiased)
    if given.mode == "motion" and not scene.playback.moves:
        raise InputError(f"{scene.path}: does not move; --mode motion shows nothing.")
    return scene


def guess_view(playback: Playback, axis: str | None = None) -> InitialView:
    """Guess a view of files that name no camera: the middle of the Gaussians, from where most of them are seen.

    axis: of AHEAD, up. Where it is not known, up is -y, as in scenes whose poses come from COLMAP; z where the
    Gaussians lie flat in x and y.
    """
    means = playback.at(0.0).means.read().astype(np.float64)
    if not len(means):
        means = np.zeros((1, 3))
    middle = np.median(means, axis=0)
    radius = max(float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)), 1e-3)
    extent = np.subtract(*np.quantile(means, [0.9, 0.1], axis=0))
    if axis not in AHEAD:
        axis = "z" if extent[2] < 0.5 * min(extent[0], extent[1]) else "-y"
    up, ahead = direction(axis), direction(AHEAD[axis])
    elevation = math.radians(35)  # above the middle
    away = math.sin(elevation) * up - math.cos(elevation) * ahead
    camera = Camera.looking_at(middle + 3.6 * radius * away, middle, up=up.tolist(), fov_x=0.9, width=640, height=480)
    return InitialView(camera, middle, up, frames=150)


def direction(axis: str) -> NDArray[np.float64]:
    """Return the unit vector (3,) of an axis, such as "x" or "-y"."""
    vector = np.zeros(3)
    vector["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return vector


def nearest_axis(vector: NDArray[np.floating]) -> str:
    """Return the name of the axis, such as "x" or "-y", that is nearest to a vector (3,)."""
    largest = int(np.abs(vector).argmax())
    return "-" * bool(vector[largest] < 0) + "xyz"[largest]
