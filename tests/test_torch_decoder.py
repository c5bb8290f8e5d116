"""The decoder without hidden layers in torch: against autograd of the same in float64, and in blocks."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from helpers.decoder_reference import gated
from helpers.matrices import random
from torch import Tensor

from lapgs_wgpu.motion.fields import torch_decoder
from lapgs_wgpu.motion.fields.torch_decoder import DecoderWeights, decode

SHAPES = {
    "static": 6,
    "temporal": 9,
    "dynamics": 3,
}
WIDTH, OUTPUTS = 12, 7
# What a field lacks, by name of a field that lacks it.
LACKS = {
    "laplacian": (),
    "grid4d": ("dynamics", "inner"),
    "no dynamics": ("dynamics",),
    "no temporal grids": ("temporal",),
    "neither": ("temporal", "dynamics"),
}


def problem(count: int, lacks: tuple[str, ...] = ()) -> tuple[list[Tensor], DecoderWeights]:
    sizes = {name: 0 if name in lacks else size for name, size in SHAPES.items()}
    inputs = [random(count, size, seed=i) for i, size in enumerate(sizes.values())]
    inner = 0 if "inner" in lacks else WIDTH
    shapes = {
        "spatial": (WIDTH, sizes["static"]),
        "spatial_bias": (WIDTH,),
        "temporal": (WIDTH, sizes["temporal"]),
        "dynamics": (WIDTH, sizes["dynamics"]),
        "temporal_bias": (WIDTH,),
        "inner": (inner, sizes["static"]),
        "inner_bias": (inner,),
        "heads": (OUTPUTS, WIDTH),
        "motion_heads": (OUTPUTS, inner),
        "heads_bias": (OUTPUTS,),
    }
    return inputs, DecoderWeights(**{name: random(*shape, seed=9) for name, shape in shapes.items()})


def decode_reference(static: Tensor, temporal: Tensor, dynamics: Tensor, weights: DecoderWeights) -> Tensor:
    moving = weights.temporal_bias + temporal @ weights.temporal.T + dynamics @ weights.dynamics.T
    features = gated(moving, 2 * (static @ weights.spatial.T + weights.spatial_bias))
    inner = torch.relu(static @ weights.inner.T + weights.inner_bias)
    return features @ weights.heads.T + weights.heads_bias + inner @ weights.motion_heads.T


def differentiated(function: object, inputs: list[Tensor], weights: DecoderWeights, dtype: torch.dtype) -> list[Tensor]:
    """The outputs, and the gradients of all inputs and weights."""
    leaves = [each.to(dtype, copy=True).requires_grad_() for each in (*inputs, *weights)]
    outputs = function(*leaves[: len(inputs)], DecoderWeights(*leaves[len(inputs) :]))
    return [outputs.detach(), *torch.autograd.grad(outputs, leaves, random(*outputs.shape, seed=5).to(dtype))]


@pytest.mark.parametrize("lacks", LACKS.values(), ids=LACKS)
@pytest.mark.parametrize("count", [1, 37, 1500])
def test_decode(count: int, lacks: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_decoder, "LARGEST", 400)
    inputs, weights = problem(count, lacks)
    expected = differentiated(decode_reference, inputs, weights, torch.float64)
    for found, exact in zip(differentiated(decode, inputs, weights, torch.float64), expected, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-9)
    for found, exact in zip(differentiated(decode, inputs, weights, torch.float32), expected, strict=True):
        largest = max(exact.abs().flatten().tolist(), default=0.0)
        torch.testing.assert_close(found.double(), exact, rtol=1e-4, atol=1e-4 * largest)


def test_no_gaussians() -> None:
    inputs, weights = problem(0)
    outputs, *gradients = differentiated(decode, inputs, weights, torch.float32)
    assert outputs.shape == (0, OUTPUTS)
    assert not any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize("most", [1, 3, 8])
def test_the_number_of_threads_changes_no_bit(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_decoder, "LARGEST", 300)
    inputs, weights = problem(2000)
    expected = differentiated(decode, inputs, weights, torch.float32)
    with ThreadPoolExecutor(most, initializer=torch.set_num_threads, initargs=(1,)) as threads:
        monkeypatch.setattr(torch_decoder, "_threads", lambda: threads)
        found = differentiated(decode, inputs, weights, torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_many_gaussians_keep_no_activations(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are computed again: the same bits, also where a gradient is asked for twice."""
    inputs, weights = problem(1200)
    found, kept = [], []
    for most in (1200, 1199):
        monkeypatch.setattr(torch_decoder, "KEPT", most)
        shapes: list[tuple[int, ...]] = []
        static = inputs[0].clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(lambda x, to=shapes: to.append(tuple(x.shape)) or x, lambda x: x):
            outputs = decode(static, *inputs[1:], weights)
        kept.append((600, WIDTH) in shapes)
        for retain in (True, False):
            found.append(torch.autograd.grad(outputs.square().sum(), static, retain_graph=retain)[0])
    assert kept == [True, False]
    assert all(torch.equal(each, found[0]) for each in found)


def test_gradients_are_recorded_by_the_caller_alone() -> None:
    inputs, weights = problem(1200)
    with torch.no_grad():
        outputs = decode(*inputs, DecoderWeights(*(each.requires_grad_() for each in weights)))
    assert not outputs.requires_grad
