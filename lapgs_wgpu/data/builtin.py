"""Names of the built-in scenes on the command line and in tables: `synthetic` and `motion:KEY=VALUE,...`.

motion:path=4,cycles=2,camera=walk,background=room,objects=two has the keys of MotionScene; those left out have its
defaults, so `motion` alone is a scene, too.
"""

from __future__ import annotations

import dataclasses
import difflib
from pathlib import Path
from typing import get_args

from lapgs_wgpu.data import motion_writer, synthetic
from lapgs_wgpu.data.motion_scenes import Backdrop, CameraMotion, MotionScene, ObjectSet
from lapgs_wgpu.errors import InputError

SYNTHETIC, MOTION = "synthetic", "motion"
_CHOICES = {"camera": get_args(CameraMotion), "background": get_args(Backdrop), "objects": get_args(ObjectSet)}
_KEYS = tuple(field.name for field in dataclasses.fields(MotionScene))


def is_builtin(name: str) -> bool:
    """Whether a name on the command line is that of a built-in scene rather than a folder."""
    return name in (SYNTHETIC, MOTION) or name.startswith(f"{MOTION}:")


def builtin_folder(name: str) -> str:
    """Name of the folder that a built-in scene is written to, such as motion-path4-cycles2-jump-black-two.

    Raises InputError where the name has an unknown key or value."""
    if name == SYNTHETIC:
        return SYNTHETIC
    scene = parse_motion(name)
    return f"motion-path{scene.path:g}-cycles{scene.cycles:g}-{scene.camera}-{scene.background}-{scene.objects}"


def write_builtin(name: str, parent: Path) -> Path:
    """Write a built-in scene into its folder in `parent`, unless it is there. Returns the folder. Raises InputError."""
    folder = parent / builtin_folder(name)
    if name == SYNTHETIC:
        return synthetic.write_synthetic(folder)
    return motion_writer.write_motion(folder, parse_motion(name))


def parse_motion(name: str) -> MotionScene:
    """The scene that motion:KEY=VALUE,... names. Raises InputError."""
    _, _, text = name.partition(":")
    values: dict[str, str | float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        key, equals, value = part.partition("=")
        if key not in _KEYS:
            raise InputError(f"{name}: a motion scene has no key {key!r}{_similar(key, _KEYS)}")
        if not equals or not value:
            raise InputError(f"{name}: {key} needs a value, as in {key}={getattr(MotionScene(), key)}.")
        if key in values:
            raise InputError(f"{name}: {key} is given twice.")
        if key in _CHOICES:
            if value not in _CHOICES[key]:
                raise InputError(f"{name}: there is no {key} {value!r}{_similar(value, _CHOICES[key])}")
            values[key] = value
        else:
            try:
                values[key] = float(value)
            except ValueError:
                raise InputError(f"{name}: {key} must be a number, got {value!r}.") from None
    return MotionScene(**values)  # type: ignore[arg-type]


def _similar(name: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else f"; known: {', '.join(known)}."
