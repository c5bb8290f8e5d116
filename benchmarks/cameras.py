"""Cameras refined while training: python benchmarks/cameras.py [SEED...] prints a Markdown table (docs/data.md).

A still training of 1,500 steps on a rendered walk past a room, 24 images of 100x75: with true poses, and with poses
that are off by 1 degree and 1 % of the cameras' extent, kept and refined. Errors are medians over the cameras. What a
shift, a turn and a scaling of the whole scene explain does not count. Each SEED is a disturbance of its own.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.disturbed_walk import disturbed_walk, pose_errors
from view_alignment import aligned_view

from lapgs_wgpu.discovery.static_fit import static_config
from lapgs_wgpu.gpu.device import open_device
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.trainer import Trainer

SIZE, COUNT, STEPS, START = 100, 24, 1500, 100


def row(name: str, amount: float, seed: int, *, refine: bool) -> str:
    """A line of the table. amount: of the disturbance, degrees and per cent."""
    data, true = disturbed_walk(SIZE, COUNT, amount, amount, seed=seed)
    config = load_config(
        "tiny", {"points.count": 6000, "discovery.steps": STEPS, "data.background": "black", "cameras.start": START}
    )
    rate = dataclasses.replace(config.cameras.rate, steps=STEPS)
    cameras = dataclasses.replace(config.cameras, refine="on" if refine else "off", rate=rate)
    config = static_config(dataclasses.replace(config, cameras=cameras))
    with Trainer(config, data, open_device()) as training:
        for _ in training:
            pass
        given, refinement = data.cameras, training.cameras
        found = given if refinement is None else [refinement.refined(camera) for camera in given]
        turn, shift = (float(np.median(errors)) for errors in pose_errors(found, true))
        psnr, aligned = training.psnr(data.test), ""
        if refine:
            near = [aligned_view(training.scene, view, torch.zeros(3), data.extent) for view in data.test]
            aligned = f"{training.psnr(near):.2f}"
    return f"| {name} | {seed} | {turn:.2f} | {shift:.2f} | {psnr:.2f} | {aligned} |"


def main(seeds: list[int]) -> None:
    print("| poses | seed | turn, degrees | shift, % | test PSNR, dB | aligned, dB |\n|---|---:|---:|---:|---:|---:|")
    print(row("true", 0.0, seeds[0], refine=False), flush=True)
    for seed in seeds:
        print(row("disturbed, kept", 1.0, seed, refine=False), flush=True)
        print(row("disturbed, refined", 1.0, seed, refine=True), flush=True)


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]] or [1])
