"""Pictures on a target: each thing that the shader shows, against the same in numpy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.viewer.present import HEAT, ImageLayout, Offscreen

pytestmark = [pytest.mark.kernels, pytest.mark.triangles]
Floats = NDArray[np.float64]
WIDTH, HEIGHT = 13, 7
MARGIN = (0.2, 0.4, 0.6)
BACKGROUND = (0.25, 0.5, 1.0)
ROUNDING = 0.61  # of 255: what a conversion to 8 bits may be off


@dataclasses.dataclass
class Bench:
    """A random picture: planes (5, H, W) of red, green, blue, transmittance and depth, some beyond [0, 1]."""

    planes: Floats
    layout: ImageLayout
    truth: NDArray[np.uint8]
    offscreen: Offscreen
    with_truth: ImageLayout

    def show(self, *pictures: ImageLayout, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Floats:
        """(H, W, 3) as presented, in [0, 1]."""
        return self.offscreen(size, list(pictures), MARGIN) / 255.0


@pytest.fixture(scope="module")
def bench(device: Device) -> Bench:
    rng = np.random.default_rng(0)
    planes = rng.uniform(-0.1, 1.2, (5, HEIGHT, WIDTH)).astype(np.float32)
    planes[3] = rng.uniform(0, 1, (HEIGHT, WIDTH))
    planes[3, 0, :3] = 1.0  # nothing there
    planes[:3, 0, :3] = planes[4, 0, :3] = 0.0
    planes[4] *= 4 * (1 - planes[3])
    truth = rng.integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8)
    arrays = [DeviceArray.upload(device, "planes", planes), DeviceArray.upload(device, "truth", truth.view(np.uint32))]
    size = (WIDTH, HEIGHT)
    layout = ImageLayout(arrays[0], size, (0, 0), size, BACKGROUND)
    with_truth = layout._replace(truth=arrays[1], truth_size=size)
    return Bench(planes.astype(np.float64), layout, truth[..., :3], Offscreen(device), with_truth)


def near(got: Floats, expected: Floats) -> None:
    off = 255 * np.abs(got - np.clip(expected, 0, 1))
    assert off.max() <= ROUNDING, f"off by {off.max():.2f} of 255 in {(off > ROUNDING).sum()} values"


def colors(planes: Floats) -> Floats:
    return planes[:3].transpose(1, 2, 0)


def scaled(total: Floats, alpha: Floats, low: float, high: float) -> Floats:
    """A mean value a pixel by the scale of colors, over the background."""
    share = np.clip((total / np.maximum(alpha, 1e-6) - low) / (high - low), 0, 1)
    stops = np.linspace(0, 1, len(HEAT))
    heat = np.stack([np.interp(share, stops, [color[c] for color in HEAT]) for c in range(3)], axis=-1)
    return heat * alpha[..., None] + np.array(BACKGROUND) * (1 - alpha[..., None])


def test_colors(bench: Bench) -> None:
    near(bench.show(bench.layout), colors(bench.planes))


def test_coverage(bench: Bench) -> None:
    expected = np.repeat(1 - bench.planes[3][..., None], 3, axis=2)
    near(bench.show(bench.layout._replace(shows="alpha")), expected)


@pytest.mark.parametrize(("shows", "plane"), [("depth", 4), ("value", 0)])
def test_values_by_a_scale_of_colors(bench: Bench, shows: str, plane: int) -> None:
    got = bench.show(bench.layout._replace(shows=shows, low=0.5, high=3.0))
    near(got, scaled(bench.planes[plane], 1 - bench.planes[3], 0.5, 3.0))


def test_a_scale_without_length_is_no_accident(bench: Bench) -> None:
    got = bench.show(bench.layout._replace(shows="depth", low=1.0, high=1.0))
    assert np.isfinite(got).all()
    near(got[0, :3], np.broadcast_to(BACKGROUND, (3, 3)))


def enlarged(picture: Floats, width: int, height: int) -> Floats:
    """Bilinear, pixel centres at halves, the border repeated."""
    rows, columns = picture.shape[:2]
    y = (np.arange(height) + 0.5) / height * rows - 0.5
    x = (np.arange(width) + 0.5) / width * columns - 0.5

    def pick(i: Floats, count: int) -> NDArray[np.int64]:
        return np.clip(i, 0, count - 1).astype(np.int64)

    fy, fx = (y - np.floor(y))[:, None, None], (x - np.floor(x))[None, :, None]
    up, down = pick(np.floor(y), rows), pick(np.floor(y) + 1, rows)
    left, right = pick(np.floor(x), columns), pick(np.floor(x) + 1, columns)
    top = picture[up][:, left] * (1 - fx) + picture[up][:, right] * fx
    bottom = picture[down][:, left] * (1 - fx) + picture[down][:, right] * fx
    return top * (1 - fy) + bottom * fy


def test_enlargement_is_bilinear(bench: Bench) -> None:
    got = bench.show(bench.layout._replace(size=(40, 30)), size=(40, 30))
    near(got, enlarged(colors(bench.planes), 40, 30))


def test_values_are_enlarged_as_colors(bench: Bench) -> None:
    got = bench.show(bench.layout._replace(size=(26, 14), shows="depth", high=3.0), size=(26, 14))
    near(got, enlarged(scaled(bench.planes[4], 1 - bench.planes[3], 0.0, 3.0), 26, 14))


def test_margins_surround_the_picture(bench: Bench) -> None:
    got = bench.show(bench.layout._replace(origin=(5, 3)), size=(30, 20))
    expected = np.broadcast_to(MARGIN, (20, 30, 3)).copy()
    expected[3 : 3 + HEIGHT, 5 : 5 + WIDTH] = colors(bench.planes)
    near(got, expected)


def test_split(bench: Bench) -> None:
    got = bench.show(bench.with_truth._replace(truth_until=0.4))
    centres = (np.arange(WIDTH) + 0.5) / WIDTH
    expected = np.where((centres < 0.4)[None, :, None], bench.truth / 255, colors(bench.planes))
    near(got, expected)
    assert (got[:, 5] == bench.truth[:, 5] / 255).sum() < got[:, 5].size  # the sixth column is already the picture's


def test_side_by_side(bench: Bench) -> None:
    left = bench.with_truth._replace(truth_until=1.0)
    right = bench.with_truth._replace(truth_until=0.0, origin=(WIDTH, 0))
    got = bench.show(left, right, size=(2 * WIDTH, HEIGHT))
    near(got[:, :WIDTH], bench.truth / 255)
    near(got[:, WIDTH:], colors(bench.planes))


def test_error(bench: Bench) -> None:
    got = bench.show(bench.with_truth._replace(error_gain=4.0))
    off = 255 * np.abs(got - np.clip(4 * np.abs(np.clip(colors(bench.planes), 0, 1) - bench.truth / 255), 0, 1))
    assert off.max() <= ROUNDING


def test_truth_of_another_size_is_not_smoothed(bench: Bench) -> None:
    """Its pixels are shown as they are."""
    left = bench.with_truth._replace(truth_until=1.0, size=(3 * WIDTH, 3 * HEIGHT))
    got = bench.show(left, size=(3 * WIDTH, 3 * HEIGHT))
    near(got, bench.truth.repeat(3, axis=0).repeat(3, axis=1) / 255)


def test_a_target_of_another_size_follows(bench: Bench) -> None:
    for size in ((70, 3), (WIDTH, HEIGHT)):  # rows of 280 bytes are no multiple of the copy's 256
        got = bench.show(bench.layout, size=size) if size[1] >= HEIGHT else bench.show(size=size)
        assert got.shape == (size[1], size[0], 3)
    near(got, colors(bench.planes))
