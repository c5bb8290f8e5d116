"""A small training: its configuration."""

from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.presets import load_config

STEPS = 36
SMALL: dict[str, str | list[str]] = {
    "schedule.steps": str(STEPS),
    "schedule.warm_up": "10",
    "schedule.sh_interval": "12",
    "points.count": "300",
    "field.width": "16",
    "field.static.levels": "3",
    "field.static.finest": ["16", "16", "16"],
    "field.temporal.levels": "2",
    "density.start": "5",
    "density.interval": "10",
    "density.reset_interval": "25",
    "density.stop": "34",
}


def configure(method: str = "laplacian", **overrides: str) -> Config:
    given = {name.replace("__", "."): value for name, value in overrides.items()}
    return load_config("tiny", {**SMALL, **given}, method=method)
