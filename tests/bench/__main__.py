"""Times the kernels on a fixed scene: `make bench`, or `python tests/bench --help`."""

from __future__ import annotations

# Before torch: it tells torch's threads how to wait, which is read once, when torch is imported.
import lapgs_wgpu  # noqa: F401

# isort: split
import argparse
import dataclasses
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

import torch
from encoder import EncoderReport, bench_encoder
from losses import LossReport, bench_losses
from measure import Timing, Traffic
from raster import RasterReport, bench_raster
from scene import make_scene, save_scene
from shares import bench_shares
from step import StepReport, bench_step

from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.train.presets import load_config
from viewer import bench_viewer, print_viewer


def main() -> None:
    parser = argparse.ArgumentParser(prog="python tests/bench", description=__doc__)
    parser.add_argument("--gaussians", type=int, default=50_000, metavar="N", help="of the scene (default: 50000)")
    parser.add_argument("--size", type=int, default=400, metavar="PIXELS", help="of the square image (default: 400)")
    parser.add_argument("--repeat", type=int, default=15, metavar="R", help="timed runs of each (default: 15)")
    parser.add_argument("--device", metavar="NAME", help="adapter: a part of its name, or its kind")
    parser.add_argument("--no-textures", action="store_true", help="tables in storage buffers on CPU devices, too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to FILE")
    parser.add_argument(
        "--save-scene", type=Path, metavar="FILE", help="write the scene as .npz for other rasterisers, and stop"
    )
    options = parser.parse_args()
    arrays, camera = make_scene(options.gaussians, options.size)
    if options.save_scene:
        save_scene(options.save_scene, arrays, camera)
        return
    device = open_device(options.device)
    device.textures &= not options.no_textures
    machine = describe_machine(device)
    print(*(f"{name}: {value}" for name, value in machine.items()), sep="\n")
    raster = bench_raster(device, arrays, camera, options.repeat)
    print_raster(raster)
    encoder = bench_encoder(device, load_config("dnerf").field, arrays["means"], options.repeat)
    print_encoder(encoder)
    losses = bench_losses(device, options.size, options.repeat)
    print_losses(losses)
    step = bench_step(device, options.repeat)
    print_step(step)
    shares = bench_shares(device, max(1, options.repeat // 2), options.gaussians, options.size)
    print_shares(shares, options.gaussians, options.size)
    viewer = bench_viewer(device, options.repeat)
    for one in viewer:
        print_viewer(one)
    if options.json:
        reports = {
            "raster": dataclasses.asdict(raster),
            "encoder": dataclasses.asdict(encoder),
            "losses": dataclasses.asdict(losses),
            "step": dataclasses.asdict(step),
            "shares": shares,
            "viewer": [dataclasses.asdict(one) for one in viewer],
        }
        options.json.write_text(json.dumps({"machine": machine, **reports}, indent=1) + "\n")


def describe_machine(device: Device) -> dict[str, str | int]:
    """What the times depend on."""
    versions = {package: version(package) for package in ("lapgs-wgpu", "torch", "wgpu", "numpy")}
    return {
        "adapter": device.info.name,
        "kind": device.info.kind,
        "backend": device.info.backend,
        "driver": device.info.driver,
        "subgroup size": device.subgroup_size,
        "tables": "textures" if device.textures else "buffers",
        "processors": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0,
        "torch threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }


def print_row(name: str, time: Timing, note: str = "") -> None:
    print(f"  {name:28}{time.median:9.2f}{time.minimum:9.2f}  {note}".rstrip())


def print_header(title: str) -> None:
    print(f"\n{title}\n  {'':28}{'median':>9}{'min':>9}  milliseconds")


def print_raster(report: RasterReport) -> None:
    print_header(
        f"rasteriser: {report.gaussians:,} Gaussians, {report.size}x{report.size}, "
        f"{report.intersections:,} intersections with tiles"
    )
    for one in report.passes:
        print_row(one.shader, one.milliseconds, f"{one.dispatches} dispatches" if one.dispatches > 1 else "")
    if report.passes:
        total = Timing(
            sum(one.milliseconds.median for one in report.passes),
            sum(one.milliseconds.minimum for one in report.passes),
            report.forward.runs,
        )
        print_row("all passes", total, f"{sum(one.dispatches for one in report.passes)} dispatches")
    else:
        print("  (this adapter has no timestamps: no times of single passes)")
    print_row("forward", report.forward)
    print_row("forward + backward", report.forward_backward)
    print_row("torch: forward", report.torch_forward)
    print_row("torch: forward + backward", report.torch_forward_backward)
    print_traffic("a step through torch", report.torch_traffic)


def print_traffic(title: str, step: Traffic) -> None:
    print(
        f"  {title}: {step.dispatches} dispatches in {step.submissions} submissions, "
        f"{step.uploaded_bytes / 1e6:.2f} MB up, {step.downloaded_bytes / 1e6:.2f} MB down,\n"
        f"  {step.read_backs} read-backs, {step.read_backs_before_sort} of them before the sort"
    )


def print_encoder(report: EncoderReport) -> None:
    print_header(f"hash encoder: {report.points:,} points, {report.levels} levels, {report.entries:,} entries")
    print_row("forward", report.forward)
    print_row("forward + backward", report.forward_backward)
    print_row("torch twin: forward", report.twin_forward)
    print_row("torch twin: both", report.twin_forward_backward)
    ratio = report.twin_forward_backward.median / report.forward_backward.median
    print(f"  {ratio:.1f} times as fast as the twin; gradients differ by {report.largest_difference:.1e} at most")


def print_losses(report: LossReport) -> None:
    print_header(f"image losses, forward + backward: L1, SSIM, pyramid and NCC, {report.size}x{report.size}")
    print_row("kernels", report.kernels)
    print_row("torch twins", report.twins)
    ratio = report.twins.median / report.kernels.median
    print(f"  {ratio:.1f} times as fast as the twins; gradients differ by {report.difference:.1e}")


def print_shares(shares: dict[str, float], gaussians: int, size: int) -> None:
    print(f"\ntraining step, preset dnerf: {gaussians:,} Gaussians, {size}x{size}, everything moving")
    print(f"  {'':46s}{'median':>8s}  milliseconds")
    for name, milliseconds in shares.items():
        print(f"  {name:46s}{milliseconds:8.2f}  {milliseconds / shares['step']:4.0%}")


def print_step(report: StepReport) -> None:
    print_header(
        f"training step, preset tiny, built-in scene: {report.gaussians:,} Gaussians, {report.size}x{report.size}"
    )
    print_row("whole step", report.step, f"{1e3 / report.step.median:.1f} steps/s")
    print_traffic("a step", report.traffic)


if __name__ == "__main__":
    main()
