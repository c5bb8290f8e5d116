"""Matrix products on the device, and sums of columns."""

from dataclasses import dataclass, replace

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
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


def multiply(
    commands: Commands, pool: BufferPool, a: Matrix, b: Matrix, c: Matrix, *, add: bool = False, split: int = 0
) -> None:
    """Record c = a b, or c += a b with `add`; c must not be transposed. Sums have a fixed order, hence the same bits.

    split: inner elements of each of the partial sums, which follow one another in c; 0: all.
    """
    split = split or a.columns
    kernel = Kernel.get(pool.device, "matmul", ADD=add, A_INNER=not a.transposed, B_INNER=b.transposed)
    sizes = {"rows": c.rows, "columns": c.columns, "inner": a.columns, "split": split}
    places = {"a_stride": a.stride, "b_stride": b.stride, "c_stride": c.stride, "c_part": c.rows * c.columns}
    content = kernel.uniform("Matmul", **sizes, **places, first=(a.first, b.first, c.first, 0))
    groups = -(-c.rows // _TILE) * -(-c.columns // _TILE) * -(-a.columns // split)
    commands.dispatch(kernel, groups, product=pool.constant(content), a=a.array, b=b.array, c=c.array)


def multiply_long(commands: Commands, pool: BufferPool, a: Matrix, b: Matrix, c: Matrix, *, add: bool = False) -> None:
    """Record `multiply` for a long inner dimension.

    The dimension is split, which occupies the device and keeps partial sums short, hence accurate.
    """
    count = -(-a.columns // _SPLIT)
    parts = pool.array("parts", (count, a.rows, b.columns))
    multiply(commands, pool, a, b, Matrix(parts, a.rows, b.columns, b.columns), split=_SPLIT)
    kernel = Kernel.get(pool.device, "matmul_sum", ADD=add)
    place = {"columns": c.columns, "stride": c.stride, "first": c.first}
    uniform = pool.constant(kernel.uniform("Sum", count=a.rows * b.columns, parts=count, **place))
    commands.dispatch(kernel, -(-a.rows * b.columns // 64), sum=uniform, parts=parts, total=c.array)


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
    kernel = Kernel.get(pool.device, "sum_values")
    content = kernel.uniform("Values", rows=values.size // columns, columns=columns, place=place, factor=factor)
    commands.dispatch(kernel, columns, sum=pool.constant(content), values=values, totals=totals)
