"""Pictures of one's own, each with its camera, lens and time, made into a dataset: what the readers of COLMAP's models
and of nerfstudio's files share."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.data.cloud import Cloud, check_cloud, points_in_view
from lapgs_wgpu.data.lens import LARGEST_ZOOM, Lens, read_straight
from lapgs_wgpu.data.moments import Picture, natural
from lapgs_wgpu.data.pictures import check_pictures, check_proportions, shrunk
from lapgs_wgpu.data.poses import check_focal, fitting
from lapgs_wgpu.data.sanity import check_film, check_views
from lapgs_wgpu.data.views import Dataset, View, focus_of
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

PROBES = 4096  # points that decide where a capture without a cloud is put
DENSE = 4096  # points; a cloud of fewer is filled up: Gaussians multiply too slowly to fill what it leaves empty
NEAREST, FURTHEST = 0.25, 2.0  # of the cameras' distance from what all look at: depths, where there is no cloud


class Shot(NamedTuple):
    """A picture of a capture, as its files describe it.

    path: of the file. picture: its name, and who took it. camera: where, at the size that the files say; K is that of
    the lens. Pictures of a camera that stands still share it. lens: at the same size. where: what errors call the
    description of camera and lens.
    """

    path: Path
    picture: Picture
    camera: Camera
    lens: Lens
    where: str


def dataset_of(
    folder: Path,
    shots: Sequence[Shot],
    times: Sequence[float],
    tested: set[int],
    cloud: Cloud | None,
    *,
    cloud_file: Path,
    image_size: int | None,
    axes: str,
    warnings: Sequence[str],
    time_source: str,
) -> Dataset:
    """The dataset of these shots, moved and scaled into the cube that the presets expect (`poses.fitting`).

    times: of the shots, in [0, 1]. tested: which shots are held out. cloud: in the cameras' coordinates; cloud_file:
    what errors call it. axes: advice for cameras that look the wrong way. time_source: field and file of the times.
    Raises InputError.
    """
    for shot in shots:
        check_focal(shot.camera, shot.where)
    trained = [i for i in range(len(shots)) if i not in tested]
    if not trained:
        raise InputError(f"{folder}: all {len(shots)} pictures are held out for testing; none is left to train on.")
    stored = check_pictures([shot.path for shot in shots])
    size = shrunk(stored, image_size)
    straight = _Straight(stored)
    cameras = [straight.camera(shot) for shot in shots]
    training = list({id(cameras[i]): cameras[i] for i in trained}.values())

    found = list(warnings)
    depths = None
    if cloud is not None:
        found += check_views(cloud, cameras, [shot.picture.name for shot in shots], cloud_file, axes)
        check_cloud(cloud, training, cloud_file)
        fit = fitting(cloud.points.astype(np.float64))
        cloud = _filled(cloud, training)
    else:
        near, far = _depths(training, cloud_file, axes)
        fit = fitting(points_in_view(training, near, far, PROBES, 0))
        depths = near * fit.scale, far * fit.scale
    films: dict[str, list[int]] = {}
    for i in sorted(range(len(shots)), key=lambda i: (times[i], natural(shots[i].picture.name))):
        films.setdefault(shots[i].picture.camera, []).append(i)
    for film in films.values():
        found += check_film([shots[i].path for i in film])

    placed = {id(camera): fit.camera(camera).resized(*size) for camera in cameras}

    def views(split: str, chosen: Sequence[int]) -> tuple[View, ...]:
        return tuple(
            View(
                name=f"{split}_{index:05d}",
                camera=placed[id(cameras[i])],
                time=times[i],
                source=str(shots[i].path),
                pixels=partial(read_straight, shots[i].path, straight.lens(shots[i]), cameras[i].K, stored, size),
            )
            for index, i in enumerate(chosen)
        )

    ordered = [i for camera in sorted(films, key=natural) for i in films[camera]]
    return Dataset(
        folder.resolve().name,
        views("train", [i for i in ordered if i not in tested]),
        views("test", [i for i in ordered if i in tested]),
        cloud=None if cloud is None else cloud.moved(fit),
        depths=depths,
        placement=fit,
        time_source=time_source,
        warnings=tuple(found),
    )


class _Straight:
    """The pinhole cameras of pictures of the size `stored`; a lens that pictures share is straightened out once."""

    def __init__(self, stored: tuple[int, int]) -> None:
        self._stored = stored
        self._lenses: dict[int, Lens] = {}
        self._cameras: dict[tuple[int, int], Camera] = {}

    def lens(self, shot: Shot) -> Lens:
        """The shot's lens at the size of the pictures."""
        return self._lenses[id(shot.lens)]

    def camera(self, shot: Shot) -> Camera:
        """The same one for all shots that share camera and lens."""
        key = id(shot.camera), id(shot.lens)
        if key not in self._cameras:
            taken = shot.camera.width, shot.camera.height
            check_proportions(self._stored, taken, shot.path, shot.where)
            if id(shot.lens) not in self._lenses:
                resize = np.diag([self._stored[0] / taken[0], self._stored[1] / taken[1], 1.0])
                self._lenses[id(shot.lens)] = Lens(resize @ shot.lens.K, shot.lens.radial, shot.lens.tangential)
            K = self._lenses[id(shot.lens)].pinhole(*self._stored)
            if K is None:
                bend = ", ".join(f"{value:.3g}" for value in (*shot.lens.radial, *shot.lens.tangential))
                raise InputError(
                    f"{shot.where}: its distortion ({bend}) bends the picture so much that enlarging it "
                    f"{LARGEST_ZOOM:g} times leaves gaps; check it."
                )
            self._cameras[key] = Camera(K, shot.camera.T_cam_world, *self._stored)
        return self._cameras[key]


def _filled(cloud: Cloud, cameras: Sequence[Camera]) -> Cloud:
    """The cloud, and DENSE points in all, those that it lacks at random where views overlap, between the depths of its
    own; each has the colour of the nearest of its own."""
    from scipy.spatial import cKDTree  # slow to import

    missing = DENSE - len(cloud.points)
    if missing <= 0:
        return cloud
    points = cloud.points.astype(np.float64)
    depths = np.concatenate([points @ c.T_cam_world[2, :3] + c.T_cam_world[2, 3] for c in cameras])
    near, far = np.percentile(depths[depths > 0], [1, 99])
    added = points_in_view(cameras, float(near), float(far) * 1.01, missing, 0)
    _, nearest = cKDTree(points).query(added)
    return Cloud(
        np.concatenate([cloud.points, added.astype(np.float32)]),
        np.concatenate([cloud.colours, cloud.colours[nearest]]),
    )


def _depths(cameras: Sequence[Camera], where: Path, axes: str) -> tuple[float, float]:
    """Nearest and furthest depth for cameras without a cloud, from the point that all look at. Raises InputError."""
    focus = focus_of(cameras)
    depth = np.array([(camera.T_cam_world @ [*focus, 1.0])[2] for camera in cameras])
    behind = int((depth <= 0).sum())
    if 2 * behind > len(cameras):
        raise InputError(
            f"{where}: there is no cloud, and {behind} of {len(cameras)} cameras look away from the point nearest to "
            f"all lines of sight: {axes}, or give a cloud."
        )
    return NEAREST * float(depth[depth > 0].min()), FURTHEST * float(depth.max())
