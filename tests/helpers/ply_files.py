"""PLY files, whole and damaged."""

import struct
import tracemalloc
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.checkpoint import read_checkpoint
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.io.ply_elements import PathLike

FIELDS = ["means", "sh", "opacity_logits", "log_scales", "quats"]
# Written out by hand, so that it checks the code's own lists.
INRIA = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 "
    + " ".join(f"f_rest_{i}" for i in range(45))
    + " opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
).split()


def read_ply(path: PathLike) -> GaussianSnapshot:
    """The Gaussians of any 3DGS .ply."""
    return read_checkpoint(path).still


def random_still(n: int = 5, degree: int = 3, seed: int = 0) -> GaussianSnapshot:
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape, np.float32)

    return GaussianSnapshot(floats(n, 3), floats(n, (degree + 1) ** 2, 3), floats(n), floats(n, 3), floats(n, 4))


def assert_same(a: GaussianSnapshot, b: GaussianSnapshot) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def ply_bytes(columns: Mapping[str, tuple[str, Sequence[float] | np.ndarray]]) -> bytes:
    """A vertex-only .ply of columns {name: (PLY type, values)}, packed by struct: nothing shared with the reader."""
    codes = {"uchar": "B", "short": "h", "int": "i", "uint": "I", "float": "f", "double": "d", "float32": "f"}
    n = len(next(iter(columns.values()))[1])
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    head += "".join(f"property {kind} {name}\n" for name, (kind, _) in columns.items()) + "end_header\n"
    row = struct.Struct("<" + "".join(codes[kind] for kind, _ in columns.values()))
    return head.encode() + b"".join(row.pack(*(v[i] for _, v in columns.values())) for i in range(n))


def columns_of(still: GaussianSnapshot) -> dict[str, tuple[str, np.ndarray]]:
    """The columns of `still` in Inria's order, without normals."""
    values = dict(zip(["x", "y", "z"], still.means.T, strict=True))
    values |= {f"f_dc_{c}": still.sh[:, 0, c] for c in range(3)}
    k = still.sh.shape[1] - 1
    values |= {f"f_rest_{c * k + i}": still.sh[:, 1 + i, c] for c in range(3) for i in range(k)}
    values["opacity"] = still.opacity_logits
    values |= {f"scale_{i}": still.log_scales[:, i] for i in range(3)} | {
        f"rot_{i}": still.quats[:, i] for i in range(4)
    }
    return {name: ("float", column) for name, column in values.items()}


GOOD = ply_bytes(columns_of(random_still(4, 1)))
SPLIT = GOOD.index(b"end_header\n")


def refused_within(path: Path, named: str, peak_limit: int) -> None:
    """Reading a .ply or a checkpoint ends in one sentence of its path and these words, and takes no more memory."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            read_checkpoint(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 400
    assert named in text
    assert peak < peak_limit
