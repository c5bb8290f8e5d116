"""PLY files, whole and damaged."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np
from hypothesis import strategies as st

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
WORDS = [
    b"", b"0", b"-1", b"4294967296", b"1e9", b"element x 3\n", b"property uchar q\n", b"property list int int q\n",
    b"end_header\n", b"\r\n", b"comment lapgs4d v1 safetensors 9\n", b"double", b"\x00", b"\x00\x00\x80\x7f",
]  # fmt: skip


def mutate(data: bytes, draw: st.DataObject) -> bytes:
    """One to four cuts, insertions and replacements, half of them in the header's text."""
    for _ in range(draw.draw(st.integers(1, 4))):
        end = len(data) if draw.draw(st.booleans()) else min(len(data), SPLIT)
        begin = draw.draw(st.integers(0, end))
        length = draw.draw(st.sampled_from([0, 1, 2, 4, 16, 92, 10**6]))
        new = draw.draw(st.sampled_from(WORDS) | st.binary(max_size=6))
        data = data[:begin] + new + data[begin + length :]
    return data
