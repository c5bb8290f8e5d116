"""PSNR of what moves: python benchmarks/moving_pixels.py RUN [STATIC_RUN] prints the PSNR of moving and of other pixels
of the run's test views. Which pixels move follows from the images alone:

- A test camera that stands still: pixels that differ from their median over the clip.
- With STATIC_RUN, a run of the same capture with --field static: pixels that differ from its rendering, averaged over
  small windows, since a fit is nowhere exact at edges.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from object_metrics import psnr_within
from scipy.ndimage import uniform_filter

from lapgs_wgpu import load, open_device
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.views import View, composite
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import BACKGROUND_LEVELS
from lapgs_wgpu.train.evaluate import to_8_bit
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import open_data

THRESHOLD = 16  # levels of 255 in any channel: above the noise of a compressed video
LEAST_TIMES = 5  # of a camera, for a median
MOST_IMAGES = 64  # of a camera that the median is taken of, evenly over the clip
WINDOW = 5  # pixels: side of the windows over which the residual of a static fit is averaged

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def still_backgrounds(views: Sequence[View], load: Callable[[View], Image]) -> list[Image | None]:
    """For each view the median image (H, W, 3) of its camera over the clip, None where the camera moves.

    A camera stands still where at least LEAST_TIMES views of different times share its pose and intrinsics.

    Args:
        views: the test views.
        load: decodes a view and puts it on the background: (H, W, 3) uint8. Raises InputError.
    """
    groups: dict[bytes, list[int]] = {}
    for index, view in enumerate(views):
        camera = view.camera
        key = camera.K.tobytes() + camera.T_cam_world.tobytes() + bytes(f"{camera.width} {camera.height}", "ascii")
        groups.setdefault(key, []).append(index)
    result: list[Image | None] = [None] * len(views)
    for group in groups.values():
        ordered = sorted(group, key=lambda index: views[index].time)
        if len({views[index].time for index in ordered}) < LEAST_TIMES:
            continue
        middle = _median([load(views[index]) for index in evenly(ordered, MOST_IMAGES)])
        for index in group:
            result[index] = middle
    return result


def differs_from_median(truth: Image, background: Image) -> Mask:
    """Pixels (H, W) that differ from the median of the clip by more than THRESHOLD in any channel."""
    return (np.abs(truth.astype(np.int16) - background) > THRESHOLD).any(axis=2)


def differs_from_static(truth: Image, static: Image) -> Mask:
    """Pixels (H, W) where a static fit is off by more than THRESHOLD in any channel, in the mean of WINDOW x WINDOW."""
    return (np.abs(uniform_filter(truth.astype(np.float64) - static, (WINDOW, WINDOW, 0))) > THRESHOLD).any(axis=2)


def _median(images: Sequence[Image]) -> Image:
    """Per-pixel median, the lower of two middle values: of n (H, W, 3) images, a row at a time to save memory."""
    middle = (len(images) - 1) // 2
    rows = [
        np.partition(np.stack([image[row] for image in images]), middle, axis=0)[middle]
        for row in range(len(images[0]))
    ]
    return np.stack(rows)


def measure_run(run: Path, static_run: Path | None) -> tuple[float, float]:
    """PSNR (dB) of moving and of other pixels, means over the test views that have any; NaN where none has."""
    config, device = load_config(run / "config.toml"), open_device()
    views = open_data(config)[1].test
    color = np.full(3, BACKGROUND_LEVELS[config.data.background], np.float32)

    def truth(view: View) -> Image:
        return composite(view.load(), color)

    def drawn(scene: Scene4D, view: View) -> Image:
        return to_8_bit(scene.render(view.camera, view.time, color.tolist(), depth=False).image)

    scene = load(run / "checkpoint.ply", device)
    static = None if static_run is None else load(static_run / "checkpoint.ply", device)
    moving: list[float] = []
    still: list[float] = []
    for view, background in zip(views, still_backgrounds(views, truth), strict=True):
        if static is not None:
            pixels = differs_from_static(truth(view), drawn(static, view))
        elif background is not None:
            pixels = differs_from_median(truth(view), background)
        else:
            continue
        for part, values in ((pixels, moving), (~pixels, still)):
            if part.any():
                values.append(psnr_within(drawn(scene, view), truth(view), part))
    return float(np.mean(moving)), float(np.mean(still))


if __name__ == "__main__":
    of_moving, of_still = measure_run(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
    print(f"{of_moving:.2f} dB of moving pixels, {of_still:.2f} dB of the others")
