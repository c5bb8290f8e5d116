"""Cameras without images, by name: calibrations of rigs, and poses that other programs found.

COLMAP's models and nerfstudio's transforms.json are read by their readers. Further formats: Qualisys' .qca.txt (XML; in
1/64 pixels and millimeters, x right, y up), the .toml of Pose2Sim, Anipose and Caliscope (Rodrigues vectors, world to
camera), OpenCV's YAML as EasyMocap (K_1, dist_1, R_1 or Rot_1, T_1) and the example of stereoCalibrate (M1, D1, M2, D2,
R, T) name its matrices, and the .json of CMU Panoptic. All of these count pixels from the middle of the first one.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from lapgs_wgpu.data.images import ImageFile, Size, size_text
from lapgs_wgpu.data.json_fields import LARGEST_INTRINSIC, Fields, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV, Array, check_rotation, opengl_pose, world_to_camera
from lapgs_wgpu.data.readers.colmap_model import is_model, read_model
from lapgs_wgpu.data.readers.transforms import read_lens
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io import safe_json_toml

SAME = 0.01  # by so much the proportions of images may differ from those that a file states
_MATRIX = re.compile(r"^(\w+):\s*!!opencv-matrix\s+rows:.*\s+cols:.*\s+dt:.*\s+data:\s*\[([^\]]*)\]", re.MULTILINE)
_STEREO = {"M1": "K_1", "D1": "dist_1", "M2": "K_2", "D2": "dist_2", "R": "Rot_2", "T": "T_2"}


class Calibrated(NamedTuple):
    """A camera. T_cam_world: (4, 4), OpenCV's axes. sized: whether the file states the size of its images."""

    lens: Lens
    T_cam_world: Array
    where: str
    sized: bool = True

    def lens_for(self, size: Size, of: Size | None = None) -> Lens:
        """The lens for images of `size`, of a film of size `of`. Raises InputError for proportions not the file's."""
        width, height = of or size
        if not self.sized:
            return replace(self.lens, width=width, height=height).resized(*size)
        if abs(math.log(self.lens.width * height / (self.lens.height * width))) > SAME:
            raise InputError(
                f"{self.where} is for images of {size_text((self.lens.width, self.lens.height))} pixels and these have "
                f"{size_text((width, height))}; give them as they were then, neither cut nor turned."
            )
        return self.lens.resized(*size)


Named = tuple[str, Calibrated]


def read_calibration(path: Path) -> dict[str, Calibrated]:
    """Return the cameras of a file, or of the folder of a model, by their names or their images'. Raises InputError."""
    model = next((f for f in (path, path.parent, path / "sparse/0", path / "sparse", path / "0") if is_model(f)), None)
    if model is not None and (path.is_dir() or path.stem in ("cameras", "images")):
        lenses, images, *_ = read_model(model)
        return {image.name: Calibrated(lenses[image.camera], image.T_cam_world, image.where) for image in images}
    inside = [path / "transforms.json", path / "intri.yml"]
    path = next((file for file in inside if file.is_file()), path)
    head = path.read_bytes()[:200].lstrip() if path.is_file() else b""
    formats = (
        (_json, path.suffix == ".json"),
        (_qualisys, head.startswith(b"<")),
        (_toml, path.suffix == ".toml"),
        (_opencv, b"YAML" in head),
    )
    try:
        cameras: dict[str, Calibrated] = next((dict(read(path)) for read, applies in formats if head and applies), {})
    except InputError:
        raise
    except (SyntaxError, TypeError, ValueError) as error:  # of XML, numbers, arrays
        raise InputError(f"{path} cannot be read ({str(error)[:80]}); export it again.") from None
    if not cameras:
        state = "holds no cameras in a known format" if path.exists() else "does not exist"
        raise InputError(
            f"{path} {state}: cameras are read from COLMAP's cameras and images, nerfstudio's transforms.json, "
            ".qca.txt of Qualisys, .toml of Pose2Sim, .yml of OpenCV, .json of Panoptic."
        )
    return cameras


def _json(path: Path) -> Iterator[Named]:
    """Of Panoptic or nerfstudio."""
    data = read_json(path)
    if "cameras" in data:
        for entry in data.objects("cameras", "camera"):
            yield _tabled(entry, str(entry.required("name")), "K", "distCoef", "R", "t", "resolution")
        return
    for entry in data.objects("frames", "frame"):
        name = str(entry.required("file_path"))
        width, height = ((entry if side in entry else data).side(side) for side in "wh")
        lens, _ = read_lens(entry, data, ImageFile(Path(name), (width, height)))
        yield name, Calibrated(lens, opengl_pose(entry.required("transform_matrix"), entry.where), entry.where)


def _toml(path: Path) -> Iterator[Named]:
    for key, value in safe_json_toml.read_toml(path).items():
        if isinstance(value, dict) and "matrix" in value:  # others are metadata
            if value.get("fisheye"):
                raise InputError(f"{path}, {key} has a fisheye lens, which is not read; undistort its film first.")
            entry, name = Fields(value, f"{path}, {key}"), str(value.get("name", key))
            yield _tabled(entry, name, "matrix", "distortions", "rotation", "translation", "size")


def _tabled(entry: Fields, name: str, *fields: str) -> Named:
    """Of fields for K, distortion, rotation, translation and size."""
    K, distortion, rotation, translation, size = (np.array(entry.entries(field), np.float64) for field in fields)
    return name, _camera(K, distortion, rotation, translation, size, f"{entry.where} ({name})")


def _opencv(path: Path) -> Iterator[Named]:
    """Of all matrices in the file, and in those that usually lie beside it."""
    beside = [path.with_name(name) for name in ("intri.yml", "extri.yml", "intrinsics.yml", "extrinsics.yml")]
    files = [path, *(file for file in beside if file.is_file() and path in beside)]
    text = "\n".join(file.read_text(encoding="utf-8", errors="replace") for file in files)
    found = {_STEREO.get(name, name): np.array(data.split(","), np.float64) for name, data in _MATRIX.findall(text)}
    if {"K_1", "Rot_2"} <= found.keys():  # the second camera's pose is that beside the first one
        found = {"Rot_1": np.eye(3).ravel(), "T_1": np.zeros(3)} | found
    for name in [key[2:] for key in found if key.startswith("K_")]:
        rotation, translation = found.get(f"Rot_{name}", found.get(f"R_{name}")), found.get(f"T_{name}")
        if rotation is None or translation is None:
            raise InputError(f"{path} has K_{name}, but no R_{name} and T_{name}, nor have files beside it; add them.")
        distortion = found.get(f"dist_{name}", np.zeros(0))
        K, R = found[f"K_{name}"].reshape(-1, 3), rotation.reshape((3, 3) if rotation.size == 9 else -1)
        yield name, _camera(K, distortion, R, translation, None, f"{path}, camera {name}")


def _qualisys(path: Path) -> Iterator[Named]:
    for i, camera in enumerate(ElementTree.parse(path).iter("camera")):
        name = camera.get("serial", str(i))
        parts = [part for tag in ("transform", "intrinsic", "fov_video") for part in camera.findall(tag)]
        values = Fields({key: value for part in parts for key, value in part.attrib.items()}, f"{path}, camera {name}")
        fx, fy, cx, cy = (values.number(f"{key}{axis}") for key in ("focalLength", "centerPoint") for axis in "UV")
        left, right, top, bottom = (values.number(side) for side in ("left", "right", "top", "bottom"))
        distortion = [values.number(f"{key}Distortion{n}") for key in ("radial", "tangental") for n in (1, 2)]
        R = OPENGL_TO_OPENCV @ [[values.number(f"r{n}{m}") for m in (1, 2, 3)] for n in (1, 2, 3)]
        t = -R @ [values.number(axis) for axis in "xyz"] / 1000
        K = np.array([[fx / 64, 0, cx / 64 - left], [0, fy / 64, cy / 64 - top], [0, 0, 1]])
        yield name, _camera(K, distortion, R, t, (right - left + 1, bottom - top + 1), values.where)


def _camera(
    K: Array, distortion: Iterable[float], rotation: Array, translation: Array, size: Iterable[float] | None, where: str
) -> Calibrated:
    """Check the values of a camera of OpenCV. distortion: k1, k2, p1, p2, k3. rotation: (3, 3), or a Rodrigues vector.
    Raises InputError."""
    from scipy.spatial.transform import Rotation  # slow to import

    values = np.array([*distortion, *[0.0] * 5], np.float64)
    k1, k2, p1, p2, k3 = values[:5]
    width, height = (max(1, round(float(side))) for side in (size if size is not None else 2 * K[:2, 2]))
    finite = all(np.isfinite(each).all() for each in (K, values, rotation, translation))
    if K.shape != (3, 3) or rotation.shape not in ((3,), (3, 3)) or translation.size != 3 or not finite:
        raise InputError(f"{where}: its matrices are not those of a camera (3x3, 3x3 or 3, 3 finite numbers).")
    if values[5:].any():
        raise InputError(f"{where}: distortion beyond k1, k2, p1, p2, k3 is not read; calibrate without it.")
    if not (np.diag(K) > 0).all() or np.abs(K).max() > LARGEST_INTRINSIC:
        raise InputError(f"{where}: focal lengths of {K[0, 0]:g} and {K[1, 1]:g} pixels are those of no camera.")
    R = Rotation.from_rotvec(rotation).as_matrix() if rotation.ndim == 1 else rotation
    check_rotation(R, f"{where}: its rotation")
    cx, cy = K[0, 2] + 0.5, K[1, 2] + 0.5
    lens = Lens(width, height, K[0, 0], K[1, 1], cx, cy, K[0, 1], radial=(k1, k2, k3), tangential=(p1, p2))
    return Calibrated(lens, world_to_camera(R.T, -R.T @ translation.ravel()), where, size is not None)


def match_names(cameras: Iterable[str], names: Sequence[str]) -> dict[str, str]:
    """Return the camera for each of `names` that has one: its name or a part of its path is the same, whatever the
    suffixes, or ends the name after an underscore (hd_00_01 is 00_01)."""
    owner = {PurePosixPath(part).stem.lower(): name for name in [*cameras][::-1] for part in re.split(r"[/\\]", name)}
    found = {}
    for name in names:
        words = PurePosixPath(name).stem.lower().split("_")
        endings = ("_".join(words[i:]) for i in range(len(words)))
        if camera := next((owner[ending] for ending in endings if ending in owner), None):
            found[name] = camera
    return found
