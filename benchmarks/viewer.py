"""The viewer: from the command to the first picture, and pictures while the time slider is dragged, at 640x480."""

import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from measure import Timing, summary
from scene import SceneSize, TrainedScene, make_scene

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.playback.playback import playback_of
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.scene_file import read_scene
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest

SIZE = (640, 480)
SHARES = (1.0, 0.5, 0.25)  # of the window's width and height
Scenes = tuple[tuple[str, int], ...]
SCENES: Scenes = (("tiny", 20_000), ("tiny", 50_000), ("dnerf", 20_000), ("dnerf", 50_000))


@dataclass(frozen=True)
class ViewerReport:
    """Milliseconds. window: from the command to the first picture in a window; None without Xvfb. screenshot: of the
    whole command. scrub: a frame at another time than the one before, by share of the window's size."""

    window: Timing | None
    screenshot: Timing
    scrub: dict[str, Timing]


def bench_viewer(
    device: Device, repeat: int, scenes: Scenes = SCENES, trained: Sequence[TrainedScene] = ()
) -> dict[str, ViewerReport]:
    """By preset and number of Gaussians, or by checkpoint, if some are given."""
    with TemporaryDirectory() as folder:
        files = {f"{scene.checkpoint}, {scene.gaussians:,} Gaussians": scene.checkpoint for scene in trained}
        for preset, gaussians in () if trained else scenes:
            file = Path(folder) / f"{preset}-{gaussians}.ply"
            write_moving_scene(file, preset, gaussians, device)
            files[f"preset {preset}, {gaussians:,} Gaussians"] = file
        return {name: _report(device, file, repeat) for name, file in files.items()}


def _report(device: Device, file: Path, repeat: int) -> ViewerReport:
    starts = max(3, repeat // 3)
    window = summary([_window(file) for _ in range(starts)]) if _has_screen() else None
    return ViewerReport(window, summary([_screenshot(file) for _ in range(starts)]), _scrub(device, file, repeat))


def write_moving_scene(file: Path, preset: str, gaussians: int, device: Device) -> None:
    """The ball of the other benchmarks, moved a little by a field of this preset with random weights."""
    arrays, camera = make_scene(SceneSize(gaussians, SIZE[1], SIZE[1]))
    config = load_config(preset).field
    scene = Scene4D.from_points(arrays["means"], arrays["colors"], arrays["scales"][:, 0], config, device=device)
    generator = torch.Generator().manual_seed(0)
    assert scene.field is not None
    with torch.no_grad():
        logits = torch.from_numpy(np.log(arrays["opacities"] / (1 - arrays["opacities"])))
        scene.parameters["opacity_logits"].copy_(logits)
        scene.parameters["log_scales"].copy_(torch.from_numpy(np.log(arrays["scales"])))
        scene.parameters["quats"].copy_(torch.from_numpy(arrays["quats"]))
        for name, parameter in scene.field.named_parameters():
            if "heads" in name or "appearance" in name:
                parameter.copy_(0.01 * torch.randn(*parameter.shape, generator=generator))
    scene.sh_degree = 3
    look = InitialView(camera.resized(*SIZE), np.zeros(3), np.array([0.0, -1.0, 0.0]), 150)
    scene.save(file, {"view": look.to_json()})


def _scrub(device: Device, file: Path, repeat: int) -> dict[str, Timing]:
    renderer = FrameRenderer(playback_of(read_scene(file), device))
    look = InitialView.from_json(renderer.playback.metadata["view"])
    assert look is not None
    times = iter(np.linspace(0, 1, 3 + len(SHARES) * (repeat + 1)).tolist())
    found = {}
    for share in SHARES:
        camera = look.camera.resized(*(round(share * side) for side in SIZE))
        frames = [renderer.draw(FrameRequest(camera, next(times), "rgb", (0, 0, 0))) for _ in range(repeat + 1)]
        found[f"{share:.0%}"] = summary([1e3 * frame.seconds for frame in frames[1:]])
    return found


def _command(file: Path) -> list[str]:
    return [sys.executable, "-m", "lapgs_wgpu.viewer.cli", str(file), "--size", f"{SIZE[0]}x{SIZE[1]}"]


def _screenshot(file: Path) -> float:
    start = time.perf_counter()
    picture = file.with_suffix(".png")
    subprocess.run([*_command(file), "--screenshot", str(picture)], check=True, stdout=subprocess.DEVNULL)
    return 1e3 * (time.perf_counter() - start)


def _has_screen() -> bool:
    return shutil.which("Xvfb") is not None and shutil.which("xdotool") is not None


def _window(file: Path) -> float:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from helpers.desktop import Desktop

    with Desktop() as desktop:
        start = time.perf_counter()
        process = desktop.start(*_command(file))
        while desktop.picture()[: SIZE[1], : SIZE[0]].max() < 60:
            if process.poll() is not None:
                raise RuntimeError(f"lapgs-view ended: {process.communicate()[1]}")
            time.sleep(0.005)
        return 1e3 * (time.perf_counter() - start)


def print_viewer(name: str, report: ViewerReport) -> None:
    print(f"\nviewer, {SIZE[0]}x{SIZE[1]}, {name}")
    rows = {"command to first picture, window": report.window, "command with --screenshot": report.screenshot}
    rows |= {f"frame at another time, {share}": timing for share, timing in report.scrub.items()}
    for name, timing in rows.items():
        if timing is not None:
            print(f"  {name:46s}{timing.median:8.1f}{timing.minimum:9.1f}  ms (median, least)")
