"""The capture that a run was trained on: cameras and times to stand at."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.safe_json_toml import read_toml
from lapgs_wgpu.viewer.loaded_scene import LoadedScene

if TYPE_CHECKING:
    from lapgs_wgpu.data import View


def capture_views(scene: LoadedScene) -> tuple[View, ...]:
    """The views of the capture that the config.toml beside a checkpoint names, those held out first; none where the
    scene is of no run, or the capture is not here."""
    from lapgs_wgpu.data import load_dataset  # not before the first picture

    try:
        data = read_toml(scene.path.parent / "config.toml")["data"]
        dataset = load_dataset(
            Path(data["path"]),
            image_size=int(data["size"]) or None,
            undistort=bool(data.get("undistort", True)),
            movers=data.get("movers") or None,  # which tell where the scene lies
        )
    except (OSError, ValueError, KeyError, TypeError, OverflowError):  # InputError is a ValueError
        return ()
    return (*dataset.test, *dataset.train)


def find_view(scene: LoadedScene, wanted: str) -> View:
    """The view of the capture with this name, or number in the order of `capture_views`. Raises InputError."""
    views = capture_views(scene)
    if not views:
        raise InputError(f"--view {wanted}: beside {scene.path} is no config.toml that names a capture which is here.")
    by_name = {str(number): view for number, view in enumerate(views)} | {view.name: view for view in views}
    if wanted not in by_name:
        raise InputError(f"--view {wanted}: views are 0 to {len(views) - 1}, {views[0].name} to {views[-1].name}.")
    return by_name[wanted]
