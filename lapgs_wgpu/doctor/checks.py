"""Kernels against answers that are known without running them: closed forms, sorted lists, identities.

Each check draws or computes something small with the kernels of a training, and returns the largest error. The tests of
the repository are stricter; this says within seconds whether a driver can be trusted at all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.matmul import Matmul, Matrix
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.gpu.radix_sort import RadixSort
from lapgs_wgpu.gpu.scan import Scan
from lapgs_wgpu.motion.fields.hash_encoder import HashEncoder, HashGrid
from lapgs_wgpu.motion.fields.hash_grid_config import TIME, HashConfig
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.raster_config import raster_config
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.image_loss import ImageLoss
from lapgs_wgpu.train.truth_cache import upload_rgba

Array = NDArray[np.float64]


class Check(NamedTuple):
    """run: returns the largest error. allowed: the error from which on the check fails."""

    name: str
    run: Callable[[Device], float]
    allowed: float


def scan(device: Device) -> float:
    """Prefix sums of 100,000 integers; the number of wrong ones."""
    values = (np.arange(100_000) % 7).astype(np.uint32)
    pool = BufferPool(device)
    prefix, total = pool.array("prefix", values.shape, "uint32"), pool.array("total", (1,), "uint32")
    length = DeviceArray.upload(device, "length", np.array([values.size], np.uint32))
    with Commands(device) as commands:
        Scan(device, pool, "doctor")(
            commands,
            length=length,
            capacity=values.size,
            values=DeviceArray.upload(device, "values", values),
            prefix=prefix,
            total=total,
        )
    sums = np.concatenate([[0], np.cumsum(values)])
    return float(np.count_nonzero(prefix.read() != sums[:-1]) + (total.read()[0] != sums[-1]))


def radix_sort(device: Device) -> float:
    """A stable sort of 100,000 keys with many ties; the number of wrong places."""
    keys = np.random.default_rng(0).integers(0, 1 << 12, 100_000, dtype=np.uint32)
    pool = BufferPool(device)
    length = DeviceArray.upload(device, "length", np.array([keys.size], np.uint32))
    uploaded = DeviceArray.upload(device, "unsorted keys", keys)
    sort = RadixSort(device, pool, "doctor", lane_runs=raster_config(device).lane_runs)
    with Commands(device) as commands:
        _, order = sort(commands, length=length, capacity=keys.size, bits=12, keys=uploaded, payload=None)
    return float(np.count_nonzero(order.read() != np.argsort(keys, kind="stable")))


def matmul(device: Device) -> float:
    """A product of matrices of small integers, which float32 holds exactly."""
    rng = np.random.default_rng(0)
    a, b = (rng.integers(-8, 9, shape).astype(np.float32) for shape in ((130, 70), (70, 90)))
    pool = BufferPool(device)
    product = pool.array("c", (130, 90))
    with Commands(device) as commands:
        left, right = (Matrix.of(DeviceArray.upload(device, name, values)) for name, values in (("a", a), ("b", b)))
        Matmul(device, pool)(commands, "doctor", left, right, Matrix.of(product))
    return float(np.abs(product.read() - a @ b).max())


# Two Gaussians on the optical axis: their projections are axis-aligned ellipses, so image and gradients have closed
# forms. The far one comes first, so that only the depth sort puts them in order.
_FOCAL, _WIDTH, _HEIGHT = 64.0, 70, 50
_DEPTHS, _OPACITIES = np.array([6.0, 4.0]), np.array([0.6, 0.8])
_SCALES = np.array([[0.5, 0.7, 0.2], [0.3, 0.2, 0.1]])
_COLORS = np.array([[0.1, 0.9, 0.3], [1.0, 0.2, 0.4]])
_BACKGROUND = np.array([0.2, 0.1, 0.6])


class _TwoGaussians:
    """The known image, and what its gradients need. Index 0 is the far Gaussian. Planes are (H, W)."""

    def __init__(self) -> None:
        self.x = np.arange(_WIDTH)[None] + 0.5 - _WIDTH / 2
        self.y = np.arange(_HEIGHT)[:, None] + 0.5 - _HEIGHT / 2
        self.magnification = _FOCAL / _DEPTHS
        self.variances = (self.magnification[:, None] * _SCALES[:, :2]) ** 2 + CONSTANTS["DILATION"]  # (2, 2), px^2
        alphas = []
        for (xx, yy), opacity in zip(self.variances, _OPACITIES, strict=True):
            alpha = opacity * np.exp(-0.5 * (self.x**2 / xx + self.y**2 / yy))
            alphas.append(np.where(alpha >= CONSTANTS["ALPHA_MIN"], alpha, 0.0))
        self.far, self.near = alphas
        self.behind = self.far[..., None] * _COLORS[0] + (1 - self.far[..., None]) * _BACKGROUND  # (H, W, 3)
        self.image = self.near[..., None] * _COLORS[1] + (1 - self.near[..., None]) * self.behind
        self.depth = self.near * _DEPTHS[1] + (1 - self.near) * self.far * _DEPTHS[0]

    def gradients(self, weights: Array) -> dict[str, Array]:
        """Gradients of sum(weights * image), weights (H, W, 3): colors (2, 3) and opacities (2,); mean (3,), scale (3,)
        and the z of the quaternion (1,) of the near Gaussian."""
        left = (1 - self.near)[..., None]
        d_near = (weights * (_COLORS[1] - self.behind)).sum(-1)
        d_far = (weights * left * (_COLORS[0] - _BACKGROUND)).sum(-1)
        shares = (left * self.far[..., None], self.near[..., None])
        (xx, yy), (sx, sy, _), m, z = self.variances[1], _SCALES[1], self.magnification[1], _DEPTHS[1]
        by_exponent = d_near * self.near
        by_xx = (by_exponent * 0.5 * self.x**2 / xx**2).sum()
        by_yy = (by_exponent * 0.5 * self.y**2 / yy**2).sum()
        by_xy = (by_exponent * self.x * self.y / (xx * yy)).sum()
        by_z = -2 * m**2 / z * (by_xx * sx**2 + by_yy * sy**2)
        return {
            "colors": np.stack([(weights * share).sum((0, 1)) for share in shares]),
            "opacities": np.array([(d_far * self.far).sum(), by_exponent.sum()]) / _OPACITIES,
            "mean": np.array([m * (by_exponent * self.x).sum() / xx, m * (by_exponent * self.y).sum() / yy, by_z]),
            "scale": 2 * m**2 * np.array([by_xx * sx, by_yy * sy, 0.0]),
            "turn": np.array([2 * m**2 * (sx**2 - sy**2) * by_xy]),
        }


def _draw(device: Device) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    tensors = {
        "means": torch.tensor([[0.0, 0.0, depth] for depth in _DEPTHS]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        "scales": torch.tensor(_SCALES, dtype=torch.float32),
        "opacities": torch.tensor(_OPACITIES, dtype=torch.float32),
        "colors": torch.tensor(_COLORS, dtype=torch.float32),
    }
    tensors = {name: tensor.float().requires_grad_() for name, tensor in tensors.items()}
    K = np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1]])
    camera = Camera(K, np.eye(4), _WIDTH, _HEIGHT)
    background = torch.tensor(_BACKGROUND, dtype=torch.float32)
    means, quats, scales, opacities, colors = tensors.values()
    rendering = rasterize(means, quats, scales, opacities, colors, camera, background=background, device=device)
    return tensors, rendering.image, rendering.depth


def image(device: Device) -> float:
    """Two Gaussians, one before the other: colors and depth, whose closed form is known."""
    known = _TwoGaussians()
    _, drawn, depth = _draw(device)
    return max(_largest(drawn, known.image), _largest(depth, known.depth) / float(_DEPTHS[0]))


def image_gradient(device: Device) -> float:
    """The gradients of that image; each error relative to the largest gradient of its kind."""
    weights = np.random.default_rng(0).standard_normal((_HEIGHT, _WIDTH, 3))
    known = _TwoGaussians().gradients(weights)
    tensors, drawn, _ = _draw(device)
    (drawn * torch.tensor(weights, dtype=torch.float32)).sum().backward()
    gradients = {name: tensor.grad for name, tensor in tensors.items()}
    means, scales, quats = (gradients[name] for name in ("means", "scales", "quats"))
    assert means is not None
    assert scales is not None
    assert quats is not None
    found = {"colors": gradients["colors"], "opacities": gradients["opacities"]}
    found |= {"mean": means[1], "scale": scales[1], "turn": quats[1, 3:]}
    errors = []
    for name, values in known.items():
        gradient = found[name]
        assert gradient is not None
        errors.append(_largest(gradient, values) / float(np.abs(values).max()))
    return max(errors)


def _encoder(device: Device) -> tuple[HashEncoder, torch.Tensor, float]:
    """Grids whose feature 0 is the sum of an entry's coordinates where the level is dense, else 1; feature 1 is 1."""
    config = HashConfig(levels=2, base=(6, 5, 4), finest=(40, 40, 40), table_log2=10)
    grids = [HashGrid(config, axes, torch.Generator()) for axes in ((0, 1, 2), (0, 1, TIME))]
    for grid in grids:
        grid.table.data.fill_(1.0)
        x, y, z = grid.levels[0].resolution
        corner = sum(torch.meshgrid(torch.arange(z), torch.arange(y), torch.arange(x), indexing="ij"))
        assert isinstance(corner, torch.Tensor)
        grid.table.data[: x * y * z, 0] = corner.reshape(-1).float()
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) * 1.9 - 0.95
    return HashEncoder(device, [grids], bound=1.0), points, 0.3


def _known_encoding(encoder: HashEncoder, points: torch.Tensor, time: float) -> Array:
    """Interpolation of a sum of coordinates: on each axis, the cell plus the smoothstep of the place in it."""
    columns = []
    for grid in encoder.grids:
        unit = [np.full(len(points), time) if axis == TIME else (points[:, axis].numpy() + 1) / 2 for axis in grid.axes]
        places = [values.astype(np.float32) * np.float32(scale)
                  for values, scale in zip(unit, grid.levels[0].scale, strict=True)]  # fmt: skip
        cells = [np.floor(place) for place in places]
        inside = [place.astype(np.float64) - cell for place, cell in zip(places, cells, strict=True)]
        one = np.ones(len(points))
        total = sum(cell + f * f * (3 - 2 * f) for cell, f in zip(cells, inside, strict=True))
        columns += [total, one, one, one]
    return np.stack(columns, 1)


def hash_encoding(device: Device) -> float:
    """Features of 3,000 points in a spatial and a temporal grid, on a dense and a hashed level."""
    encoder, points, time = _encoder(device)
    with torch.no_grad():
        (found,) = encoder(points, time)
    return _largest(found, _known_encoding(encoder, points, time))


def hash_gradient(device: Device) -> float:
    """The encoding is linear in the tables, so <gradient of the tables, tables> = <gradient of the encoding, encoding>.

    The error is relative to the sum of the absolute products.
    """
    encoder, points, time = _encoder(device)
    (found,) = encoder(points, time)
    weights = torch.rand(found.shape, generator=torch.Generator().manual_seed(1))
    (found * weights).sum().backward()
    worst = 0.0
    for number, grid in enumerate(encoder.grids):
        assert grid.table.grad is not None
        products = (grid.table.grad * grid.table).double()
        of_level = products.split([level.entries for level in grid.levels])
        own = slice(4 * number, 4 * number + 4)
        expected = (weights[:, own].double().numpy() * _known_encoding(encoder, points, time)[:, own]).sum(0)
        sums = np.concatenate([level.detach().sum(0).numpy() for level in of_level])
        worst = max(worst, float(np.abs(sums / expected - 1).max()))
    return worst


def image_loss(device: Device) -> float:
    """Equal images have no loss and no gradient; gray ones that differ by 0.25 have the L1 0.25 and its gradient."""
    losses = ImageLoss(device)
    weights = LossWeights(l1=1.0, ssim=0.5, pyramid=0.5, ncc=0.5)
    colors = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)
    terms, gradient = _losses(losses, colors / 255, colors, weights)
    error = max(_largest(terms, np.zeros(5)), _largest(gradient, np.zeros(gradient.shape)))
    gray = np.full((40, 48, 3), 51, np.uint8)  # 0.2
    terms, gradient = _losses(losses, gray / 255 + 0.25, gray, LossWeights(l1=1.0, ssim=0, pyramid=0, ncc=0))
    slope = np.full(gradient.shape, 1 / gradient.size)
    return max(error, _largest(terms[:2], np.array([0.25, 0.0625])), _largest(gradient, slope) * gradient.size)


def _losses(losses: ImageLoss, image: Array, truth: NDArray[np.uint8], weights: LossWeights) -> tuple[Array, Array]:
    """Terms (5,) and gradient (3, H, W)."""
    planes = np.concatenate([image, np.zeros((*image.shape[:2], 1))], 2).transpose(2, 0, 1)
    drawn = DeviceArray.upload(losses.device, "image", np.ascontiguousarray(planes, np.float32))
    opaque = np.concatenate([truth, np.full((*truth.shape[:2], 1), 255, np.uint8)], 2)
    uploaded = upload_rgba(losses.device, opaque)
    with Commands(losses.device) as commands:
        done = losses.record(commands, drawn, uploaded, (0.0, 0.0, 0.0), weights, gradient=True)
    assert done.d_image is not None
    return done.terms.read(), done.d_image.read()[:3]


def same_bits(device: Device) -> float:
    """3,000 random Gaussians, drawn and differentiated twice; the number of values that differ in any bit."""

    def once() -> list[torch.Tensor]:
        random = torch.Generator().manual_seed(0)
        means, quats = torch.randn(3000, 3, generator=random) * 0.5, torch.randn(3000, 4, generator=random)
        colors = torch.rand(3000, 3, generator=random)
        scales, opacities = torch.full((3000, 3), 0.03), torch.full((3000,), 0.5)
        tensors = [each.requires_grad_() for each in (means, quats, scales, opacities, colors)]
        camera = Camera.looking_at([0, -3, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=160, height=120)
        drawn = rasterize(means, quats, scales, opacities, colors, camera, device=device).image
        drawn.square().sum().backward()
        return [drawn.detach(), *[tensor.grad for tensor in tensors if tensor.grad is not None]]

    pairs = zip(once(), once(), strict=True)
    return float(sum(int((a.view(torch.int32) != b.view(torch.int32)).sum()) for a, b in pairs))


def _largest(found: torch.Tensor | NDArray[np.floating], known: Array) -> float:
    """The largest difference; infinite where a value is not finite."""
    values = found.detach().double().numpy() if isinstance(found, torch.Tensor) else found.astype(np.float64)
    error = float(np.abs(values - known).max())
    return error if np.isfinite(error) else float("inf")


CHECKS = (
    Check("scan", scan, 0),
    Check("radix sort", radix_sort, 0),
    Check("matmul", matmul, 0),
    Check("image", image, 1e-5),
    Check("gradient of the image", image_gradient, 1e-4),
    Check("hash encoding", hash_encoding, 1e-5),
    Check("gradient of the hash encoding", hash_gradient, 1e-5),
    Check("image losses", image_loss, 1e-5),
    Check("same bits twice", same_bits, 0),
)
