"""Matrix products on the device, and sums of columns."""

from dataclasses import dataclass, replace

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel

_TILE = 64  # matmul.wgsl
_SPLIT = 1 << 11  # inner elements of a partial sum where the inner dimension is split


@dataclass(frozen=True)
class Matrix:
    """A float32 matrix stored in an array: rows of `stride` floats, the first of them `first` floats after its start.

    transposed: the columns are stored this way instead.
    """

    array: DeviceArray
    rows: int
    columns: int
    stride: int
    first: int = 0
    transposed: bool = False

    @staticmethod
    def of(array: DeviceArray) -> "Matrix":
        """Return a whole array (rows, columns)."""
        rows, columns = array.shape
        return Matrix(array, rows, columns, columns)

    @property
    def transpose(self) -> "Matrix":
        """The same memory with rows and columns exchanged."""
        return replace(self, rows=self.columns, columns=self.rows, transposed=not self.transposed)

    def from_column(self, first: int, count: int) -> "Matrix":
        """`count` columns from column `first` on; the matrix must not be transposed."""
        return replace(self, first=self.first + first, columns=count)


class Matmul:
    """Records matrix products. Sums have a fixed order, so results are the same to the last bit on every run."""

    def __init__(self, device: Device, pool: BufferPool) -> None:
        self._device, self._pool = device, pool

    def __call__(self, commands: Commands, a: Matrix, b: Matrix, c: Matrix, *, add: bool = False) -> None:
        """Record c = a b, or c += a b with `add`. c must not be transposed."""
        self._dispatch(commands, a, b, c, a.columns, add=add)

    def split_k(self, commands: Commands, a: Matrix, b: Matrix, c: Matrix, *, add: bool = False) -> None:
        """Record c = a b, or c += a b with `add`, for a long inner dimension.

        The dimension is split, which occupies the device and keeps partial sums short, hence accurate.
        """
        count = -(-a.columns // _SPLIT)
        parts = self._pool.array("parts", (count, a.rows, b.columns))
        self._dispatch(commands, a, b, Matrix(parts, a.rows, b.columns, b.columns), _SPLIT)
        kernel = Kernel.get(self._device, "matmul_sum", ADD=add)
        place = {"columns": c.columns, "stride": c.stride, "first": c.first}
        uniform = self._pool.constant(kernel.uniform("Sum", count=a.rows * b.columns, parts=count, **place))
        commands.dispatch(kernel, -(-a.rows * b.columns // 64), sum=uniform, parts=parts, total=c.array)

    def _dispatch(self, commands: Commands, a: Matrix, b: Matrix, c: Matrix, split: int, *, add: bool = False) -> None:
        kernel = Kernel.get(self._device, "matmul", ADD=add, A_INNER=not a.transposed, B_INNER=b.transposed)
        sizes = {"rows": c.rows, "columns": c.columns, "inner": a.columns, "split": split}
        places = {"a_stride": a.stride, "b_stride": b.stride, "c_stride": c.stride, "c_part": c.rows * c.columns}
        first = (a.first, b.first, c.first, 0)
        product = self._pool.constant(kernel.uniform("Matmul", **sizes, **places, first=first))
        groups = -(-c.rows // _TILE) * -(-c.columns // _TILE) * -(-a.columns // split)
        commands.dispatch(kernel, groups, product=product, a=a.array, b=b.array, c=c.array)


def sum_columns(
    commands: Commands,
    pool: BufferPool,
    values: DeviceArray,
    totals: DeviceArray,
    *,
    columns: int = 1,
    place: int = 0,
    factor: float = 1.0,
) -> None:
    """Record the sums of the columns of values, times a factor, into `totals` from `place` on."""
    kernel = Kernel.get(commands.device, "sum_values")
    content = kernel.uniform("Values", rows=values.size // columns, columns=columns, place=place, factor=factor)
    commands.dispatch(kernel, columns, sum=pool.constant(content), values=values, totals=totals)
