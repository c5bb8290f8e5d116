"""Fields of every kind, and a camera that sees the scenes of trained_scenes."""

from dataclasses import replace

from helpers.trained_scenes import CONFIGS, OURS

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
