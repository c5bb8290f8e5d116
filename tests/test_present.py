"""Pictures on a target: each thing that the shader shows, against the same in numpy."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.frame import Frame, FrameRequest
from lapgs_wgpu.viewer.present import HEAT, Presenter
from lapgs_wgpu.viewer.render_modes import Mode

pytestmark = [pytest.mark.kernels, pytest.mark.triangles]
Floats = NDArray[np.float64]
WIDTH, HEIGHT = 13, 7
BACKGROUND = (0.25, 0.5, 1.0)
ROUNDING = 0.61  # of 255: what a conversion to 8 bits may be off


@dataclasses.dataclass
class Bench:
    """A random picture: planes (5, H, W) of red, green, blue, transmittance and depth, some beyond [0, 1]."""

    planes: Floats
    uploaded: DeviceArray
    presenter: Presenter

    def show(
        self, mode: Mode = "rgb", size: tuple[int, int] = (WIDTH, HEIGHT), low: float = 0.0, high: float = 1.0
    ) -> Floats:
        """(H, W, 3) as presented, in [0, 1]."""
        request = FrameRequest(Camera(np.eye(3), np.eye(4), WIDTH, HEIGHT), 0.0, mode, BACKGROUND)
        return self.presenter.picture(size, Frame(request, self.uploaded, low, high)) / 255.0


@pytest.fixture(scope="module")
def bench(device: Device) -> Bench:
    rng = np.random.default_rng(0)
    planes = rng.uniform(-0.1, 1.2, (5, HEIGHT, WIDTH)).astype(np.float32)
    planes[3] = rng.uniform(0, 1, (HEIGHT, WIDTH))
    planes[3, 0, :3] = 1.0  # nothing there
    planes[:3, 0, :3] = planes[4, 0, :3] = 0.0
    planes[4] *= 4 * (1 - planes[3])
    return Bench(planes.astype(np.float64), DeviceArray.upload(device, "planes", planes), Presenter(device))


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
    near(bench.show(), colors(bench.planes))


def test_coverage(bench: Bench) -> None:
    expected = np.repeat(1 - bench.planes[3][..., None], 3, axis=2)
    near(bench.show("alpha"), expected)


@pytest.mark.parametrize(("mode", "plane"), [("depth", 4), ("motion", 0)])
def test_values_by_a_scale_of_colors(bench: Bench, mode: Mode, plane: int) -> None:
    got = bench.show(mode, low=0.5, high=3.0)
    near(got, scaled(bench.planes[plane], 1 - bench.planes[3], 0.5, 3.0))


def enlarged(picture: Floats, width: int, height: int) -> Floats:
    """Bilinear, pixel centres at halves, the border repeated."""
    rows, columns = picture.shape[:2]
    return ndimage.zoom(picture, (height / rows, width / columns, 1), order=1, mode="nearest", grid_mode=True)


def test_enlargement_is_bilinear(bench: Bench) -> None:
    got = bench.show(size=(40, 30))
    near(got, enlarged(colors(bench.planes), 40, 30))


def test_values_are_enlarged_as_colors(bench: Bench) -> None:
    got = bench.show("depth", (26, 14), high=3.0)
    near(got, enlarged(scaled(bench.planes[4], 1 - bench.planes[3], 0.0, 3.0), 26, 14))


def test_a_target_of_another_size_follows(bench: Bench) -> None:
    for size in ((70, 3), (WIDTH, HEIGHT)):  # rows of 280 bytes are no multiple of the copy's 256
        got = bench.show(size=size)
        assert got.shape == (size[1], size[0], 3)
    near(got, colors(bench.planes))
