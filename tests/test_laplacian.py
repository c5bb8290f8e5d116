"""The Laplacian motion module: its series, eq. 5's gradient of the frequencies, and how they are moved."""

import math

import pytest
import torch
from torch import Tensor, nn

from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion, TimeMotion
from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.optimizer import FrequencyOptimizer

K, WIDTH, INPUTS = 5, 6, 4


def motion(frequencies: list[float] | None = None, seed: int = 0) -> LaplacianMotion:
    made = LaplacianMotion(INPUTS, FieldConfig(width=WIDTH, components=K), torch.Generator().manual_seed(seed)).double()
    if frequencies is not None:
        with torch.no_grad():
            made.frequencies.copy_(torch.tensor(frequencies))
    return made


STATIC = torch.rand(7, INPUTS, generator=torch.Generator().manual_seed(9), dtype=torch.float64)


def features(m: LaplacianMotion | TimeMotion, t: float) -> Tensor:
    first, second = m.layers(t)
    return nn.functional.linear(torch.relu(nn.functional.linear(STATIC, *first)), *second)


def test_the_spectrum_at_the_start() -> None:
    """Whole cycles, faint in all, and falling like 1 / f whatever the number of components is."""
    assert motion().frequencies.tolist() == [0, 1, 2, 3, 4]
    wide = LaplacianMotion(
        2, FieldConfig(width=4000, components=25, frequency_step=0.5), torch.Generator().manual_seed(0)
    )
    assert wide.frequencies.tolist() == [0.5 * k for k in range(25)]
    assert float(wide.series(0.3).detach().std()) == pytest.approx(0.3, rel=0.05)
    amplitudes = (wide.alpha.square() + wide.beta.square()).mean(dim=1).sqrt().detach()
    for k in (2, 5, 24):
        assert float(amplitudes[1] / amplitudes[k]) == pytest.approx(k, rel=0.05)


@pytest.mark.parametrize("t", [0.0, 0.17, 1.0])
def test_the_series_written_out(t: float) -> None:
    m = motion([0.3, 1.1, 2.0, 3.7, 4.0])
    expected = torch.zeros(WIDTH, dtype=torch.float64)
    for k, f in enumerate(m.frequencies.tolist()):
        expected += m.alpha[k] * math.cos(2 * math.pi * f * t) + m.beta[k] * math.sin(2 * math.pi * f * t)
    torch.testing.assert_close(m.series(t), expected)


def test_features_are_the_series_times_a_part_of_each_gaussian() -> None:
    m, t = motion(), 0.4
    weights = dict(m.named_parameters())
    inner = torch.relu(STATIC @ weights["first.weight"].T + weights["first.bias"])
    part = inner @ weights["second.weight"].T + weights["second.bias"]
    torch.testing.assert_close(features(m, t), m.series(t) * part)


def test_the_stand_in_is_an_mlp_of_features_and_time() -> None:
    m, t = TimeMotion(INPUTS, FieldConfig(width=WIDTH), torch.Generator().manual_seed(3)).double(), 0.6
    inner = torch.relu(m.first(torch.cat([STATIC, torch.full((len(STATIC), 1), t)], dim=1)))
    torch.testing.assert_close(features(m, t), m.second(inner))


# Equation 5


def loss_at(m: LaplacianMotion, frequencies: Tensor) -> float:
    with torch.no_grad():
        m.frequencies.copy_(frequencies)
        return float(features(m, 0.37).sin().sum())


def test_the_frequency_gradient_is_eq_5() -> None:
    """Finite differences over 2 pi sigma_k^2, with sigma_k^2 = the variance over whole periods of each component."""
    m = motion([0.3, 1.1, 2.0, 3.7, 4.0])
    with torch.no_grad():
        m.alpha[2] *= 1.7
    features(m, 0.37).sin().sum().backward()
    found = m.frequency_gradient()
    times = torch.arange(1000, dtype=torch.float64) / 1000
    start = m.frequencies.detach().clone()
    for k in range(K):
        up, down = start.clone(), start.clone()
        up[k] += 1e-5
        down[k] -= 1e-5
        slope = (loss_at(m, up) - loss_at(m, down)) / 2e-5
        phase = 2 * math.pi * times[:, None]  # one cycle: the variance does not depend on the frequency
        component = phase.cos() * m.alpha[k].detach() + phase.sin() * m.beta[k].detach()
        variance = float(component.var(dim=0, unbiased=False).mean()) + 1e-4
        assert float(found[k]) == pytest.approx(slope / (2 * math.pi * variance), rel=1e-5)


def test_variances_stay_within_a_factor_of_their_middle() -> None:
    m = motion()
    with torch.no_grad():
        m.alpha.fill_(0.3)
        m.beta.fill_(0.3)
        m.alpha[0] = m.beta[0] = 0.0
        m.alpha[1] = m.beta[1] = 30.0
    variances = m.variances()
    raw = 0.5 * (m.alpha.square() + m.beta.square()).mean(dim=1).detach() + 1e-4
    middle = float(raw.log().mean().exp())
    assert float(variances[0]) == pytest.approx(middle / 10)
    assert float(variances[1]) == pytest.approx(middle * 10)
    torch.testing.assert_close(variances[2:], raw[2:])


# The optimizer of the frequencies

STEADY = Rate(1e-3, 1e-3, 1)


def test_faint_components_move_further() -> None:
    """The factor 1 / sigma_k^2 survives: with a second moment each, Adam's first step would be the rate for all."""
    m = motion()
    with torch.no_grad():
        m.alpha.fill_(0.5)
        m.beta.fill_(0.5)
        m.alpha[3] = m.beta[3] = 0.25
    before = m.frequencies.detach().clone()
    m.frequencies.grad = torch.ones_like(m.frequencies)
    FrequencyOptimizer(m, STEADY, limit=100).step(1)
    moved = (before - m.frequencies.detach())[1:]
    ratio = float(m.variances()[0] / m.variances()[3])
    assert ratio > 3
    assert float(moved[2] / moved[0]) == pytest.approx(ratio)
    gradient = 1 / (2 * math.pi * m.variances())
    torch.testing.assert_close(moved, (1e-3 * gradient / gradient.square().mean().sqrt())[1:])
    assert m.frequencies.grad is None


def test_frequencies_stay_below_nyquist_and_steps_are_bounded() -> None:
    m = motion([0.001, 1.0, 2.0, 3.0, 3.999])
    m.frequencies.grad = torch.tensor([1e3, 0, 0, 0, -1e3], dtype=torch.float64)
    FrequencyOptimizer(m, Rate(10.0, 10.0, 1), limit=4.0).step(1)
    assert m.frequencies.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    m.frequencies.grad = torch.tensor([-1e3, 0, 0, 0, 1e3], dtype=torch.float64)
    FrequencyOptimizer(m, Rate(10.0, 10.0, 1), limit=4.0).step(1)
    assert m.frequencies.tolist() == pytest.approx([0.02, 1.0, 2.0, 3.0, 3.98])


@pytest.mark.nightly
def test_frequencies_find_a_motion() -> None:
    """Two tones of 1.3 and 2.6 cycles from a start at 1 and 3: the factor does not keep them from converging."""
    generator = torch.Generator().manual_seed(2)
    m = LaplacianMotion(INPUTS, FieldConfig(width=WIDTH, components=2), torch.Generator().manual_seed(0))
    with torch.no_grad():
        m.frequencies.copy_(torch.tensor([1.0, 3.0]))
    mixing = torch.randn(2, WIDTH, generator=torch.Generator().manual_seed(1))
    waves = torch.optim.Adam([m.alpha, m.beta], lr=1e-2)
    frequencies = FrequencyOptimizer(m, Rate(4e-3, 4e-4, 3000), limit=20)
    for step in range(1, 3001):
        t = float(torch.rand((), generator=generator))
        target = mixing[0] * math.sin(2 * math.pi * 1.3 * t) + mixing[1] * math.cos(2 * math.pi * 2.6 * t)
        waves.zero_grad()
        (m.series(t) - target).square().mean().backward()
        waves.step()
        frequencies.step(step)
    assert sorted(m.frequencies.tolist()) == pytest.approx([1.3, 2.6], rel=0.02)
