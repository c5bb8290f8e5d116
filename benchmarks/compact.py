"""Size and quality of compact scenes: python benchmarks/compact.py RUN... prints a Markdown table (docs/results.md).

Each RUN is a folder of lapgs-train whose capture is here. PSNR is the mean over its test views, of 8-bit pictures.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from lapgs_wgpu.data.views import composite
from lapgs_wgpu.gpu.device import open_device
from lapgs_wgpu.motion.playback.playback import DevicePlayback, playback_of
from lapgs_wgpu.motion.scene_file import compact_bytes, read_scene
from lapgs_wgpu.viewer.loaded_scene import load_scene
from lapgs_wgpu.viewer.offscreen import OffscreenRenderer


def mean_psnr(path: Path, run: Path) -> float:
    """PSNR of the scene in a file on the test views of a run's capture, dB."""
    scene = load_scene(path, open_device)
    views = [view for view in load_scene(run / "checkpoint.ply", open_device).views if "test" in view.name]
    if not views:
        raise SystemExit(f"{run}: its capture is not here")
    draw = OffscreenRenderer(scene)
    values = []
    for view in views:
        truth = composite(view.load(), np.asarray(scene.background, np.float32))
        error = np.float64(draw(view.camera, view.time)) - truth
        values.append(20 * np.log10(255) - 10 * np.log10(np.mean(error**2)))
    return float(np.mean(values))


def main(runs: list[str]) -> None:
    print("| run | Gaussians | checkpoint, bytes | compact, bytes | PSNR | compact |\n|---|---:|---:|---:|---:|---:|")
    for run in map(Path, runs):
        checkpoint = run / "checkpoint.ply"
        playback = playback_of(read_scene(checkpoint), open_device())
        assert isinstance(playback, DevicePlayback)
        with tempfile.TemporaryDirectory() as folder:
            compact = Path(folder) / "scene.lapgs"
            compact.write_bytes(compact_bytes(read_scene(checkpoint), playback.static_features()))
            sizes = checkpoint.stat().st_size, compact.stat().st_size
            before, after = mean_psnr(checkpoint, run), mean_psnr(compact, run)
        print(f"| {run.name} | {playback.count:,} | {sizes[0]:,} | {sizes[1]:,} | {before:.3f} | {after:.3f} |")


if __name__ == "__main__":
    main(sys.argv[1:])
