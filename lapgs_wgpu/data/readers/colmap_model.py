"""Sparse models of COLMAP on disk, text or binary: cameras, images and points3D.

Source: colmap.github.io/format.html. Binary files are untrusted: a declared count reserves no memory.
"""

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lapgs_wgpu.data.cloud import Array, Cloud
from lapgs_wgpu.data.json_fields import LARGEST_ENTRY, LARGEST_INTRINSIC, LARGEST_SIDE, TINY, number
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import rotation_of
from lapgs_wgpu.errors import InputError, shown

MODELS = (  # by their numbers in binary files
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION",
    "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
PARAMETERS = {  # of those that are read
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
_NUMBERS = re.compile(r"([-+.\deE\s]|nan|inf)*")


class ColmapImage(NamedTuple):
    """name: of the file, below the folder of images. T_cam_world: (4, 4), OpenCV's axes. where: for errors."""

    name: str
    camera: int
    T_cam_world: Array
    where: str


class ColmapModel(NamedTuple):
    """cameras: by id. images: in file order. cloud: with float64 points; None where there are none."""

    cameras: dict[int, Lens]
    images: list[ColmapImage]
    cloud: Cloud | None
    cameras_file: Path
    images_file: Path
    points_file: Path


def is_model(folder: Path) -> bool:
    """Whether a folder holds a sparse model's files."""
    return any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def read_model(folder: Path) -> ColmapModel:
    """The sparse model in a folder; binary files go before text. Raises InputError."""
    binary = (folder / "cameras.bin").is_file()
    files = [folder / f"{name}.{'bin' if binary else 'txt'}" for name in ("cameras", "images", "points3D")]
    cameras_file, images_file, points_file = files
    for path in files:
        if not path.is_file():
            raise InputError(f"{path} does not exist, but {cameras_file} does; copy it, too.")
    try:
        cameras = dict((_binary_cameras if binary else _text_cameras)(cameras_file))
        images = list((_binary_images if binary else _text_images)(images_file))
        rows = list((_binary_points if binary else _text_points)(points_file))
    except OSError as error:
        raise InputError(f"{error.filename or folder} cannot be read ({error.strerror or error}).") from error
    for image in images:
        if image.camera not in cameras:
            raise InputError(f"{image.where} names camera {image.camera}, none of {len(cameras)} in {cameras_file}.")
    points, colors = np.split(np.array(rows, np.float64).reshape(-1, 6), 2, axis=1)
    bad = np.flatnonzero(~(np.abs(points) <= LARGEST_ENTRY).all(axis=1))  # true for NaN, too
    if len(bad):
        raise InputError(f"{points_file}: {len(bad)} of {len(points)} are not finite, first {bad[0]}; remove them.")
    levels = np.clip(np.nan_to_num(colors), 0, 255).astype(np.uint8)
    cloud = Cloud(points, (levels / 255).astype(np.float32)) if len(points) else None
    return ColmapModel(cameras, images, cloud, cameras_file, images_file, points_file)


def _camera(where: str, model: str, width: float, height: float, values: Sequence[float]) -> Lens:
    if model not in PARAMETERS:
        cut = "cut pinhole views out of the panoramas"
        advice = cut if model == "EQUIRECTANGULAR" else "undistort the images with colmap image_undistorter"
        raise InputError(f"{where}: its model {model[:40]} is none that is read ({', '.join(PARAMETERS)}); {advice}.")
    names = PARAMETERS[model]
    if len(values) != len(names):
        raise InputError(f"{where}: a {model} has {len(names)} parameters ({', '.join(names)}), not {len(values)}.")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"{where}: sides must be 1 to {LARGEST_SIDE:g} pixels, got {shown(width)}x{shown(height)}.")
    p = {
        name: number(value, name, where, TINY if name[0] == "f" else -LARGEST_INTRINSIC, LARGEST_INTRINSIC)
        for name, value in zip(names, values, strict=True)
    }
    fx, fy = (p.get("f") or p[name] for name in ("fx", "fy"))
    radial, tangential = (p.get("k1", 0.0), p.get("k2", 0.0), 0.0), (p.get("p1", 0.0), p.get("p2", 0.0))
    return Lens(int(width), int(height), fx, fy, p["cx"], p["cy"], radial=radial, tangential=tangential)


def _image(name: str, camera: int, values: Sequence[float], where: str) -> ColmapImage:
    """values: a quaternion and a translation. Raises InputError."""
    pose = np.array([number(value, "each number of its pose", where) for value in values])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(pose[:4], where), pose[4:]
    return ColmapImage(name, camera, T, where)


# Text


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the place of each line, for errors, and the line; neither comments nor empty ones."""
    try:
        with path.open(encoding="utf-8") as file:
            for at, line in enumerate(file, start=1):
                if line.strip() and not line.startswith("#"):
                    yield f"{path}, line {at}", line.strip()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text ({error.reason}); copy it or export the model again.") from None


def _words(line: str, where: str, fields: str, most: int = -1) -> list[str]:
    """Split a line into words, at least those that `fields` lists. most: after how many it is not split."""
    words, least = line.split(maxsplit=most), fields.count(",") + 1
    if len(words) < least:
        raise InputError(f"{where} has {len(words)} fields, and needs {least}: {fields}.")
    return words


def _numbers(words: list[str], where: str, kind: Callable[[str], Any] = float) -> list[Any]:
    try:
        return [kind(word) for word in words]
    except ValueError as error:
        raise InputError(f"{where}: {str(error)[:80]}; export the model again.") from None


def _text_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    for where, line in _lines(path):
        words = _words(line, where, "id, model, width, height")
        identity, width, height = _numbers([words[0], *words[2:4]], where, int)
        yield identity, _camera(where, words[1], width, height, _numbers(words[4:], where))


def _text_images(path: Path) -> Iterator[ColmapImage]:
    """Each is a line that ends with a name; after it mostly comes one of its points, three numbers each."""
    for where, line in _lines(path):
        if len(line.split()) == 10 or not _NUMBERS.fullmatch(line):
            words = _words(line, where, "id, QW, QX, QY, QZ, TX, TY, TZ, camera, name", most=9)
            (camera,) = _numbers(words[8:9], where, int)
            yield _image(words[9], camera, _numbers(words[1:8], where), f"{where} ({words[9][:80]})")


def _text_points(path: Path) -> Iterator[Sequence[float]]:
    """Rows of X, Y, Z, R, G, B."""
    for where, line in _lines(path):
        yield _numbers(_words(line, where, "id, X, Y, Z, R, G, B, error")[1:7], where)


# Binary: little-endian, each file begins with a count of 8 bytes


class _Bytes:
    """The bytes of a file, taken one after another. Raises InputError where they are too few or too many."""

    def __init__(self, path: Path) -> None:
        self.path, self.at, self.data = path, 0, path.read_bytes()

    def check(self, holds: bool) -> None:
        if not holds:
            raise InputError(
                f"{self.path} has {len(self.data)} bytes and does not end where it should, seen from byte {self.at}; "
                "it is damaged, or of another version: copy it, or export it as text."
            )

    def take(self, size: int) -> bytes:
        self.check(size <= len(self.data) - self.at)
        self.at += size
        return self.data[self.at - size : self.at]

    def values(self, form: str) -> tuple[Any, ...]:
        """Return the next values, by struct's names for their types."""
        return struct.unpack(f"<{form}", self.take(struct.calcsize(f"<{form}")))

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        self.check(end >= 0)
        return self.take(end + 1 - self.at)[:-1].decode("utf-8", "replace")

    def entries(self) -> Iterator[int]:
        """Count the entries, as many as the file declares, and then check that all bytes were taken."""
        yield from range(self.values("Q")[0])
        self.check(self.at == len(self.data))


def _binary_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    file = _Bytes(path)
    for index in file.entries():
        identity, model, width, height = file.values("iiQQ")
        name = MODELS[model] if 0 <= model < len(MODELS) else f"number {model}"
        values = file.values(f"{len(PARAMETERS.get(name, ()))}d")
        yield identity, _camera(f"{path}, camera {index}", name, width, height, values)


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    file = _Bytes(path)
    for index in file.entries():
        _, *pose, camera = file.values("i7di")
        name = file.name()
        file.take(24 * file.values("Q")[0])
        yield _image(name, camera, pose, f"{path}, image {index} ({name[:80]})")


def _binary_points(path: Path) -> Iterator[Sequence[float]]:
    """Rows of X, Y, Z, R, G, B."""
    file = _Bytes(path)
    for _ in file.entries():
        yield file.values("Q3d3Bd")[1:7]
        file.take(8 * file.values("Q")[0])
