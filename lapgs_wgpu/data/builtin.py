"""Names of the built-in scenes on the command line and in tables: `synthetic`, `motion`, `motion:KEY=VALUE,...`.

The keys are those of MotionScene, with its defaults: motion:path=4,cycles=2,camera=walk,background=room,objects=two.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lapgs_wgpu.data import motion_writer, synthetic
from lapgs_wgpu.data.motion_scenes import MotionScene
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.dataclass_table import build_dataclass, field_types, from_text

SYNTHETIC, MOTION = "synthetic", "motion"


def is_builtin(name: str) -> bool:
    """Whether a name is that of a built-in scene, rather than a folder."""
    return name in (SYNTHETIC, MOTION) or name.startswith(f"{MOTION}:")


def builtin_folder(name: str) -> str:
    """Name of the folder of a built-in scene, such as motion-path4-cycles2-jump-black-two. Raises InputError."""
    if name == SYNTHETIC:
        return SYNTHETIC
    scene = parse_motion(name)
    return f"motion-path{scene.path:g}-cycles{scene.cycles:g}-{scene.camera}-{scene.background}-{scene.objects}"


def write_builtin(name: str, parent: Path) -> Path:
    """Write a built-in scene to its folder in `parent`, unless it exists. Returns the folder. Raises InputError."""
    folder = parent / builtin_folder(name)
    if name == SYNTHETIC:
        return synthetic.write_synthetic(folder)
    return motion_writer.write_motion(folder, parse_motion(name))


def parse_motion(name: str) -> MotionScene:
    """The scene that motion:KEY=VALUE,... names. Raises InputError."""
    types, values = field_types(MotionScene), dict[str, Any]()
    for part in filter(None, map(str.strip, name.partition(":")[2].split(","))):
        key, _, value = part.partition("=")
        if key in values:
            raise InputError(f"{name}: {key} is given twice.")
        values[key] = from_text(value, types.get(key))
    return build_dataclass(MotionScene, values, name)
