"""Grid fields with random weights."""

import torch
from torch import Tensor, nn

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig, HashConfig, PlaneConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.scene import make_field

OURS = FieldConfig(
    kind="laplacian",
    bound=1.5,
    static=HashConfig(3, (4, 4, 4), (16, 16, 16), table_log2=9),
    temporal=HashConfig(4, (4, 4, 4), (12, 12, 8)),
    planes=PlaneConfig(features=4, space=6, time=8, levels=2),
    width=16,
    components=4,
    dynamics=5,
)
COUNT = 40
POINTS = torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(0)) * 2.4 - 1.2
DYNAMICS = torch.randn(COUNT, 5, generator=torch.Generator().manual_seed(2))
ROWS = torch.tensor([3, 3, 17, 30])
NEARBY = Nearby(ROWS, torch.full((4, 3), 0.02), 0.32, static_weight=0.7, temporal_weight=0.2)


def stirred(field: nn.Module) -> nn.Module:
    """With weights as training might leave them."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            if not name.endswith("frequencies"):
                parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.3)
    return field


def made(device: Device, config: FieldConfig) -> Field:
    field = make_field(config, device, seed=0)
    assert field is not None
    return field


def grid_field(device: Device, config: FieldConfig = OURS) -> GridField:
    field = stirred(made(device, config))
    assert isinstance(field, GridField)
    return field


def parts(move: Deformation) -> list[Tensor]:
    return [part for part in move if part is not None]
