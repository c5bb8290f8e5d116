"""Small files of every kind to damage."""

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from helpers.playback import open_playback
from helpers.ply_files import columns_of, ply_bytes, random_still
from helpers.scene_files import scene_of_outliers

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig, HashConfig, PlaneConfig
from lapgs_wgpu.motion.playback.playback import DevicePlayback
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.scene_file import compact_bytes, read_scene
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.presets import load_config

GRID = HashConfig(1, (2, 2, 2), (2, 2, 2), 4)
PLANES = PlaneConfig(features=1, space=2, time=2, levels=1)
KINDS: dict[str, dict[str, Any]] = {
    "static": {},
    "mlp": {},
    "hexplane": {},
    "grid4d": {},
    "laplacian": {},
    "laplacian with hidden layers": {"kind": "laplacian", "depth": 1},
}


def small_scene(kind: str, device: Device) -> Scene4D:
    config = FieldConfig(**{"kind": kind, "static": GRID, "temporal": GRID, "planes": PLANES, "width": 4} | KINDS[kind])
    points = np.random.default_rng(0).uniform(-1, 1, (3, 3))
    return Scene4D.from_points(points, np.full((3, 3), 0.5), np.full(3, 0.1), config, device=device)


def compact_scenes(folder: Path, device: Device) -> list[bytes]:
    """A compact file of each field that such a file can hold, and one with outliers."""
    kinds = ("static", "grid4d", "laplacian")
    files = [compact(small_scene(kind, device), folder / "a.ply", device) for kind in kinds]
    return [*files, compact_bytes(scene_of_outliers(20), None)]


def compact(scene: Scene4D, file: Path, device: Device) -> bytes:
    """The bytes of a scene's compact file. file: its checkpoint, which is written on the way."""
    scene.save(file, {"background": "white"})
    playback = open_playback(file, device)
    assert isinstance(playback, DevicePlayback)
    return compact_bytes(read_scene(file), playback.static_features())


def with_table(checkpoint: bytes, change: Callable[[dict[str, Any]], bytes]) -> bytes:
    """A checkpoint whose safetensors table `change` made anew, with sizes that agree."""
    head, _, body = checkpoint.partition(b"end_header\n")
    size = int(head.rpartition(b"safetensors ")[2].split(b"\n")[0])
    words = -(-size // 4)
    rows, payload = body[: -4 * words], body[-4 * words :][:size]
    length = int.from_bytes(payload[:8], "little")
    text = change(json.loads(payload[8 : 8 + length]))
    new = len(text).to_bytes(8, "little") + text + payload[8 + length :]
    head = head.replace(b"lapgs4d %d\n" % words, b"lapgs4d %d\n" % -(-len(new) // 4))
    head = head.replace(b"safetensors %d\n" % size, b"safetensors %d\n" % len(new))
    return head + b"end_header\n" + rows + new + bytes(-len(new) % 4)


def short_config() -> Config:
    """Of a training of five steps."""
    few = {"points.count": "20", "field.width": "4", "field.static.levels": "1", "field.temporal.levels": "1"}
    few |= {"schedule.warm_up": "0", "schedule.steps": "5"}
    grids = {f"field.{name}.{end}": ["4", "4", "4"] for name in ("static", "temporal") for end in ("base", "finest")}
    return load_config("tiny", {**few, **grids})


def with_checksums(data: bytes) -> bytes:
    """A PNG whose chunks have right checksums, so that the damage gets further in."""
    done, at = data[:8], 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        body = data[at + 4 : at + 8 + length]
        if at + 12 + length > len(data):
            break
        done += data[at : at + 4] + body + zlib.crc32(body).to_bytes(4, "big")
        at += 12 + length
    return done + data[at:]


FOREIGN = [ply_bytes(columns_of(random_still(4, degree))) for degree in (0, 3)] + [
    ply_bytes({name: ("double", values) for name, (_, values) in columns_of(random_still(3, 1)).items()})
]
