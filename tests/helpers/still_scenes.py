"""Scenes of which a half stands still."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from helpers.trained_scenes import CONFIGS, GRID4D, OURS, trained

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.splat.camera import Camera

CAMERA = Camera.looking_at([1.0, -4, 0.7], [0, 0, 0], up=[0, 0, 1], fov_x=0.8, width=64, height=48)
KINDS = {
    "static": FieldConfig(kind="static"),
    "mlp": replace(OURS, kind="mlp"),
    "hexplane": replace(OURS, kind="hexplane"),
    "hidden layers": replace(OURS, depth=1),
    "ablated motion": replace(OURS, motion="mlp"),
} | CONFIGS


def saved_scene(device: Device, folder: Path) -> None:
    """Save a moving scene of 300 Gaussians as scene.ply."""
    trained(device, GRID4D, 300).save(folder / "scene.ply")
