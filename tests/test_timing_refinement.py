"""Times of training images that are corrected while training."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from helpers.scenes import front_camera
from helpers.training import configure
from torch import Tensor, nn

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.data.timestamps import time_step
from lapgs_wgpu.data.views import View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import EVEN
from lapgs_wgpu.train.ground_truth import GroundTruth, HostImage
from lapgs_wgpu.train.timing_refinement import FARTHEST, TimingRefinement, running_median
from lapgs_wgpu.train.trainer import Trainer

TIMES = np.linspace(0, 1, 11)
# Twice, two images of a film are late.
MOMENTS = np.array([0.0, 0.1, 0.2, 0.34, 0.44, 0.5, 0.6, 0.74, 0.84, 0.9, 1.0])
CAMERA = front_camera(48, 32)


class Shift(nn.Module):
    """To the right, by `speed` over the clip."""

    def __init__(self, speed: float) -> None:
        super().__init__()
        self.speed = nn.Parameter(torch.tensor(speed))

    def forward(self, means: Tensor, t: float) -> Deformation:
        return Deformation(translation=self.speed * t * torch.tensor([1.0, 0.0, 0.0]).expand(len(means), 3))


def moving(device: Device, speed: float = 0.8) -> Scene4D:
    random = np.random.default_rng(0)
    points = random.uniform(-0.4, 0.4, (30, 3)) + np.array([-0.4, 0.0, 3.0])
    return Scene4D.from_points(
        points, random.random((30, 3)), np.full(30, 0.1), FieldConfig(kind="own"), opacity=0.8, device=device,
        own_field=Shift(speed),
    )  # fmt: skip


def views_at(times: Sequence[float]) -> list[View]:
    return [
        View(f"train_{n:03}", CAMERA, t, "test", lambda: np.zeros((1, 1, 3), np.uint8)) for n, t in enumerate(times)
    ]


def refinement(scene: Scene4D, truth: Callable[[View], Tensor], times: Sequence[float] = TIMES) -> TimingRefinement:
    def picture(view: View, t: float) -> Tensor:
        return scene.render_at_field_time(view.camera, t).image

    def image(view: View) -> HostImage:
        pixels = truth(view)
        return HostImage(pixels, pixels.isnan()[..., :1])

    return TimingRefinement(scene, views_at(times), image, picture, time_step(np.asarray(times)))


def refine(scene: Scene4D, truth: Callable[[View], Tensor], times: int = 1) -> TimingRefinement:
    found = refinement(scene, truth)
    for number in range(times):
        scene.timing = found.fitted(number)
    return found


def film(scene: Scene4D, moments: np.ndarray = MOMENTS) -> Callable[[View], Tensor]:
    """Images at the times TIMES that show the scene at these moments."""
    images = {t: scene.render(CAMERA, m).image for t, m in zip(TIMES.tolist(), moments.tolist(), strict=True)}
    return lambda view: images[view.time]


def test_it_finds_which_moments_a_film_shows(device: Device) -> None:
    scene = moving(device)
    found = refine(scene, film(scene), 6)
    np.testing.assert_allclose(scene.timing.moments, MOMENTS, atol=1e-3)
    np.testing.assert_array_equal(scene.timing.times, TIMES)
    assert found.report()["frames_most"] == pytest.approx(0.4, abs=0.01)


def test_what_all_images_have_in_common_is_left_to_the_field(device: Device) -> None:
    scene = moving(device)
    refine(scene, film(scene, TIMES + 0.04))
    assert scene.timing is EVEN


def test_what_does_not_count_is_not_looked_at(device: Device) -> None:
    scene = moving(device)
    right, even = film(scene), film(scene, TIMES)

    def half(view: View) -> Tensor:
        image = right(view).clone()
        image[:16] = even(view)[:16]
        return image

    def covered(view: View) -> Tensor:
        image = half(view).clone()
        image[:16] = torch.nan
        return image

    found = []
    for truth in (half, covered):
        scene.timing = EVEN
        refine(scene, truth, 6)
        found.append(np.abs(scene.timing.moments - MOMENTS).max())
    assert found[0] > 0.01
    assert found[1] < 1e-3


def test_moments_rise_and_stay_near_their_times(device: Device) -> None:
    scene = moving(device)
    refine(scene, film(scene, MOMENTS[::-1]), 9)
    assert (np.diff(scene.timing.moments) >= 0).all()
    assert np.abs(scene.timing.moments - TIMES).max() <= FARTHEST * 0.1 + 1e-12


def test_the_running_median_has_as_many_after_as_before() -> None:
    found = running_median(np.array([9.0, 1.0, 2.0, 8.0, 3.0, 0.0]), 2)
    np.testing.assert_array_equal(found, [9.0, 2.0, 3.0, 2.0, 3.0, 0.0])


# In a training --------------------------------------------------------------------------------------------------------

GIVEN = {"timing__refine": "true", "timing__start": "15", "timing__interval": "6"}


@pytest.mark.parametrize("moments", [[0.1, 0.2], list(np.linspace(1, 0, 8))])
def test_a_state_of_other_times_is_refused(dataset: Dataset, device: Device, moments: list[float]) -> None:
    with Trainer(configure(**GIVEN), dataset, device) as training:
        state = training.state() | {"timing.times": dataset.times, "timing.moments": np.array(moments)}
        with pytest.raises(ValueError, match="moments"):
            training.restore(state)


def test_a_correction_that_fails_changes_nothing(
    dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state of the steps before can be saved."""

    def lost(self: GroundTruth, view: View) -> HostImage:
        raise InputError("the disk is gone")

    monkeypatch.setattr(GroundTruth, "on_host", lost)
    with Trainer(configure(**GIVEN), dataset, device) as training:
        for _ in range(14):
            training.step()
        before = training.state()
        with pytest.raises(InputError, match="the disk is gone"):
            training.step()
        assert training.whole
        for name, value in training.state().items():
            np.testing.assert_array_equal(value, before[name])


def test_it_sees_what_the_losses_see(dataset: Dataset, device: Device) -> None:
    """Colors and cameras with their corrections; pixels that are ignored do not count."""
    ignored = np.zeros((32, 32), bool)
    ignored[:5] = True
    first = dataclasses.replace(dataset.train[0], ignored=lambda: ignored)
    masked = dataclasses.replace(dataset, train=(first, *dataset.train[1:]))
    with Trainer(configure(exposure__enabled="true", cameras__refine="on", **GIVEN), masked, device) as training:
        assert training._learners.exposures is not None
        with torch.no_grad():
            training._learners.exposures.values[0, :, 3] += 0.25
        plain = training.scene.render(first.camera, first.time, torch.zeros(3)).image
        torch.testing.assert_close(training._picture(first, first.time), plain + 0.25)
        left_out = training._truth.on_host(first).left_out
        assert bool(left_out[:5].all())
        assert not left_out[5:].any()
