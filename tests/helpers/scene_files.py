"""A moving scene and its checkpoint; a still one with outliers."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.checkpoint import read_checkpoint, write_checkpoint
from lapgs_wgpu.motion.fields.config import FieldConfig, HashConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.scene_file import SceneFile

CONFIG = FieldConfig(
    bound=1.5,
    static=HashConfig(2, (4, 4, 4), (8, 8, 8)),
    temporal=HashConfig(2, (4, 4, 4), (8, 8, 6)),
    width=8,
)


def moving_scene(device: Device, config: FieldConfig = CONFIG, sh_degree: int = 2, count: int = 60) -> Scene4D:
    """With everything as training might leave it."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    parameters = {
        "means": 0.4 * normal(count, 3),
        "log_scales": normal(count, 3) * 0.5 - 2.5,
        "quats": 2 * normal(count, 4),
        "opacity_logits": normal(count),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": 0.2 * normal(count, 15, 3),
        "dynamics": normal(count, config.dynamics_size),
    }
    scene = Scene4D(parameters, config, device, sh_degree=sh_degree)
    if scene.field is not None:
        with torch.no_grad():
            for parameter in scene.field.parameters():
                parameter.copy_(0.3 * normal(*parameter.shape))
    return scene


def scene_of_outliers(count: int, *, outliers: bool = True) -> SceneFile:
    """A still cloud of `count` Gaussians, the first four overexposed, and six beside it, far away and huge: of these
    two, else the first two of all, are too faint to be seen."""
    rng = np.random.default_rng(0)
    n = count + 6
    gaussians = {
        "means": rng.uniform(-1, 1, (n, 3)),
        "log_scales": rng.uniform(-4.5, -3, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "opacity_logits": rng.normal(size=n).clip(-3, 3),
        "sh_dc": rng.uniform(-1.5, 1.5, (n, 1, 3)),
        "sh_rest": np.zeros((n, 15, 3)),
    }
    if outliers:
        gaussians["means"][count:] = [
            [3e3, 2e2, 10],
            [-1e6, 5, 0],
            [0, -6e3, 0],
            [0, 9, 5e3],
            [7e3, 0, 0],
            [0, 0, -8e3],
        ]
        gaussians["log_scales"][count:] = 6
        gaussians["opacity_logits"][count:] = [80, 80, -80, 80, -80, 5]
        gaussians["sh_dc"][:4] *= 50
    else:
        gaussians["opacity_logits"][[0, 1]] = -80
    arrays = {name: values.astype(np.float32) for name, values in gaussians.items()}
    return SceneFile("outliers.ply", FieldConfig(kind="static"), 0, arrays, {}, {})


def rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, str]], object]) -> None:
    """The file again, with its tensors and metadata changed."""
    still, tensors, metadata = read_checkpoint(path)
    change(tensors, metadata)
    write_checkpoint(path, still, tensors, metadata)


def with_field(**changes: object) -> Callable[[dict[str, Any], dict[str, str]], object]:
    def change(_: dict[str, Any], metadata: dict[str, str]) -> None:
        metadata["field"] = json.dumps(json.loads(metadata["field"]) | changes)

    return change


def with_grid(**changes: object) -> Callable[[dict[str, Any], dict[str, str]], object]:
    def change(_: dict[str, Any], metadata: dict[str, str]) -> None:
        values = json.loads(metadata["field"])
        metadata["field"] = json.dumps(values | {"temporal": values["temporal"] | changes})

    return change


DAMAGE: dict[str, tuple[Callable[[dict[str, Any], dict[str, str]], object], str]] = {
    "no field": (lambda _, m: m.pop("field"), "description of its field"),
    "no degree": (lambda _, m: m.pop("sh_degree"), "description of its field"),
    "not JSON": (lambda _, m: m.update(field="{"), "description of its field"),
    "degree 4": (lambda _, m: m.update(sh_degree="4"), "sh_degree 4 is outside 0 to 3"),
    "antialiased by half": (
        lambda _, m: m.update(antialiased="half"),
        "antialiased must be true, false or a number, got 'half'",
    ),
    "timing that is not JSON": (lambda _, m: m.update(timing="{"), "its timing: cannot be read as JSON"),
    "times alone": (lambda _, m: m.update(timing='{"times": [0]}'), "timing is no table of times and moments"),
    "time that goes back": (
        lambda _, m: m.update(timing='{"times": [0, 1], "moments": [0.5, 0.4]}'),
        "never descend",
    ),
    "unknown kind": (with_field(kind="quantum"), "kind must be static or .*, got 'quantum'"),
    "unknown key": (with_field(color="red"), "description of its field"),
    "width 0": (with_field(width=0), "width must be at least 1 and at most 4096, got 0"),
    "true for a width": (with_field(width=True), "description of its field"),
    "NaN time": (with_field(time_scale=math.nan), "time_scale must lie between 0 and .*, got nan"),
    "time beyond its axis": (with_field(time_scale=50.0), "time_scale must be above 0 and at most 1, got 50"),
    "bound 0": (with_field(bound=0), "bound must be above 0"),
    "absurd levels": (with_grid(levels=10**6), "levels must be at least 1 and at most 64"),
    "absurd table": (with_grid(table_log2=60), "table_log2 must be at least 1 and at most 24, got 60"),
    "absurd resolution": (with_grid(finest=[10**6, 8, 8]), "finest must be at least 2 and at most 65536, got 1e\\+06"),
    "absurd planes": (
        with_field(planes={"features": 10**6, "space": 8, "time": 8, "levels": 1}),
        "features must be at least 1 and at most 256",
    ),
    "no dynamics": (with_field(dynamics=-1), "dynamics must lie between 0 and .*, got -1"),
    "hash in words": (with_field(temporal_hash="yes"), "temporal_hash must be true or false"),
    "other levels": (with_grid(levels=3), "has shape"),
    "other width": (with_field(width=9), "has shape"),
    "a tensor missing": (lambda t, _: t.pop("gaussians.quats"), "no tensor 'gaussians.quats'"),
    "a dynamics row missing": (
        lambda t, _: t.update({"gaussians.dynamics": t["gaussians.dynamics"][1:]}),
        r"gaussians.dynamics' has shape \(59, 16\)",
    ),
    "a row missing": (lambda t, _: t.update({"gaussians.means": t["gaussians.means"][1:]}), r"has shape \(59, 3\)"),
}
