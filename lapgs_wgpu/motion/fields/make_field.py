"""Make the deformation field of a configuration."""

from __future__ import annotations

from torch import nn

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Field
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.fields.hexplane_field import HexPlaneField
from lapgs_wgpu.motion.fields.mlp_field import MlpField
from lapgs_wgpu.motion.fields.own_field import OwnField


def make_field(config: FieldConfig, device: Device, seed: int = 0, own: nn.Module | None = None) -> Field | None:
    """Make the field of this configuration; None for static scenes.

    own: the module of the field own, as `check_own` wants it.
    """
    if config.kind == "static":
        return None
    if own is not None:
        return OwnField(own)
    if config.kind == "mlp":
        return MlpField(config, seed)
    if config.kind == "hexplane":
        return HexPlaneField(config, seed)
    return GridField(config, device, seed)


def check_own(config: FieldConfig, own: nn.Module | None) -> None:
    """Raises InputError where the field is own and no module is given, or the other way round."""
    if (config.kind == "own") != (own is not None):
        raise InputError(
            "the field own needs a module, which only Python can give, such as Trainer(config, parts=Parts(field=...)) "
            "and load(path, field=...); docs/api.md says more."
            if own is None
            else f"the scene has the field {config.kind}, so no module can be given; leave out field=..."
        )
