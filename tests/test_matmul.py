"""Products of matrices on the device against torch in float64."""

import numpy as np
import pytest
import torch
from helpers.matrices import on_device, random, read
from helpers.scenes import relative
from torch import Tensor

from lapgs_wgpu.gpu import matmul
from lapgs_wgpu.gpu.array import BufferPool
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.matmul import Matrix, multiply, multiply_long

pytestmark = pytest.mark.kernels


def stored(device: Device, tensor: Tensor, *, transposed: bool) -> Matrix:
    if transposed:
        return Matrix.of(on_device(device, tensor.T)).transpose
    return Matrix.of(on_device(device, tensor))


@pytest.mark.parametrize("a_transposed", [False, True])
@pytest.mark.parametrize("b_transposed", [False, True])
@pytest.mark.parametrize(
    ("rows", "inner", "columns"),
    [(1, 1, 1), (64, 16, 64), (65, 17, 63), (130, 5, 200), (3, 100, 70)],
)
def test_product(
    device: Device, rows: int, inner: int, columns: int, *, a_transposed: bool, b_transposed: bool
) -> None:
    a, b = random(rows, inner), random(inner, columns, seed=1)
    of_a, of_b = stored(device, a, transposed=a_transposed), stored(device, b, transposed=b_transposed)
    start = random(rows, columns, seed=2)
    fresh, added = on_device(device, torch.full_like(start, torch.nan)), on_device(device, start)
    pool = BufferPool(device)
    with Commands(device) as commands:
        multiply(commands, pool, of_a, of_b, Matrix.of(fresh))
        multiply(commands, pool, of_a, of_b, Matrix.of(added), add=True)
    exact = a.double() @ b.double()
    assert relative(read(fresh), exact) < 1e-6
    assert relative(read(added), start.double() + exact) < 1e-6


def test_parts_of_matrices(device: Device) -> None:
    """Some rows, and some columns; what lies beside the part of the result stays as it is."""
    a, b, c = random(150, 40), random(33, 90, seed=1), random(140, 80, seed=2)
    result = on_device(device, c)
    with Commands(device) as commands:
        multiply(
            commands,
            BufferPool(device),
            Matrix.of(on_device(device, a).rows(64, 70)).from_column(3, 33),
            Matrix.of(on_device(device, b)).from_column(20, 65),
            Matrix.of(result.rows(64, 70)).from_column(11, 65),
        )
    expected = c.double()
    expected[64:134, 11:76] = a[64:134, 3:36].double() @ b[:, 20:85].double()
    found = read(result)
    assert relative(found, expected) < 1e-6
    untouched = torch.ones_like(c, dtype=torch.bool)
    untouched[64:134, 11:76] = False
    assert torch.equal(found[untouched], c[untouched])


@pytest.mark.parametrize("inner", [1, 99, 100, 101, 350])
def test_long_products_are_sums_of_parts(device: Device, inner: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sum over Gaussians of a gradient: a is transposed, b is not; the same to the last bit each time."""
    monkeypatch.setattr(matmul, "_SPLIT", 100)
    a, b, start = random(inner, 70), random(inner, 9, seed=1), random(70, 15, seed=2)
    fresh, added = on_device(device, torch.full((70, 9), torch.nan)), on_device(device, start)
    of_a, of_b = (Matrix.of(on_device(device, x)) for x in (a, b))
    pool = BufferPool(device)
    runs = []
    for _ in range(2):
        with Commands(device) as commands:
            multiply_long(commands, pool, of_a.transpose, of_b, Matrix.of(fresh))
        runs.append(read(fresh))
    with Commands(device) as commands:
        multiply_long(commands, pool, of_a.transpose, of_b, Matrix.of(added).from_column(4, 9), add=True)
    exact = a.double().T @ b.double()
    assert torch.equal(*runs)
    assert relative(runs[0], exact) < 1e-6
    assert relative(read(added), start.double() + torch.nn.functional.pad(exact, (4, 2))) < 1e-6


def test_long_sums_are_accurate(device: Device) -> None:
    """Of 20,000 like numbers, which one float32 after the other would sum up with an error of 1e-4."""
    ones = torch.full((20_000, 1), 0.1)
    total = on_device(device, torch.zeros(1, 1))
    column = Matrix.of(on_device(device, ones))
    with Commands(device) as commands:
        multiply_long(commands, BufferPool(device), column.transpose, column, Matrix.of(total))
    assert float(read(total)) == pytest.approx(20_000 * float(np.float32(0.1)) ** 2, rel=2e-5)
