"""Scenes of which a half stands still."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from helpers.playback import open_playback
from helpers.trained_scenes import CONFIGS, GRID4D, OURS, trained

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.playback.playback import DevicePlayback
from lapgs_wgpu.splat.camera import Camera

CAMERA = Camera.looking_at([1.0, -4, 0.7], [0, 0, 0], up=[0, 0, 1], fov_x=0.8, width=64, height=48)
KINDS = {
    "static": FieldConfig(kind="static"),
    "mlp": replace(OURS, kind="mlp"),
    "hexplane": replace(OURS, kind="hexplane"),
    "hidden layers": replace(OURS, depth=1),
    "ablated motion": replace(OURS, motion="mlp"),
} | CONFIGS


def half_still(device: Device, folder: Path) -> DevicePlayback:
    """Of 300 Gaussians those outside the field's box, which ends at 1.5 on each axis, stand still."""
    scene = trained(device, GRID4D, 300)
    with torch.no_grad():
        for parameter in scene.field.heads.parameters():
            parameter *= 0.1
        scene.parameters["log_scales"] -= 1.5
        scene.parameters["means"][100:200] += torch.tensor([4.0, 4, 0])
        scene.parameters["means"][200:] += torch.tensor([-4.0, 4, 0])
    scene.save(folder / "scene.ply")
    playback = open_playback(folder / "scene.ply", device)
    assert isinstance(playback, DevicePlayback)
    return playback
