"""Sparse models of COLMAP on disk, text or binary: cameras, images and points3D.

The formats are those of COLMAP's documentation (colmap.github.io/format.html). Binary files are untrusted: every
declared count is compared with the file size before anything is read.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError, shown

Array = NDArray[np.float64]

# Number in binary files -> name, and the names of the parameters. Of these, those that are read.
MODELS: dict[int, tuple[str, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
}
OTHER_MODELS = {
    5: "OPENCV_FISHEYE", 6: "FULL_OPENCV", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE",
}  # fmt: skip
PARAMETERS = dict(MODELS.values())
LONGEST_NAME = 4096  # bytes of an image's name

UNSUPPORTED = (
    "is not among those that are read ({known}); run COLMAP again with --ImageReader.camera_model OPENCV, or "
    "undistort the images with colmap image_undistorter"
)


class ColmapCamera(NamedTuple):
    """width, height in pixels; parameters by COLMAP's names for them (MODELS)."""

    width: int
    height: int
    parameters: dict[str, float]


class ColmapImage(NamedTuple):
    """A registered image. name: of its file, relative to the folder of images. quaternion: (4,) wxyz and
    translation: (3,) from world to camera, OpenCV's axes. where: file and entry, for errors."""

    name: str
    camera: int
    quaternion: Array
    translation: Array
    where: str


class ColmapModel(NamedTuple):
    """cameras: by id. images: in file order. points: (N, 3), colors: (N, 3) uint8. points_file: their file."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: Array
    colors: NDArray[np.uint8]
    points_file: Path


def is_model(folder: Path) -> bool:
    """Whether a folder holds a sparse model's files."""
    return any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def read_model(folder: Path) -> ColmapModel:
    """The sparse model in a folder; binary files go before text. Raises InputError."""
    binary = (folder / "cameras.bin").is_file()
    suffix = "bin" if binary else "txt"
    files = {name: folder / f"{name}.{suffix}" for name in ("cameras", "images", "points3D")}
    for path in files.values():
        if not path.is_file():
            raise InputError(f"{path} does not exist, but {files['cameras']} does; a sparse model needs both.")
    cameras = (_binary_cameras if binary else _text_cameras)(files["cameras"])
    images = (_binary_images if binary else _text_images)(files["images"])
    points, colors = (_binary_points if binary else _text_points)(files["points3D"])
    for image in images:
        if image.camera not in cameras:
            raise InputError(
                f"{image.where} was taken by camera {image.camera}, which is not among the {len(cameras)} of "
                f"{files['cameras']}."
            )
    return ColmapModel(cameras, images, points, colors, files["points3D"])


def count_images(folder: Path) -> int:
    """Count the images of a model, without reading all of a binary one."""
    path = folder / "images.bin"
    if path.is_file():
        with _binary(path) as reader:
            return reader.count(BINARY_IMAGE_BYTES, "images")
    path = folder / "images.txt"
    return len(_text_images(path)) if path.is_file() else 0


def _camera(where: str, model: str, width: float, height: float, values: list[float]) -> ColmapCamera:
    if model not in PARAMETERS:
        raise InputError(f"{where}: its model {model[:40]} {UNSUPPORTED.format(known=', '.join(PARAMETERS))}.")
    names = PARAMETERS[model]
    if len(values) != len(names):
        raise InputError(
            f"{where}: a {model} has {len(names)} parameters ({', '.join(names)}), but there are {len(values)}."
        )
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5):
        raise InputError(f"{where}: width and height must be 1 to 100000 pixels, got {shown(width)}x{shown(height)}.")
    parameters = dict(zip(names, values, strict=True))
    for name, value in parameters.items():
        if not abs(value) <= 1e6 or (name[0] == "f" and value <= 0):  # true for NaN, too
            bounds = "above 0 and at most" if name[0] == "f" else "at most"
            raise InputError(f"{where}: {name} must be {bounds} 1e+06, got {value:g}.")
    return ColmapCamera(int(width), int(height), parameters)


# Text


def _lines(path: Path, *, blank: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Yield the place of each line, for errors, and its words; skip comments and, unless `blank`, empty lines."""
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                if not line.startswith("#") and (blank or line.strip()):
                    yield f"{path}, line {number}", line.split()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text ({error.reason}); copy it or export the model again.") from None


def _numbers(words: list[str], where: str, kind: Callable[[str], Any]) -> list[Any]:
    for word in words:
        try:
            kind(word)
        except ValueError:
            what = "a whole number" if kind is int else "a number"
            raise InputError(f"{where}: {word[:40]!r} is not {what}; export the model again.") from None
    return [kind(word) for word in words]


def _text_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for where, words in _lines(path):
        if len(words) < 4:
            raise InputError(f"{where} has {len(words)} fields; id, model, width, height and parameters are needed.")
        identity, width, height = _numbers([words[0], *words[2:4]], where, int)
        cameras[identity] = _camera(where, words[1], width, height, _numbers(words[4:], where, float))
    return cameras


def _text_images(path: Path) -> list[ColmapImage]:
    """Two lines per image: pose and name, then its points, which may be none."""
    images = []
    lines = _lines(path, blank=True)
    for where, words in lines:
        if not words:
            continue
        if len(words) < 10:
            raise InputError(f"{where} has {len(words)} fields; 10 are needed, the last one the image's name.")
        _, camera = _numbers([words[0], words[8]], where, int)
        pose = np.array(_numbers(words[1:8], where, float))
        images.append(_image(" ".join(words[9:]), camera, pose, f"{where} ({' '.join(words[9:])[:80]})"))
        next(lines, None)
    return images


def _text_points(path: Path) -> tuple[Array, NDArray[np.uint8]]:
    rows = []
    for where, words in _lines(path):
        if len(words) < 8:
            raise InputError(f"{where} has {len(words)} fields; id, X, Y, Z, R, G, B and error are needed.")
        rows.append(_numbers(words[1:7], where, float))
    values = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return values[:, :3], np.clip(np.nan_to_num(values[:, 3:]), 0, 255).astype(np.uint8)


def _image(name: str, camera: int, pose: Array, where: str) -> ColmapImage:
    """pose: (7,) quaternion and translation."""
    if not (np.abs(pose) <= 1e9).all():
        raise InputError(f"{where}: its pose holds {pose[~(np.abs(pose) <= 1e9)][0]:g}; at most 1e+09 is allowed.")
    length = float(np.linalg.norm(pose[:4]))
    if abs(length - 1) > 1e-3:
        raise InputError(f"{where}: its quaternion has length {length:g}, must be 1; export the model again.")
    return ColmapImage(name, camera, pose[:4] / length, pose[4:], where)


# Binary: little-endian, each file begins with a count of 8 bytes

BINARY_CAMERA_BYTES = 24 + 3 * 8  # at least: id, model, width, height, parameters
BINARY_IMAGE_BYTES = 4 + 7 * 8 + 4 + 1 + 8  # at least: id, pose, camera, the name's end, count of points
BINARY_POINT_BYTES = 8 + 3 * 8 + 3 + 8 + 8  # at least: id, position, color, error, length of the track


class _Reader:
    """A binary file in memory, and the position up to which it was read."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.data, self.at = path, data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        """The next values, by struct's names for their kinds."""
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.data, self.at - size)

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise InputError(
                f"{self.path} ends too early: {size} bytes are needed at byte {self.at}, but it has {len(self.data)} "
                "in all; copy it again."
            )
        self.at += size

    def count(self, least: int, what: str) -> int:
        """Read a count of items that take at least so many bytes each."""
        (count,) = self.take("Q")
        room = len(self.data) - self.at
        if count * least > room:
            raise InputError(
                f"{self.path} declares {count} {what}, which need at least {count * least} bytes, but {room} bytes "
                "follow; it is damaged, so copy it again."
            )
        return int(count)

    def end(self) -> None:
        """Check that all bytes were read."""
        if self.at < len(self.data):
            raise InputError(
                f"{self.path} declares {self.at} bytes, but has {len(self.data)}; it is damaged, so copy it again."
            )

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise InputError(
                f"{self.path}: the name at byte {self.at} has no end within {LONGEST_NAME} bytes; it is damaged, so "
                "copy it again."
            )
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text


@contextmanager
def _binary(path: Path) -> Iterator[_Reader]:
    try:
        yield _Reader(path, path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None


def _binary_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    with _binary(path) as reader:
        for index in range(reader.count(BINARY_CAMERA_BYTES, "cameras")):
            identity, model, width, height = reader.take("iiQQ")
            where = f"{path}, camera {index}"
            name, names = MODELS.get(model, (OTHER_MODELS.get(model, f"number {model}"), ()))
            cameras[identity] = _camera(where, name, width, height, list(reader.take(f"{len(names)}d")))
        reader.end()
    return cameras


def _binary_images(path: Path) -> list[ColmapImage]:
    images = []
    with _binary(path) as reader:
        for index in range(reader.count(BINARY_IMAGE_BYTES, "images")):
            _, *pose, camera = reader.take("i7di")
            name = reader.name()
            where = f"{path}, image {index} ({name[:80]})"
            reader.skip(24 * reader.count(24, f"points of {name[:80]}"))
            images.append(_image(name, camera, np.array(pose), where))
        reader.end()
    return images


def _binary_points(path: Path) -> tuple[Array, NDArray[np.uint8]]:
    with _binary(path) as reader:
        count = reader.count(BINARY_POINT_BYTES, "points")
        points, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
        for index in range(count):
            _, *values, _ = reader.take("Q3d3Bd")
            points[index], colors[index] = values[:3], values[3:]
            reader.skip(8 * reader.count(8, f"images that see point {index}"))
        reader.end()
    return points, colors
