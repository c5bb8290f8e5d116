"""Ground truth of moving objects that a generated scene stores beside its images (objects.json, masks/, clean/)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import ImageFile, check_image
from lapgs_wgpu.data.json_fields import finite, kind, read_json, required, vector
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

RECORD = "objects.json"
FORMAT = "lapgs-objects 1"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_HINT = "which lists the objects of a generated scene; generate it again, or remove the file"


@dataclass(frozen=True, eq=False)
class ObjectTruth:
    """One moving object in one held-out view.

    centre: (2,) projection of its centre, pixels (column, row). diameter: of its projection, pixels.
    mask: decodes the coverage of each pixel by the object: (H, W) uint8. clean: decodes the view without the object:
    (H, W, 3) RGB or (H, W, 4) straight RGBA, uint8. Both raise InputError.
    """

    name: str
    centre: NDArray[np.float64]
    diameter: float
    mask: Callable[[], NDArray[np.uint8]]
    clean: Callable[[], NDArray[np.uint8]]


class ObjectRecord(NamedTuple):
    """One moving object in one frame. position: (3,) and diameter in the capture's units. mask, clean: image files."""

    name: str
    position: NDArray[np.float64]
    diameter: float
    mask: ImageFile
    clean: ImageFile

    def seen_by(self, camera: Camera) -> ObjectTruth:
        """Project the object to a camera in the capture's coordinates."""
        size = (camera.width, camera.height)
        x, y, z = camera.T_cam_world[:3, :3] @ self.position + camera.T_cam_world[:3, 3]
        z = max(z, 1e-6)
        return ObjectTruth(
            self.name,
            centre=camera.K[:2, :2] @ [x / z, y / z] + camera.K[:2, 2],
            diameter=camera.K[0, 0] * self.diameter / z,
            mask=partial(_read_mask, self.mask, size),
            clean=partial(self.clean.read, size),
        )


def read_objects(folder: Path, split: str, images: Sequence[str]) -> list[list[ObjectRecord]]:
    """Read the moving objects of each image of a split; empty lists if the folder has no objects.json.

    Args:
        folder: of the scene.
        images: file names of the images without suffix, in the order of the split.

    Raises:
        InputError: objects.json is damaged or does not fit the images, or a mask or clean plate is missing or damaged.
    """
    path = folder / RECORD
    if not path.is_file():
        return [[] for _ in images]
    listed = required(read_json(path).values, "objects", path, _HINT)
    if not isinstance(listed, list):
        raise InputError(f"{path}: objects must be a list, got {kind(listed)}.")
    result: list[list[ObjectRecord]] = [[] for _ in images]
    for number, entry in enumerate(listed):
        where = f"{path}, object {number}"
        name, diameter, positions = _object(entry, split, len(images), where)
        if not positions:
            continue
        for image, position, found in zip(images, positions, result, strict=True):
            files = [folder / part / split / f"{image}_{name}.png" for part in ("masks", "clean")]
            for file in files:
                if not file.is_file():
                    raise InputError(f"{file} does not exist, but {where} is to be measured; {_HINT}.")
            found.append(ObjectRecord(name, position, diameter, check_image(files[0]), check_image(files[1])))
    return result


def _object(entry: Any, split: str, count: int, where: str) -> tuple[str, float, list[NDArray[np.float64]]]:
    """Name, diameter and positions in a split of one object, no positions for one that stands still."""
    if not isinstance(entry, dict):
        raise InputError(f"{where} must be a JSON object, got {kind(entry)}.")
    name = required(entry, "name", where, _HINT)
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"{where}: name must be letters, digits, _ and -, got {kind(name)}.")
    if required(entry, "moves", where, _HINT) is not True:
        return name, 0.0, []
    diameter = finite(required(entry, "diameter", where, _HINT), "diameter", where)
    if diameter <= 0:
        raise InputError(f"{where}: diameter must be above 0, got {diameter:g}.")
    positions = required(entry, "positions", where, _HINT)
    positions = required(positions if isinstance(positions, dict) else {}, split, f"{where}, positions", _HINT)
    if not isinstance(positions, list) or len(positions) != count:
        raise InputError(f"{where}: positions.{split} must be a list of {count}, one an image, got {kind(positions)}.")
    return name, diameter, [vector(position, 3, "positions", where) for position in positions]


def _read_mask(file: ImageFile, size: tuple[int, int]) -> NDArray[np.uint8]:
    return file.read(size)[..., 0]
