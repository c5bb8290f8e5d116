"""Times the kernels on a fixed scene: `make bench`, or `python benchmarks --help`."""

# Before torch: it tells torch's threads how to wait, which is read once, when torch is imported.
import lapgs_wgpu  # noqa: F401

# isort: split
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # helpers: the references in torch

# isort: split
import argparse
import dataclasses
import json
import os
import platform
from importlib.metadata import version
from typing import Any

import torch
from ceilings import describe
from encoder import EncoderReport, bench_encoder
from host import CASES, HostReport, bench_host, null_device
from losses import LossReport, bench_losses
from measure import Timing, Traffic
from passes import Meter, PassTimes
from raster import RasterReport, bench_raster
from scene import FIXED_SET, SceneSize, TrainedScene, parse_scene, save_scene
from shares import bench_shares
from step import StepReport, bench_step

from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.splat.raster_config import subgroup_size
from lapgs_wgpu.train.presets import load_config
from viewer import bench_viewer, print_viewer

PARTS = ("raster", "encoder", "losses", "step", "shares", "host", "steps", "viewer")


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python benchmarks", description=__doc__)
    parser.add_argument(
        "--scenes",
        type=parse_scene,
        nargs="+",
        default=FIXED_SET,
        metavar="SCENE@WxH",
        help="what is drawn: a ball of so many Gaussians, or the checkpoint.ply of a training, and the size of the "
        "image; the first one also decides the sizes in encoder, losses and shares; the viewer "
        "shows checkpoints instead of its own balls, if there are any "
        f"[{_names(FIXED_SET)}]",
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help=f"what is timed [{' '.join(PARTS)}]")
    parser.add_argument(
        "--preset",
        default="dnerf",
        help="configuration of the field in encoder, and of the step in shares [dnerf]",
    )
    parser.add_argument("--repeat", type=int, default=15, metavar="R", help="timed runs of each [15]")
    parser.add_argument("--device", metavar="NAME", help="adapter: a part of its name, or its kind")
    parser.add_argument("--no-textures", action="store_true", help="tables in storage buffers on CPU devices, too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to FILE")
    parser.add_argument(
        "--save-scene", type=Path, metavar="FILE", help="write the first scene as .npz for other rasterizers, and stop"
    )
    return parser


def main() -> None:
    parser = options()
    given = parser.parse_args()
    if given.save_scene:
        save_scene(given.save_scene, *given.scenes[0].make())
    else:
        run(given, parser)


def run(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Time the chosen parts, print what was found as it comes, and write it as JSON."""
    device = open_device(options.device)
    device.textures &= not options.no_textures
    machine = describe_machine(device)
    print(*(f"{name}: {value}" for name, value in machine.items()), sep="\n")
    meter = None
    if "timestamp-query" in device.features:
        meter = Meter(device)
    first, repeat = options.scenes[0], options.repeat
    results: dict[str, Any] = {"machine": machine}
    if "raster" in options.parts:
        results["raster"] = {}
        for scene in options.scenes:
            arrays, camera = scene.make()
            raster = bench_raster(device, arrays, camera, meter, repeat)
            print_raster(str(scene), raster)
            results["raster"][str(scene)] = raster
    if "encoder" in options.parts:
        means = first.make()[0]["means"]
        results["encoder"] = bench_encoder(device, load_config(options.preset).field, means, meter, repeat)
        print_encoder(results["encoder"])
    if "losses" in options.parts:
        results["losses"] = bench_losses(device, first.height, meter, repeat)
        print_losses(results["losses"])
    if "step" in options.parts:
        results["step"] = bench_step(device, repeat)
        print_step(results["step"])
    if "shares" in options.parts:
        steps = max(1, repeat // 2)
        results["shares"] = bench_shares(device, options.preset, steps, first.gaussians, first.height)
        print_shares(results["shares"], first, options.preset)
    for part in ("host", "steps"):
        if part in options.parts:
            results[part] = {}
            for preset in CASES:
                null = part == "host"
                report = bench_host(null_device() if null else device, preset, 2 * repeat, null=null)
                print_host(report, preset, null=null)
                results[part][preset] = report
    if "viewer" in options.parts:
        trained = [scene for scene in options.scenes if isinstance(scene, TrainedScene)]
        results["viewer"] = bench_viewer(device, repeat, trained=trained)
        for name, one in results["viewer"].items():
            print_viewer(name, one)
    machine["load afterwards"] = _load()
    if options.json:
        options.json.write_text(json.dumps(results, indent=1, default=dataclasses.asdict) + "\n", encoding="utf-8")


def _names(scenes: list[SceneSize]) -> str:
    return " ".join(map(str, scenes))


def _load() -> str:
    """How many threads wanted a processor in the last minute."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def describe_machine(device: Device) -> dict[str, str | int]:
    """What the times depend on."""
    versions = {package: version(package) for package in ("lapgs-wgpu", "torch", "wgpu", "numpy")}
    return {
        "adapter": device.info.name,
        "kind": device.info.kind,
        "backend": device.info.backend,
        "driver": device.info.driver,
        "subgroup size": subgroup_size(device),
        "tables": "textures" if device.textures else "buffers",
        "processors": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0,
        "torch threads": torch.get_num_threads(),
        "processor": _processor(),
        "load before": _load(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }


def _processor() -> str:
    """Its name, where the system says it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def print_row(name: str, time: Timing, note: str = "") -> None:
    print(f"  {name:28}{time.median:9.2f}{time.minimum:9.2f}  {note}".rstrip())


def print_header(title: str) -> None:
    print(f"\n{title}\n  {'':28}{'median':>9}{'min':>9}  milliseconds")


def print_passes(report: PassTimes | None) -> None:
    """A row a shader: its time, the least that the ceilings allow, and the share of that in the time."""
    if report is None:
        print("  (this adapter has no timestamps: no times of single passes)")
        return
    print(f"  ceilings: {describe(report.ceilings)}")
    for shader, one in report.passes.items():
        dispatches = f"{one.dispatches} dispatches" if one.dispatches > 1 else ""
        share = "" if one.share is None else f"{one.ceiling:9.2f} at the ceiling {one.share:5.0%}  "
        print_row(shader, one.milliseconds, share + dispatches)
    total = sum(one.milliseconds.median for one in report.passes.values())
    print(f"  {'all passes':28}{total:9.2f}{'':9}  {sum(one.dispatches for one in report.passes.values())} dispatches")


def print_raster(name: str, report: RasterReport) -> None:
    counts = report.counts
    print_header(
        f"rasterizer, {name}: {counts.visible:,} splats visible, {counts.intersections:,} intersections with tiles, "
        f"{counts.drawn:,} of them drawn"
    )
    print_passes(report.passes)
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
    print_passes(report.passes)
    print_row("forward", report.forward)
    print_row("forward + backward", report.forward_backward)
    print_row("torch reference: forward", report.reference_forward)
    print_row("torch reference: both", report.reference_forward_backward)
    ratio = report.reference_forward_backward.median / report.forward_backward.median
    print(f"  {ratio:.1f} times as fast as the reference; gradients differ by {report.largest_difference:.1e} at most")


def print_losses(report: LossReport) -> None:
    print_header(f"image losses, forward + backward: L1, SSIM, pyramid and NCC, {report.size}x{report.size}")
    print_passes(report.passes)
    print_row("kernels", report.kernels)
    print_row("torch references", report.references)
    ratio = report.references.median / report.kernels.median
    print(f"  {ratio:.1f} times as fast as the references; gradients differ by {report.difference:.1e}")


def print_shares(shares: dict[str, Timing], scene: SceneSize | TrainedScene, preset: str) -> None:
    print(f"\n{_title(scene, preset)}")
    print(f"  {'':46s}{'median':>8s}  milliseconds")
    for name, time in shares.items():
        print(f"  {name:46s}{time.median:8.2f}  {time.median / shares['step'].median:4.0%}")


def print_host(report: HostReport, preset: str, *, null: bool) -> None:
    on = "a card that takes no time" if null else "this device"
    print_header(f"a step of {preset} on {on}: {report.gaussians:,} Gaussians at {report.size}x{report.size}")
    print_row("from one to the next", report.step)
    print(
        f"{report.submissions:.1f} submissions, {report.waits:.1f} waits, "
        f"{report.up / 1e6:.3f} MB up, {report.down / 1e6:.3f} MB down"
    )


def _title(scene: SceneSize | TrainedScene, preset: str) -> str:
    size = f"{scene.height}x{scene.height}"
    return f"training step, preset {preset}: {scene.gaussians:,} Gaussians, {size}, everything moving"


def print_step(report: StepReport) -> None:
    print_header(
        f"training step, preset tiny, built-in scene: {report.gaussians:,} Gaussians, {report.size}x{report.size}"
    )
    print_row("whole step", report.step, f"{1e3 / report.step.median:.1f} steps/s")
    print_traffic("a step", report.traffic)


if __name__ == "__main__":
    main()
