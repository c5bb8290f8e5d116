"""The images that a training compares with: which are kept, how they are laid and marked, and their order."""

import dataclasses
from collections import defaultdict
from contextlib import closing

import numpy as np
import pytest
import torch
from helpers.scenes import front_camera

from lapgs_wgpu.data import Dataset, View, composite
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.ground_truth import AHEAD, Draws, GroundTruth, backgrounds_of, marked_pixels
from lapgs_wgpu.train.presets import load_config

BLACK = torch.zeros(3)
ON_BLACK = defaultdict(lambda: BLACK)


class Source:
    """A view of a gray image, and the number of times that it was decoded."""

    def __init__(self, level: int, side: int = 20) -> None:
        self.decodes, self._level, self._side = 0, level, side
        self.view = View(f"train_{level:03}", front_camera(side, side), 0.0, "made up", self.pixels)

    def pixels(self) -> np.ndarray:
        self.decodes += 1
        return np.full((self._side, self._side, 3), self._level, np.uint8)


def test_the_most_recently_used_images_stay_on_the_device(device: Device) -> None:
    sources = [Source(level) for level in range(7)]
    huge = Source(9, side=60)
    with closing(GroundTruth(device, ON_BLACK, 10_000)) as truth:
        for source in sources[:6]:  # 1600 bytes each: six fit
            assert truth.on_device(source.view) is truth.on_device(source.view)
            assert (truth.on_device(source.view).read() & 255 == source._level).all()
        truth.on_device(sources[0].view)
        truth.on_device(sources[6].view)  # 1 was used least recently
        for source in (huge, huge, *sources):  # the huge one is larger than the bound
            truth.on_device(source.view)
        assert truth.used_bytes == 9600
    assert huge.decodes == 2
    assert sources[1].decodes == 2


def test_images_that_are_coming_are_decoded_once(device: Device) -> None:
    sources = [Source(level) for level in range(3)]
    with closing(GroundTruth(device, ON_BLACK, 0)) as truth:
        for _ in range(2):
            truth.prefetch(source.view for source in sources)
        for source in sources:
            assert truth.on_host(source.view).image[0, 0, 0] == torch.tensor(source._level / 255)
    assert [source.decodes for source in sources] == [1, 1, 1]


def test_images_of_half_the_size_and_their_cameras(device: Device) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    view = View("train_000", front_camera(30, 20), 0.0, "made up", lambda: pixels)
    mean = np.floor(pixels.reshape(10, 2, 15, 2, 3).mean(axis=(1, 3)) + 0.5)
    with closing(GroundTruth(device, ON_BLACK, 10_000)) as truth:
        for halved, expected in ((False, pixels), (True, mean), (False, pixels)):
            truth.halve(halved)
            truth.prefetch([view])
            for _ in range(2):
                assert np.abs(255 * truth.on_host(view).image.numpy() - expected).max() <= 1
            camera = truth.camera(view.camera)
            assert (camera.height, camera.width) == expected.shape[:2]
            place = camera.project(np.array([[0.1, 0.2, 3.0]]))[0]
            assert np.allclose(place * (2 if halved else 1), view.camera.project(np.array([[0.1, 0.2, 3.0]]))[0])


def test_a_failure_is_raised_where_the_image_is_needed_and_not_kept(device: Device) -> None:
    broken = [True]

    def pixels() -> np.ndarray:
        if broken[0]:
            raise InputError("r_000.png cannot be decoded.")
        return np.zeros((4, 5, 3), dtype=np.uint8)

    view = View("train_000", front_camera(5, 4), 0.0, "r_000.png", pixels)
    with closing(GroundTruth(device, ON_BLACK, 1000)) as truth:
        truth.prefetch([view])
        with pytest.raises(InputError, match="r_000"):
            truth.on_device(view)
        broken[0] = False
        assert truth.on_device(view).shape == (4, 5)


@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.31, 0.77, 0.123)])
def test_images_lie_on_their_background(color: tuple[float, ...], dataset: Dataset, device: Device) -> None:
    view = dataset.train[0]
    with closing(GroundTruth(device, {view: torch.tensor(color)}, 0)) as truth:
        rgba = truth.on_device(view).read().view(np.uint8).reshape(*truth.on_device(view).shape, 4)
        image, left_out = truth.on_host(view)
    assert not left_out.any()
    assert (rgba[..., 3] == 255).all()
    assert (rgba[..., :3] == composite(view.load(), color)).all()
    np.testing.assert_array_equal(image.numpy(), composite(view.load(), color).astype(np.float32) / 255)


def test_backgrounds_may_vary_from_view_to_view(dataset: Dataset) -> None:
    data = load_config("tiny").data
    white = backgrounds_of(dataset.train, dataclasses.replace(data, background="white"))
    assert all(white[view].tolist() == [1, 1, 1] for view in dataset.train)
    varied = [backgrounds_of(dataset.train, dataclasses.replace(data, vary_background=True)) for _ in range(2)]
    colors = torch.stack([varied[0][view] for view in dataset.train])
    assert torch.equal(colors, torch.stack(list(varied[1].values())))
    assert len(colors.unique(dim=0)) == len(dataset.train)
    assert ((colors >= 0) & (colors <= 1)).all()


def test_ignored_pixels_are_marked_and_transparent_ones_count() -> None:
    rgba = np.full((2, 3, 4), 7, np.uint8)
    rgba[0, 0, 3], rgba[0, 1, 3] = 0, 255
    ignored = np.zeros((2, 3), np.bool_)
    ignored[1, 2] = True
    view = View("train_000", front_camera(3, 2), 0.0, "made up", lambda: rgba.copy(), ignored=lambda: ignored)
    marked = marked_pixels(view, torch.ones(3))
    assert marked[0, 0].tolist() == [255, 255, 255, 255]
    assert marked[0, 1].tolist() == [7, 7, 7, 255]
    assert marked[1, 2].tolist() == [255, 255, 255, 0]
    opaque = dataclasses.replace(view, load=lambda: rgba[..., :3].copy(), ignored=None)
    assert marked_pixels(opaque, BLACK).shape == (2, 3, 3)


def test_every_view_is_drawn_once_an_epoch_and_decoded_ahead(dataset: Dataset, device: Device) -> None:
    with closing(GroundTruth(device, ON_BLACK, 0)) as truth:
        draws = Draws(dataset.train, torch.Generator().manual_seed(3), truth)
        epochs = [[draws.next() for _ in dataset.train] for _ in range(3)]
        assert all(set(epoch) == set(dataset.train) for epoch in epochs)
        assert epochs[0] != epochs[1]
        first = draws.next()
        coming = set(truth._coming)
        assert coming == {first, *(draws.next() for _ in range(min(AHEAD, len(dataset.train) - 1)))}
