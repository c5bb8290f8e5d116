"""Moving scenes in files of others, played: .ply sequences, Spacetime Gaussians (.ply, .splatv), .4dgs, OpenUSD."""

import json
import struct
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.data.stamps import natural_key
from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.io.ply import GaussianSnapshot, vertex_of
from lapgs_wgpu.io.ply_elements import Floats, open_ply
from lapgs_wgpu.io.safe_json_toml import parse_json, read_json
from lapgs_wgpu.motion.playback.playback import activate, opacity_logits
from lapgs_wgpu.motion.scene_file import SceneFile, read_scene
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.gaussians import Gaussians, switched
from lapgs_wgpu.splat.linear_light import display_harmonics
from lapgs_wgpu.viewer.options import USD

MANIFEST = "sequence.json"
SH_RANGE = 4.0  # of .4dgs: a coefficient is a byte from -this to +this (section 6.5 of the specification)
USD_KIND = "ParticleField3DGaussianSplat"
USD_DEGREE, USD_HARMONICS = "radiance:sphericalHarmonicsDegree", "radiance:sphericalHarmonicsCoefficients"
AXES = ("x", "y", "z", "-x", "-y", "-z")  # as .4dgs numbers them
_POLYNOMIAL = [
    "x", "y", "z", *(f"motion_{i}" for i in range(9)), *(f"rot_{i}" for i in range(4)),
    *(f"omega_{i}" for i in range(4)), *(f"scale_{i}" for i in range(3)), "opacity", *(f"f_dc_{i}" for i in range(3)),
    "trbf_center", "trbf_scale",
]  # fmt: skip


class MovingFile(NamedTuple):
    """sample: Gaussians at a time in [0, 1], activated, in every call as many; those that are absent have an opacity of
    0. frames: of the clip, None where the file does not say. metadata: as a checkpoint's, with `fps` where known."""

    sample: Callable[[float], Gaussians[Floats]]
    frames: int | None
    metadata: dict[str, str]


class SampledPlayback:
    """The Playback of a moving file. antialiased: how Gaussians are drawn, None for what the file says."""

    moves = True

    def __init__(self, device: Device, file: MovingFile, antialiased: bool | None = None) -> None:
        self.device, self.metadata = device, file.metadata
        self._sample, self._pool, self._antialiased = file.sample, BufferPool(device), antialiased
        self._time: float | None = None
        self.count = len(file.sample(0.0))

    def at(self, t: float) -> Gaussians[DeviceArray]:
        if self._time != t:
            now = self._sample(t)
            arrays = {name: self._pool.upload(name, values) for name, values in now.arrays().items()}
            antialiased = switched(now.antialiased, self._antialiased)
            self._now, self._time = Gaussians(**arrays, antialiased=antialiased), t
        return self._now

    def snapshot(self, t: float) -> GaussianSnapshot:
        now = self._sample(t)
        return GaussianSnapshot(now.means, now.sh, opacity_logits(now.opacities), np.log(now.scales), now.quats)


def open_moving(path: Path) -> MovingFile | None:
    """Open a moving file of others; None where it is none. Raises InputError where it is damaged or needs a package."""
    if path.is_dir() and not (path / "checkpoint.ply").exists():
        files = sorted(path.glob("*.ply"), key=lambda file: natural_key(file.name))
        return read_frames(files, {}) if files else None
    readers = {".json": read_sequence, ".ply": read_spacetime_ply, ".splatv": read_splatv, ".4dgs": read_4dgs}
    reader = (readers | dict.fromkeys(USD, read_usd)).get(path.suffix.lower())
    return reader(path) if reader else None


def read_sequence(path: Path) -> MovingFile:
    """Read the manifest of a sequence (docs/pipelines.md). Raises InputError."""
    manifest = read_json(path)
    files = manifest.get("frames") if isinstance(manifest, dict) else None
    if not (
        isinstance(files, list) and files and all(isinstance(name, str) and Path(name).name == name for name in files)
    ):
        raise InputError(f"{path}: its `frames` are not names of .ply files beside it.")
    names, fps = ("fps", "up", "view"), manifest.get("fps", 30)
    if not (isinstance(fps, int | float) and 0 < fps < 1e4):
        raise InputError(f"{path}: its `fps` is {str(fps)[:40]!r}, not a number above 0 and below 10000.")
    return read_frames([path.parent / name for name in files], {n: str(manifest[n]) for n in names if n in manifest})


def read_frames(files: list[Path], metadata: dict[str, str]) -> MovingFile:
    """A still a frame; between two frames the nearest is shown."""
    counts = []
    for file in files:
        with open_ply(file) as ply:
            counts.append(vertex_of(ply).count)
    first = read_scene(files[0])
    start = _offset(first)

    @lru_cache(maxsize=4)
    def frame(number: int) -> Gaussians[Floats]:
        file = read_scene(files[number])
        now, rows = activate(file.gaussians, first.sh_degree), np.arange(max(counts))
        present = rows < len(now["means"])
        names = ("means", "quats", "scales", "opacities", "sh")
        means, quats, scales, opacities, sh = (now[name][rows * present] for name in names)
        means += (_offset(file) - start).astype(np.float32)
        return Gaussians(means, quats, scales, opacities * present, sh, antialiased=file.antialiased)

    metadata = {name: text for name, text in first.metadata.items() if name == "up"} | metadata
    return MovingFile(lambda t: frame(round(t * (len(files) - 1))), len(files), metadata)


def _offset(file: SceneFile) -> NDArray[np.float64]:
    return np.array(json.loads(file.metadata.get("offset", "[0, 0, 0]")), np.float64)


def read_spacetime_ply(path: Path) -> MovingFile | None:
    """Spacetime Gaussians (arXiv 2312.16812): a cubic of time a mean, a line a quaternion, a bell an opacity."""
    with open_ply(path) as ply:
        vertex = ply.elements.get("vertex")
        if vertex is None or not set(_POLYNOMIAL) <= vertex.properties.keys():
            return None
        values = ply.columns(vertex, _POLYNOMIAL)
    moving, scales, opacities, colors, center, width = np.split(values, [20, 23, 24, 27, 28], axis=1)
    if "f_dc_3" in vertex.properties:  # features: the first three are the color that the network adds to
        note = "its colors come from a network beside it; shown are those that it adds to."
        print(f"note: {path}: {note}", file=sys.stderr)
        colors = _sigmoid(colors)
    return _polynomial(path, [moving, np.exp(scales), _sigmoid(opacities), colors, center, np.exp(width)], {})


def read_splatv(path: Path) -> MovingFile:
    """The same in halves and bytes, 64 of them a Gaussian, behind a list of parts in JSON (antimatter15/splaTV)."""
    data = path.read_bytes()
    magic, length = struct.unpack("<II", data[:8].ljust(8, b"\0"))
    if magic != 0x674B or 8 + length > len(data):
        raise InputError(f"{path}: begins with {data[:4]!r} and has {len(data)} bytes; it is no whole .splatv.")
    parts, begin = parse_json(data[8 : 8 + length].decode(errors="replace"), str(path)), 8 + length
    try:
        sizes = [int(part["size"]) for part in parts]
        number = [part["type"] for part in parts].index("splat")
        words = np.frombuffer(data, "<u4", sizes[number] // 4, begin + sum(sizes[:number])).reshape(-1, 16)
        cameras = parts[number].get("cameras")
        view = {"view": _view(cameras[0]).to_json()} if cameras else {}
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: its parts cannot be read ({type(error).__name__}: {error}).") from None
    words = words[words[:, 7] >> 24 > 0]  # rows that pad the texture are invisible
    halves = words.view("<f2").astype(np.float32)
    rgba = (words[:, 7:8].copy().view(np.uint8) / 255).astype(np.float32)
    motion, quats, omega, scales = halves[:, 16:25], halves[:, 6:10], halves[:, 26:30], halves[:, 10:13]
    columns = [words[:, :3].copy().view("<f4"), motion, quats, omega, scales, rgba[:, 3], rgba[:, :3], halves[:, 30:]]
    return _polynomial(path, columns, view)


def _view(camera: dict[str, Any]) -> InitialView:
    """Where a viewer begins: a camera as in Inria's cameras.json, whose rotation is from camera to world."""
    R, position = np.array(camera["rotation"], float), np.array(camera["position"], float)
    fx, fy, width, height = (float(camera[name]) for name in ("fx", "fy", "width", "height"))
    K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
    start = Camera(K, world_to_camera(R, position), int(width), int(height))
    return InitialView(start, position + 4 * R[:, 2], -R[:, 1], 150)


def _polynomial(path: Path, columns: list[Floats], metadata: dict[str, str]) -> MovingFile:
    """columns: of the values of _POLYNOMIAL, activated. Motion is by powers of the time since the bell's center."""
    values = np.column_stack(columns)
    bad = int((~np.isfinite(values).all(axis=1)).sum())
    if bad or not len(values):
        raise InputError(f"{path}: {bad} of its {len(values)} visible Gaussians hold NaN or infinity; export it again.")
    parts = np.split(values, [3, 12, 16, 20, 23, 24, 27, 28], axis=1)
    means, motion, quats, omega, scales, opacities, colors, center, width = parts
    sh = ((colors - np.float32(0.5)) / np.float32(CONSTANTS["SH_C0"]))[:, None]
    scales = np.maximum(scales, np.float32(1e-7))

    def sample(t: float) -> Gaussians[Floats]:
        since = np.float32(t) - center
        powers = np.concatenate([since, since**2, since**3], axis=1)
        moved = means + np.einsum("np,npc->nc", powers, motion.reshape(-1, 3, 3))
        fade = np.exp(-((since / np.maximum(width, np.float32(1e-6))) ** 2))
        return Gaussians(moved, quats + since * omega, scales, (opacities * fade)[:, 0], sh)

    return MovingFile(sample, None, metadata)


def read_4dgs(path: Path) -> MovingFile:
    """Read straight pieces of motion by the format's library. Raises InputError."""
    fourdgs = optional_module("fourdgs", "reading .4dgs needs fourdgs", "export")
    data = path.read_bytes()
    try:
        scene = fourdgs.read(data)
    except (fourdgs.FourdgsError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read as .4dgs ({str(error)[:200]}).") from None
    g, seconds = scene.gaussians, scene.duration_sec
    if not len(g.positions):
        raise InputError(f"{path}: holds 0 Gaussians; at least 1 is needed")
    light = g.colors[:, None, :3] / CONSTANTS["SH_C0"]  # harmonics (N, K, 3) of linear light, without offset
    if g.sh_degree:
        others = g.sh.reshape(len(light), 3, -1).transpose(0, 2, 1) * (2 * SH_RANGE / 255) - SH_RANGE
        light = np.concatenate([light, others], axis=1)
    sh = display_harmonics(light).astype(np.float32)
    quats, scales = np.roll(g.rotations, 1, axis=1).astype(np.float32), g.scales.astype(np.float32)  # xyzw to wxyz

    def sample(t: float) -> Gaussians[Floats]:
        now = g.state_at(min(t, 1 - 1e-6) * seconds)  # at the very end its last pieces are gone
        means, opacities = g.positions.astype(np.float32), np.zeros(len(quats), np.float32)
        means[now["indices"]], opacities[now["indices"]] = now["centers"], now["opacity"]
        return Gaussians(means, quats, scales, opacities, sh)

    metadata = {"fps": "30"}
    if scene.provenance.frames and 0 <= scene.provenance.frames[0].up_axis < 6:
        metadata["up"] = AXES[scene.provenance.frames[0].up_axis]
    return MovingFile(sample, max(2, round(30 * seconds) + 1), metadata)


def read_usd(path: Path) -> MovingFile:
    """Read the first Gaussian splat of a stage, in its own coordinates. Raises InputError."""
    pxr = load_pxr()
    try:
        stage = pxr.Usd.Stage.Open(str(path))
    except pxr.Tf.ErrorException as error:
        raise InputError(f"{path}: usd-core cannot open it ({str(error).splitlines()[0][:200]}).") from None
    prim = next((prim for prim in stage.Traverse() if prim.GetTypeName() == USD_KIND), None)
    if prim is None:
        raise InputError(f"{path}: holds no prim of the type {USD_KIND} (OpenUSD 26.03); other splats are not read.")
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    degree = int(prim.GetAttribute(USD_DEGREE).Get() or 0)

    def get(name: str, code: float) -> Floats:
        stored = (prim.GetAttribute(each).Get(code) for each in (name, f"{name}h"))  # h: in half precision
        return np.array(next((values for values in stored if values is not None), []), np.float32)

    count = len(get("positions", start))
    shapes = {"positions": (count, 3), "orientations": (count, 4), "scales": (count, 3), "opacities": (count,)}
    shapes[USD_HARMONICS] = (count * (degree + 1) ** 2, 3)

    def sample(t: float, stage: Any = stage) -> Gaussians[Floats]:  # without its stage a prim is empty
        found = {name: get(name, start + t * (end - start)) for name in shapes}
        for name, shape in shapes.items():
            if found[name].shape != shape or not count or not np.isfinite(found[name]).all():
                raise InputError(f"{path}: {name} has shape {found[name].shape}, not finite {shape}.")
        means, quats, scales, opacities, sh = found.values()
        return Gaussians(means, np.roll(quats, 1, axis=1), scales, opacities, sh.reshape(count, -1, 3))

    data = dict(stage.GetRootLayer().customLayerData)
    metadata = {"fps": str(stage.GetTimeCodesPerSecond())} | {k: str(v) for k, v in data.items() if k == "view"}
    return MovingFile(sample, max(1, round(end - start) + 1), metadata)


def load_pxr() -> Any:
    """Import usd-core. Raises InputError where it is missing."""
    for name in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdUtils", "UsdVol", "Vt"):
        optional_module(f"pxr.{name}", "OpenUSD files need usd-core", "usd")
    return optional_module("pxr", "OpenUSD files need usd-core", "usd")


def _sigmoid(values: Floats) -> Floats:
    return (0.5 + 0.5 * np.tanh(0.5 * values)).astype(np.float32)
