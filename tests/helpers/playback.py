"""Playback of a file."""

import os

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.playback.playback import Playback, playback_of
from lapgs_wgpu.motion.scene_file import read_scene


def open_playback(path: str | os.PathLike[str], device: Device) -> Playback:
    """Of a checkpoint, or of any 3DGS .ply, which becomes a static scene. Raises as `read_scene` and `playback_of`."""
    return playback_of(read_scene(path), device)
