"""Scenes in the D-NeRF layout: transforms_train.json and transforms_test.json beside 8-bit PNG (or JPEG) pictures.

Everything that can be checked without decoding a picture is checked when the scene is opened, before any training.
"""

from __future__ import annotations

import json
import math
import os
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

# Largest deviation of R^T R from the identity: files hold about seven digits, a scaled or sheared camera is far beyond.
ROTATION_TOLERANCE = 1e-3
LARGEST_ENTRY = (
    1e9  # of a transform_matrix: a camera further away is a mistake, and its matrix products lose all digits
)
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, z backward -> y down, z forward
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
PICTURE_FORMATS = ("PNG", "JPEG")  # no other of Pillow's decoders is handed a file
PICTURE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)  # what Pillow raises
EIGHT_BIT_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA"}


class _Frame(NamedTuple):
    picture: Path
    T_cam_world: NDArray[np.float64]
    time: float


def is_dnerf(folder: str | Path) -> bool:
    """Whether a folder looks like a D-NeRF scene."""
    return any((Path(folder) / f"transforms_{split}.json").is_file() for split in ("train", "test"))


def load_dnerf(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a D-NeRF scene; pictures are decoded later, view by view.

    image_size: longer side in pixels to which pictures are shrunk by averaging; None keeps them as they are.
    The training views come from transforms_train.json alone and the test views from transforms_test.json alone;
    transforms_val.json is not read. Frames without `time` are taken as evenly spaced over the clip.
    Raises InputError, naming file, frame and field, where the scene cannot be trained on as it stands.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {problem}; give the folder that holds transforms_train.json.")
    train_fov, train = _read_split(folder, "train")
    test_fov, test = _read_split(folder, "test")

    first, *others = [frame.picture for frame in train + test]
    stored = _check_picture(first)
    for path in others:
        size = _check_picture(path)
        if size != stored:
            raise InputError(
                f"{path} is {_text(size)} pixels and {first} is {_text(stored)}; all pictures must have one size."
            )
    size = _shrunk(stored, image_size)

    def views(split: str, fov_x: float, frames: list[_Frame]) -> tuple[View, ...]:
        # camera_angle_x is the horizontal field of view, and pixels are square: one focal length serves both axes.
        focal = 0.5 * stored[0] / math.tan(0.5 * fov_x)
        K = np.array([[focal, 0, stored[0] / 2], [0, focal, stored[1] / 2], [0, 0, 1]])
        return tuple(
            View(
                name=f"{split}_{index:03d}",
                camera=Camera(K, frame.T_cam_world, *stored).resized(*size),
                time=frame.time,
                source=str(frame.picture),
                pixels=partial(read_picture, frame.picture, size),
            )
            for index, frame in enumerate(frames)
        )

    return Dataset(folder.resolve().name, views("train", train_fov, train), views("test", test_fov, test))


def read_picture(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Decode an 8-bit picture, shrunk to (width, height).

    Returns (H, W, 4) straight RGBA or, where it has no transparency, (H, W, 3) RGB. Raises InputError.
    """
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as file:
            transparent = "A" in file.getbands() or "transparency" in file.info
            picture = file.convert("RGBA" if transparent else "RGB")
    except PICTURE_ERRORS as error:
        raise InputError(f"{path} cannot be decoded as a picture ({error}); copy or render it again.") from None
    if picture.size != size:
        # Averaging is exact where whole pixels fall together; elsewhere it would shift details: take a smooth filter.
        whole = all(old % new == 0 for old, new in zip(picture.size, size, strict=True))
        # Pillow premultiplies RGBA around the filter: the colour of transparent pixels does not bleed into edges.
        picture = picture.resize(size, Image.Resampling.BOX if whole else Image.Resampling.HAMMING)
    return np.array(picture)


def _read_split(folder: Path, split: str) -> tuple[float, list[_Frame]]:
    """One transforms file: the horizontal field of view in radians, and the frames."""
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise InputError(f"{path} does not exist; a D-NeRF scene needs transforms_train.json and transforms_test.json.")
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{path} is not valid JSON at {place}: {error.msg}.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON text: {error}.") from None
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold a JSON object with camera_angle_x and frames, got {_kind(data)}.")

    fov_x = _number(_field(data, "camera_angle_x", path), "camera_angle_x", path)
    if not 1e-6 < fov_x < math.pi:
        raise InputError(f"{path}: camera_angle_x must be an angle in radians between 0 and pi, got {fov_x:g}.")
    frames = _field(data, "frames", path)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames must be a list of at least one frame, got {_kind(frames)}.")

    timed = sum(isinstance(frame, dict) and "time" in frame for frame in frames)
    parsed = []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        if not isinstance(frame, dict):
            raise InputError(f"{where} must be a JSON object, got {_kind(frame)}.")
        file_path = _field(frame, "file_path", where)
        if not isinstance(file_path, str) or not file_path:
            raise InputError(f"{where}: file_path must be the path of a picture, got {_kind(file_path)}.")
        suffix = "" if file_path.lower().endswith(PICTURE_SUFFIXES) else ".png"
        picture = folder / (file_path + suffix)
        if not os.path.isfile(picture):  # Path.is_file raises where a name is too long
            raise InputError(f"{picture} does not exist, but {where} names it as its file_path.")
        T_cam_world = _world_to_camera(_field(frame, "transform_matrix", where), where)
        if timed == 0:
            time = index / max(len(frames) - 1, 1)
        else:
            hint = f", though {timed} of {len(frames)} frames have it; give it for all frames or for none"
            time = _number(_field(frame, "time", where, hint), "time", where)
            if not 0 <= time <= 1:
                raise InputError(f"{where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        parsed.append(_Frame(picture, T_cam_world, time))
    return fov_x, parsed


def _world_to_camera(value: Any, where: str) -> NDArray[np.float64]:
    """(4, 4) T_cam_world in OpenCV axes from a camera-to-world matrix in OpenGL axes, checked to be a rigid motion."""
    name = f"{where}: transform_matrix"
    rows = value if isinstance(value, list) else []
    if len(rows) != 4 or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(f"{name} must be 4 rows of 4 numbers, got {_kind(value)}.")
    T = np.array([[_number(entry, "transform_matrix", where) for entry in row] for row in rows])
    bad = np.argwhere(~(np.abs(T) <= LARGEST_ENTRY))  # so written, NaN is bad too
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{name} holds {T[row, column]:g} in row {row}, column {column}; "
            f"its entries must be finite and at most {LARGEST_ENTRY:g}."
        )
    if np.abs(T[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        raise InputError(f"{name} must end with the row 0 0 0 1, got {' '.join(f'{x:g}' for x in T[3])}.")
    R, position = T[:3, :3], T[:3, 3]
    lengths = np.linalg.norm(R, axis=0)
    error = np.abs(R.T @ R - np.eye(3)).max()
    if lengths.min() < 1e-6:
        raise InputError(f"{name} has zero scale (an axis of length {lengths.min():g}); its axes must have length 1.")
    if error > ROTATION_TOLERANCE:
        axes = " ".join(f"{x:.4g}" for x in lengths)
        raise InputError(
            f"{name} is not a rotation and a position: R^T R is {error:.3g} away from the identity (at most "
            f"{ROTATION_TOLERANCE:g} is allowed), its axes have lengths {axes}; remove scale and shear."
        )
    if np.linalg.det(R) < 0:
        raise InputError(f"{name} is left-handed (determinant -1, must be 1); flip one of its axes.")
    R = R @ OPENGL_TO_OPENCV[:3, :3]
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = R.T, -R.T @ position
    return T_cam_world


def _check_picture(path: Path) -> tuple[int, int]:
    """(width, height) of a picture that is whole (in a PNG: every chunk and its checksum), without decoding it."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as file:
            size, mode = file.size, file.mode
            file.verify()
    except PICTURE_ERRORS as error:
        reason = "neither PNG nor JPEG" if isinstance(error, Image.UnidentifiedImageError) else error
        raise InputError(f"{path} is not a readable picture ({reason}); copy or render it again.") from None
    if mode not in EIGHT_BIT_MODES:
        raise InputError(f"{path} has pixels of mode {mode}; save it as RGB or RGBA with 8 bits a channel.")
    return size


def _shrunk(stored: tuple[int, int], image_size: int | None) -> tuple[int, int]:
    """(width, height) whose longer side is at most image_size, in the proportions of `stored`."""
    longer = max(stored)
    if image_size is None or image_size >= longer:
        return stored
    width, height = (max(1, math.floor(side * image_size / longer + 0.5)) for side in stored)
    return width, height


def _field(data: dict[str, Any], name: str, where: str | Path, hint: str = "") -> Any:
    if name not in data:
        raise InputError(f"{where} has no field {name}{hint or ', which a D-NeRF scene needs'}.")
    return data[name]


def _number(value: Any, name: str, where: str | Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {name} must be made of numbers, got {_kind(value)}.")
    try:
        return float(value)
    except OverflowError:  # an integer of more than 308 digits
        return math.inf


def _kind(value: Any) -> str:
    """What a JSON value is, in JSON's words and short enough for an error."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
