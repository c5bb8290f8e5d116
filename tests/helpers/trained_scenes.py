"""Scenes of each field with random weights."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig, HashConfig
from lapgs_wgpu.motion.scene import Scene4D

GRID4D = FieldConfig(
    kind="grid4d",
    bound=1.5,
    static=HashConfig(3, (4, 4, 4), (16, 16, 16), table_log2=9),
    temporal=HashConfig(4, (4, 4, 4), (12, 12, 8)),
    width=16,
    components=4,
    dynamics=5,
)
OURS = replace(GRID4D, kind="laplacian", appearance="color+opacity")
# Each with a way of its own through the pass.
CONFIGS: dict[str, FieldConfig] = {
    "grid4d": GRID4D,
    "grid4d without time": replace(GRID4D, temporal_hash=False),
    "laplacian": OURS,
    "color": replace(OURS, appearance="color"),
    "no appearance": replace(OURS, appearance="none"),
    "no dynamics": replace(OURS, dynamics=0),
    "dynamics alone": replace(OURS, temporal_hash=False),
    "neither": replace(OURS, temporal_hash=False, dynamics=0),
    "one channel": replace(OURS, width=1),
    "mirrored scales": replace(OURS, negative_scales="mirror"),
    "lengths in units": replace(OURS, unit=0.3),
    "odd width": replace(OURS, width=43, dynamics=1),
    "odd levels": replace(OURS, static=HashConfig(1, (4, 4, 4)), temporal=HashConfig(1, (4, 4, 4))),
    "sizes of dnerf": replace(
        OURS,
        width=256,
        dynamics=16,
        static=HashConfig(16, (4, 4, 4), (64, 64, 64), table_log2=12),
        temporal=HashConfig(32, (4, 4, 4), (32, 32, 16)),
    ),
}


def trained(device: Device, config: FieldConfig, count: int, seed: int = 0) -> Scene4D:
    """As training might leave it; some Gaussians outside the field's box, one far away and one tiny."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    parameters = {
        "means": 0.8 * normal(count, 3),
        "log_scales": normal(count, 3) * 0.5 - 1.5,
        "quats": 2 * normal(count, 4),
        "opacity_logits": 3 * normal(count),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": 0.2 * normal(count, 15, 3),
        "dynamics": normal(count, config.dynamics_size),
    }
    parameters["means"][3:4] = 50.0
    parameters["log_scales"][5:6] = -30.0
    scene = Scene4D(parameters, config, device, sh_degree=2)
    if scene.field is not None:
        with torch.no_grad():
            for name, parameter in scene.field.named_parameters():
                if name.endswith("table"):
                    parameter.copy_(normal(*parameter.shape))
                elif not name.endswith("frequencies"):
                    parameter.copy_(normal(*parameter.shape) / math.sqrt(max(2, parameter.shape[-1])))
    return scene
