"""Exposure: the passes against their reference, the corrections, and what they are for."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.loss_reference import exposure
from helpers.scenes import relative
from helpers.training import configure
from numpy.typing import NDArray

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.exposure import Exposures, expose, expose_bwd
from lapgs_wgpu.train.learners import restore_tensors
from lapgs_wgpu.train.optimizer import rate_at
from lapgs_wgpu.train.trainer import Trainer

CORRECTION = torch.tensor([[0.9, 0.1, -0.05, 0.02], [0.03, 1.2, 0.0, -0.1], [-0.02, 0.05, 0.8, 0.2]])
IDENTITY = torch.eye(3, 4)
RATE = Rate(2e-2, 2e-3, 100)


# The passes


@pytest.mark.kernels
@pytest.mark.parametrize("size", [(1, 1), (37, 61), (64, 200)])
def test_exposure(device: Device, size: tuple[int, int]) -> None:
    """The image, and its gradient to the image and to the correction, are the reference's in float64."""
    rng = np.random.default_rng(size[0])
    image, d_exposed = (rng.random((4, *size), np.float32) for _ in range(2))
    pool = BufferPool(device)
    drawn, d = DeviceArray.upload(device, "image", image), DeviceArray.upload(device, "d_exposed", d_exposed)
    rows = DeviceArray.upload(device, "rows", np.concatenate([np.zeros((2, 4), np.float32), CORRECTION.numpy()]))
    with Commands(device) as commands:
        exposed = expose(commands, pool, drawn, rows, lambda: 2)
        d_image, d_rows = expose_bwd(commands, pool, drawn, d, rows, lambda: 2)

    def tensor(planes: NDArray[np.float32]) -> torch.Tensor:
        return torch.from_numpy(planes[:3]).permute(1, 2, 0).double()

    leaves = tensor(image).requires_grad_(), CORRECTION.double().requires_grad_()
    expected = exposure(*leaves)
    expected.backward(tensor(d_exposed))
    assert leaves[0].grad is not None
    assert leaves[1].grad is not None
    found = tensor(exposed.read())
    torch.testing.assert_close(found, expected.detach(), rtol=0, atol=1e-6)
    d_image = d_image.read()
    assert relative(tensor(d_image), leaves[0].grad) < 1e-6
    assert (d_image[3] == 0).all()
    d_rows = d_rows.read().astype(np.float64)
    assert relative(torch.from_numpy(d_rows.sum(axis=0)), leaves[1].grad) < 1e-5


# The corrections


def test_corrections_move_against_their_gradient_and_leave_the_scene_its_colors() -> None:
    exposures = Exposures(4, RATE)
    exposures.step(1)  # without a gradient
    assert torch.equal(exposures.values, IDENTITY.expand(4, 3, 4))
    (3.0 * exposures.values[2].sum()).backward()
    exposures.step(1)
    moved = (exposures.values - IDENTITY).detach()
    torch.testing.assert_close(moved.mean(dim=0), torch.zeros(3, 4), rtol=0, atol=1e-7)
    torch.testing.assert_close(moved[2] - moved[0], torch.full((3, 4), -rate_at(RATE, 1)))
    assert torch.equal(moved[0], moved[3])
    assert exposures.values.grad is None
    assert exposures.state()["steps"].flatten().tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize("name", ["values", "mean", "square", "steps"])
def test_a_state_of_other_pictures_is_refused(name: str) -> None:
    exposures = Exposures(3, RATE)
    state = {key: value.detach().clone() for key, value in exposures.state().items()}
    for bad in (Exposures(2, RATE).state()[name], state[name].double(), state[name] + math.nan):
        with pytest.raises(ValueError, match=f"its exposure {name}"):
            restore_tensors(exposures.state(), {**state, name: bad}, "exposure")


def test_each_camera_of_a_rig_has_one_correction(dataset: Dataset, device: Device) -> None:
    """Images of cameras that move have one each."""
    few = [dataclasses.replace(view, time=0.0) for view in dataset.train[:3]]
    later = [dataclasses.replace(view, name=f"later_{view.name}", time=1.0) for view in few]
    config = configure(exposure__enabled="true")
    for views, count in (([*few, *later], 3), (few, 3)):
        with Trainer(config, dataclasses.replace(dataset, train=tuple(views)), device) as trainer:
            corrections = [trainer.exposure_of(view) for view in views]
            assert len({each.data_ptr() for each in corrections if each is not None}) == count
            if len(views) == 6:
                assert [each.data_ptr() for each in corrections[:3]] == [each.data_ptr() for each in corrections[3:]]
