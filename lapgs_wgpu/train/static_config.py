"""The configuration of a static fit: a short training without motion, with which motion discovery begins."""

from __future__ import annotations

import dataclasses

from lapgs_wgpu.train.config import Config, Rate

# The schedule, in shares of its steps, and the rates are its own: what the static fit is sure of decides what is found.
DENSIFY = (0.375, 0.875)
DENSITY_INTERVAL, CONTRIBUTION_INTERVAL = 0.125, 0.3125
SH_INTERVAL = 0.375
REFINE = 0.125  # from when on cameras move, at the latest
GRADIENT = 5e-4  # density.gradient
LOG_SCALES, QUATS, SH_DC, SH_REST = 5e-3, 1e-3, 2.5e-3, 1.25e-4  # learning rates, those of 3DGS


def static_config(config: Config) -> Config:
    """The configuration of the static fit for a training."""
    steps = config.discovery.steps
    return dataclasses.replace(
        config,
        field=dataclasses.replace(config.field, kind="static"),
        schedule=dataclasses.replace(
            config.schedule, steps=steps, warm_up=steps, sh_interval=max(1, round(SH_INTERVAL * steps))
        ),
        rates=dataclasses.replace(
            config.rates,
            means=Rate(config.rates.means.start, config.rates.means.end, steps),
            log_scales=LOG_SCALES,
            quats=QUATS,
            sh_dc=SH_DC,
            sh_rest=SH_REST,
        ),
        density=dataclasses.replace(
            config.density,
            start=round(DENSIFY[0] * steps),
            stop=round(DENSIFY[1] * steps),
            interval=max(1, round(DENSITY_INTERVAL * steps)),
            contribution_interval=max(1, round(CONTRIBUTION_INTERVAL * steps)),
            reset_interval=steps,
            gradient=GRADIENT,
            split="plain",
        ),
        cameras=dataclasses.replace(
            config.cameras,
            rate=dataclasses.replace(config.cameras.rate, steps=steps),
            start=min(config.cameras.start, max(1, round(REFINE * steps))),
        ),
        loss=dataclasses.replace(config.loss, pyramid=0.0, ncc=0.0, dynamics=0.0),
        smoothness=dataclasses.replace(config.smoothness, share=0.0),
        acceleration=dataclasses.replace(config.acceleration, weight=0.0),
        step_place="auto",
    )
