"""The hash encoder's kernels against its torch reference."""

import itertools
import math

import pytest
import torch
from helpers.encoder_reference import encode_reference
from helpers.rounding import divides_exactly
from helpers.scenes import relative
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import TIME, GridShape, HashConfig
from lapgs_wgpu.motion.fields.hash_encoder import HashEncoder, HashGrid

pytestmark = pytest.mark.kernels

BOUND = 1.5


@pytest.fixture(params=[True, False], ids=["lane levels", "fixed point"])
def shaped(request: pytest.FixtureRequest, device: Device, monkeypatch: pytest.MonkeyPatch) -> Device:
    """The device in the encoder's shape for CPU devices, and in that for GPUs."""
    monkeypatch.setattr(device, "is_cpu", request.param)
    return device


# Each with a way of its own through the kernels.
GRIDS: dict[str, tuple[HashConfig, tuple[int, int, int]]] = {
    "dense": (HashConfig(3, (4, 5, 6), (9, 8, 7)), (0, 1, 2)),
    "hashed": (HashConfig(5, (4, 4, 4), (60, 50, 40), table_log2=9), (0, 1, 2)),
    "sliced": (HashConfig(9, (4, 4, 4), (20, 16, 12)), (0, 1, TIME)),
    "sliced and hashed": (HashConfig(4, (6, 6, 6), (40, 30, 30), table_log2=11), (1, 2, TIME)),
    "too large to slice": (HashConfig(3, (8, 8, 4), (200, 150, 9)), (0, 2, TIME)),
    "one level": (HashConfig(1, (7, 7, 7), (7, 7, 7)), (0, 1, 2)),
    "flat in time": (HashConfig(2, (8, 8, 2), (16, 16, 2)), (0, 1, TIME)),
}


def make_grids(*names: str) -> list[HashGrid]:
    """With features of size 1, where training starts at 1e-4."""
    generator = torch.Generator().manual_seed(0)
    grids = [HashGrid(*GRIDS[name], generator) for name in names]
    for grid in grids:
        torch.nn.init.normal_(grid.table, generator=generator)
    return grids


def apart(grids: list[HashGrid]) -> list[list[HashGrid]]:
    """Each with an encoding of its own."""
    return [[grid] for grid in grids]


def random_points(count: int, seed: int = 0) -> Tensor:
    """Most of them inside the box; some outside, some on its faces, edges and corners."""
    generator = torch.Generator().manual_seed(seed)
    points = BOUND * 2.2 * (torch.rand(count, 3, generator=generator) - 0.5)
    points[::17] = points[::17].sign() * BOUND
    points[5::23, 1] = BOUND
    points[7::29, 2] = -BOUND
    return points


def run(encoder: HashEncoder, points: Tensor, time: float, seed: int = 0) -> tuple[list[Tensor], list[Tensor]]:
    """Encodings, and the gradients of the tables for random gradients of the encodings."""
    for grid in encoder.grids:
        grid.table.grad = None
    (encodings,) = encoder.encode_all([(points, time)])
    generator = torch.Generator().manual_seed(seed)
    torch.autograd.backward(encodings, [torch.randn(*e.shape, generator=generator) for e in encodings])
    gradients = [grid.table.grad for grid in encoder.grids]
    return [e.detach() for e in encodings], [torch.empty(0) if g is None else g for g in gradients]


def run_reference(
    grids: list[HashGrid], points: Tensor, time: float, seed: int = 0
) -> tuple[list[Tensor], list[Tensor]]:
    tables = [grid.table.detach().double().requires_grad_() for grid in grids]
    encodings = [encode_reference(g, t, points, time, BOUND) for g, t in zip(grids, tables, strict=True)]
    generator = torch.Generator().manual_seed(seed)
    upstream = [torch.randn(*e.shape, generator=generator).double() for e in encodings]
    return [e.detach() for e in encodings], list(torch.autograd.grad(encodings, tables, upstream))


def check(encoder: HashEncoder, points: Tensor, time: float) -> None:
    # Cells are found in float32, by a division.
    near, gradients_near = (2e-5, 2e-6) if divides_exactly(encoder._device) else (3e-4, 1e-5)
    encodings, gradients = run(encoder, points, time)
    expected, expected_gradients = run_reference(encoder.grids, points, time)
    for found, exact in zip(encodings, expected, strict=True):
        assert found.shape == exact.shape
        torch.testing.assert_close(found.double(), exact, rtol=0, atol=near)
    for found, exact in zip(gradients, expected_gradients, strict=True):
        assert found.shape == exact.shape
        assert relative(found, exact) < gradients_near


# The reference against a loop over points, levels and corners, in plain numbers


def encode_by_hand(grid: HashGrid, table: list[list[float]], point: list[float], time: float) -> list[float]:
    unit = [(point[axis] + BOUND) / (2 * BOUND) if axis != TIME else time for axis in grid.axes]
    out: list[float] = []
    for level in grid.levels:
        sums = [0.0, 0.0]
        if all(0 <= u <= 1 for u in unit):
            places = [u * scale for u, scale in zip(unit, level.scale, strict=True)]
            for corner in itertools.product((0, 1), repeat=3):
                weight, at = 1.0, []
                for place, side, size in zip(places, corner, level.resolution, strict=True):
                    f = place - math.floor(place)
                    up = f * f * (3 - 2 * f)
                    weight *= up if side else 1 - up
                    at.append(min(math.floor(place) + side, size - 1))
                x, y, z = at
                index = x + level.resolution[0] * (y + level.resolution[1] * z)
                if math.prod(level.resolution) > level.entries:
                    index = (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % level.entries
                for feature in range(2):
                    sums[feature] += weight * table[level.first + index][feature]
        out += sums
    return out


@pytest.mark.parametrize("name", GRIDS)
def test_the_reference_is_the_loop(name: str) -> None:
    (grid,) = make_grids(name)
    points = random_points(40).double()
    table = grid.table.detach().double()
    found, entries = encode_reference(grid, table, points, 0.37, BOUND), table.tolist()
    for row, point in zip(found.tolist(), points.tolist(), strict=True):
        assert row == pytest.approx(encode_by_hand(grid, entries, point, 0.37), abs=1e-9)


# Against the reference


@pytest.mark.parametrize("name", GRIDS)
def test_each_kind_of_grid(shaped: Device, name: str) -> None:
    encoder = HashEncoder(shaped, apart(make_grids(name)), BOUND)
    for time in (0.0, 0.37, 1.0):
        check(encoder, random_points(700), time)


def test_several_grids_at_once(shaped: Device) -> None:
    grids = make_grids("dense", "sliced", "sliced and hashed", "too large to slice", "hashed")
    encoder = HashEncoder(shaped, apart(grids), BOUND)
    check(encoder, random_points(2000), 0.613)


def test_grids_of_a_group_lie_beside_one_another(shaped: Device) -> None:
    names = ("dense", "sliced", "sliced and hashed", "hashed")
    points, time = random_points(900), 0.613
    encodings, upstream, gradients = [], [], []
    for group in (apart, lambda grids: [grids[:1], grids[1:]]):
        encoder = HashEncoder(shaped, group(make_grids(*names)), BOUND)
        (found,) = encoder.encode_all([(points, time)])
        encodings.append(torch.cat(found, dim=1))
        generator = torch.Generator().manual_seed(0)
        upstream = list(torch.randn(encodings[0].shape, generator=generator).split([e.shape[1] for e in found], dim=1))
        gradients.append(encoder.backward([(points, time)], upstream))
    assert torch.equal(*encodings)
    for a, b in zip(*gradients, strict=True):
        assert torch.equal(a, b) if shaped.is_cpu else relative(a, b) < 1e-6  # fixed point has a scale for each group


def test_rows_beyond_a_binding_are_taken_in_blocks(shaped: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    groups = [make_grids("dense", "sliced"), make_grids("hashed")]
    encoder, points = HashEncoder(shaped, groups, BOUND), random_points(40_000)
    whole = run(encoder, points, 0.37)
    largest = 16 * max(grid.entries for grid in encoder.grids)  # of what cannot be cut, in 64 bits
    assert 40_000 * 4 * whole[0][0].shape[1] > 2 * largest
    monkeypatch.setattr(Device, "max_binding", largest)
    parts = run(encoder, points, 0.37)
    for a, b in zip((*whole[0], *whole[1]), (*parts[0], *parts[1]), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("count", [0, 1, 65, 513])
def test_any_number_of_points(shaped: Device, count: int) -> None:
    encoder = HashEncoder(shaped, apart(make_grids("sliced", "hashed")), BOUND)
    check(encoder, 0.5 * random_points(count, seed=count), 0.9)


def test_all_points_in_one_cell(shaped: Device) -> None:
    """A few entries take the sums of all points."""
    encoder = HashEncoder(shaped, apart(make_grids("sliced", "hashed")), BOUND)
    check(encoder, 0.2 + 1e-4 * random_points(3000), 0.5)


# Known values


def test_nothing_outside_the_box(shaped: Device) -> None:
    inside = 0.9 * BOUND * (torch.rand(50, 3) - 0.5)
    beyond = torch.tensor([[1.01, 0, 0], [0, -1.01, 0], [0, 0, 5.0], [-3, 3, -3], [math.nan, 0, 0], [0, math.inf, 0]])
    encoder = HashEncoder(shaped, apart(make_grids("dense", "sliced")), BOUND)
    alone = run(encoder, inside, 0.3)
    found, gradients = run(encoder, torch.cat([inside, BOUND * beyond]), 0.3)
    # "sliced" covers x, y and time alone: z may be anything there.
    over_xy = torch.tensor([False, False, True, False, False, False])
    assert not found[0][50:].any()
    assert not found[1][50:][~over_xy].any()
    assert found[1][50:][over_xy].any()
    for encoding, expected in zip(found, alone[0], strict=True):
        assert torch.equal(encoding[:50], expected)
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_levels_grow_from_the_coarsest_to_the_finest() -> None:
    levels = GridShape(HashConfig(5, (4, 6, 8), (64, 6, 128), table_log2=12), (0, 1, 2)).levels
    assert levels[0].resolution == (4, 6, 8)
    assert levels[-1].resolution == (64, 6, 128)
    assert [level.resolution[0] for level in levels] == [4, 8, 16, 32, 64]
    assert [level.first for level in levels] == [sum(other.entries for other in levels[:i]) for i in range(5)]
    assert all(level.entries == min(4096, math.prod(level.resolution)) for level in levels)


# The same bits


def test_the_same_bits_again(shaped: Device) -> None:
    names = ("sliced", "sliced and hashed", "too large to slice", "hashed")
    points = random_points(3000)
    encoder = HashEncoder(shaped, apart(make_grids(*names)), BOUND)
    first = run(encoder, points, 0.4)
    run(encoder, random_points(5000, seed=1), 0.9)
    run(encoder, random_points(10, seed=2), 0.0)
    again = run(encoder, points, 0.4)
    fresh = run(HashEncoder(shaped, apart(make_grids(*names)), BOUND), points, 0.4)
    for other in (again, fresh):
        for a, b in zip((*first[0], *first[1]), (*other[0], *other[1]), strict=True):
            assert torch.equal(a, b)


def test_fixed_point_does_not_depend_on_the_order(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Integer sums: the points in any order give the same bits, which sums of floats do not."""
    monkeypatch.setattr(device, "is_cpu", False)
    points, names = random_points(3000), ("hashed", "sliced")
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(0))
    encoder = HashEncoder(device, apart(make_grids(*names)), BOUND)
    upstream = [torch.randn(3000, grid.features, generator=torch.Generator().manual_seed(1)) for grid in encoder.grids]
    forwards = encoder.backward([(points, 0.4)], upstream)
    shuffled = encoder.backward([(points[order], 0.4)], [d[order] for d in upstream])
    assert torch.equal(forwards[0], shuffled[0])
    assert torch.equal(forwards[1], shuffled[1])


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_gradients_of_any_size(shaped: Device, size: float) -> None:
    encoder = HashEncoder(shaped, apart(make_grids("sliced", "hashed")), BOUND)
    points = random_points(500)
    upstream = [torch.randn(500, grid.features, generator=torch.Generator().manual_seed(1)) for grid in encoder.grids]
    plain = encoder.backward([(points, 0.4)], upstream)
    scaled = encoder.backward([(points, 0.4)], [size * d for d in upstream])
    for a, b in zip(plain, scaled, strict=True):
        assert relative(b.double() / size, a) < 1e-5
    assert not any(d.any() for d in encoder.backward([(points, 0.4)], [0 * d for d in upstream]))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_gradients_that_are_not_finite_stay_so(shaped: Device, bad: float) -> None:
    grids = make_grids("dense", "sliced")
    encoder = HashEncoder(shaped, apart(grids), BOUND)
    (encodings,) = encoder.encode_all([(random_points(100), 0.4)])
    upstream = [torch.ones_like(e) for e in encodings]
    for d in upstream:
        d[40, 3] = bad
    for gradient in torch.autograd.grad(encodings, [grid.table for grid in grids], upstream):
        assert not gradient.isfinite().all()


def test_small_gradients_beside_large_ones(shaped: Device) -> None:
    """Seven orders of magnitude between points: the small ones are still there, each in its own entries."""
    encoder = HashEncoder(shaped, apart(make_grids("dense")), BOUND)
    points = torch.tensor([[-1.4, -1.4, -1.4], [1.4, 1.4, 1.4]])
    upstream = torch.ones(2, encoder.grids[0].features)
    upstream[1] *= 1e-7
    (found,) = encoder.backward([(points, 0.0)], [upstream])
    alone = encoder.backward([(points[1:], 0.0)], [upstream[1:]])[0]
    rows = alone.abs().sum(1) > 0
    rows &= encoder.backward([(points[:1], 0.0)], [upstream[:1]])[0].abs().sum(1) == 0
    assert rows.any()
    torch.testing.assert_close(found[rows], alone[rows], rtol=1e-5, atol=0)


# As part of torch


def test_gradients_reach_the_tables_and_not_the_points(device: Device) -> None:
    grids = make_grids("dense", "sliced")
    encoder = HashEncoder(device, apart(grids), BOUND)
    points = random_points(100).requires_grad_()
    ((first, _),) = encoder.encode_all([(points, 0.2)])
    first.square().sum().backward()
    assert points.grad is None
    assert grids[0].table.grad is not None
    assert grids[0].table.grad.any()
    second = grids[1].table.grad
    assert second is None or not second.any()


def test_tables_are_read_anew_at_each_call(device: Device) -> None:
    grids = make_grids("dense", "sliced")
    encoder = HashEncoder(device, apart(grids), BOUND)
    points = random_points(50)
    before = [e.detach() for e in encoder.encode_all([(points, 0.2)])[0]]
    with torch.no_grad():
        for grid in grids:
            grid.table *= 2
    for a, b in zip(before, encoder.encode_all([(points, 0.2)])[0], strict=True):
        torch.testing.assert_close(2 * a, b.detach())
