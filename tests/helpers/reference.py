"""The rasterizer in plain torch: slow, simple, differentiable by autograd; in float64 the oracle of the kernels.

One function per pass, named as its shader. Conventions (gsplat's) and numbers come from shaders/common/constants.wgsl.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.rasterize import Rendering
from lapgs_wgpu.splat.rotation import rotation_matrices

DILATION, NEAR, FRUSTUM_MARGIN, ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN = (
    CONSTANTS[name] for name in ("DILATION", "NEAR", "FRUSTUM_MARGIN", "ALPHA_MAX", "ALPHA_MIN", "TRANSMITTANCE_MIN")
)
_SH_FACTORS = [value for name, value in CONSTANTS.items() if name.startswith("SH_C")]  # by degree, as listed there
_TILE = 8  # pixels a side; bounds memory and skips far Gaussians, never changes the result


class Projection(NamedTuple):
    """N Gaussians on the image plane; all rows of invisible ones are zero, and so are their gradients.

    means2d: (N, 2) pixels. conics: (N, 3) a, b, c of the inverse covariance [[a, b], [b, c]], px^-2.
    depths: (N,) camera z, world units. visible: (N,) bool. tau: (N,) squared Mahalanobis radius of the ellipse where
    alpha reaches ALPHA_MIN. half_sides: (N, 2) of that ellipse's bounding box, pixels. opacities: (N,) as drawn.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    visible: Tensor
    tau: Tensor
    half_sides: Tensor
    opacities: Tensor

    def front_to_back(self) -> Tensor:
        """Rows of the visible Gaussians by depth, ties by index."""
        rows = self.visible.nonzero().squeeze(-1)
        return rows[torch.argsort(self.depths[rows].detach(), stable=True)]


def _camera_points(means: Tensor, camera: Camera) -> Tensor:
    T = torch.as_tensor(camera.T_cam_world, dtype=means.dtype, device=means.device)
    return means @ T[:3, :3].T + T[:3, 3]


def _frustum_limits(camera: Camera) -> list[tuple[float, float]]:
    """The ranges of x/z and y/z that the Jacobian sees: the image and a margin around it."""
    limits = []
    for size, focal, centre in (
        (camera.width, camera.K[0, 0], camera.K[0, 2]),
        (camera.height, camera.K[1, 1], camera.K[1, 2]),
    ):
        margin = FRUSTUM_MARGIN * 0.5 * size / focal
        limits.append((float(-centre / focal - margin), float((size - centre) / focal + margin)))
    return limits


def _project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, camera: Camera, antialiased: bool | float
) -> tuple[Tensor, ...]:
    """means2d, conics, depths, tau, half_sides and opacities of every row as it is."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    x, y, z = _camera_points(means, camera).unbind(-1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    R_cam = torch.as_tensor(camera.T_cam_world[:3, :3], dtype=means.dtype, device=means.device)
    axes = R_cam @ (
        rotation_matrices(quats) * scales[:, None, :]
    )  # (N, 3, 3): the covariance in camera space is axes axes^T
    # Beyond its limits x/z is a constant for the Jacobian, so no gradient flows to it from there (as in gsplat).
    (x_low, x_high), (y_low, y_high) = _frustum_limits(camera)
    row_x = (fx / z)[:, None] * (axes[:, 0] - (x / z).clamp(x_low, x_high)[:, None] * axes[:, 2])
    row_y = (fy / z)[:, None] * (axes[:, 1] - (y / z).clamp(y_low, y_high)[:, None] * axes[:, 2])
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    # xx yy - xy^2 without its cancellation, so a splat as thin as a needle keeps a positive determinant
    flat = torch.linalg.cross(row_x, row_y).square().sum(-1)
    low_pass = DILATION if isinstance(antialiased, bool) else antialiased
    det = flat + low_pass * (xx + yy) + low_pass**2
    variances = torch.stack([xx, yy], dim=-1) + low_pass
    conics = torch.stack([variances[:, 1], -xy, variances[:, 0]], dim=-1) / det[:, None]

    if antialiased:
        opacities = opacities * torch.sqrt(flat / det)
    tau = 2 * torch.log(opacities / ALPHA_MIN)
    return means2d, conics, z, tau, torch.sqrt(tau[:, None] * variances), opacities


def _scattered(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """`values` at `rows` of `count`, zeros elsewhere."""
    return values.new_zeros(count, *values.shape[1:]).index_copy(0, rows, values)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    *,
    antialiased: bool | float = False,
) -> Projection:
    """Project Gaussians onto the image and cull.

    means: (N, 3) world. quats: (N, 4) wxyz. scales: (N, 3) standard deviations, world units. opacities: (N,);
    antialiased, they are drawn fainter by the ratio of the splat's area without the low-pass filter to that with it; a
    number is the filter's variance, px^2.
    Invisible: depth <= NEAR or camera.near, opacity as drawn < ALPHA_MIN, anything not finite, or an ellipse whose
    bounding box lies wholly outside the image. camera.K's skew is ignored.
    """
    with torch.no_grad():  # first who is visible, so that no division by the others' depths reaches the gradients
        means2d, conics, depths, tau, half_sides, _ = _project(means, quats, scales, opacities, camera, antialiased)
        size = means.new_tensor([camera.width, camera.height])
        finite = torch.cat([means2d, conics, half_sides], dim=-1).isfinite().all(-1)
        meets_image = ((means2d + half_sides > 0) & (means2d - half_sides < size)).all(-1)
        visible = finite & meets_image & (depths > max(NEAR, camera.near)) & (tau >= 0)
    rows = visible.nonzero().squeeze(-1)
    means2d, conics, depths, tau, half_sides, opacities = (
        _scattered(values, rows, len(means))
        for values in _project(means[rows], quats[rows], scales[rows], opacities[rows], camera, antialiased)
    )
    return Projection(means2d, conics, depths, visible, tau, half_sides, opacities)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """(N, (degree + 1)^2) real spherical harmonics at (N, 3) unit vectors, degree 0 to 3, in 3DGS's order and signs."""
    if not 0 <= degree <= 3:
        raise InputError(f"sh_degree is {degree}, but only degrees 0 to 3 are supported: choose one of these")
    c0, c1, c20, c21, c22, c30, c31, c32, c33, c34 = _SH_FACTORS
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, c0)]
    basis += [-c1 * y, c1 * z, -c1 * x]
    basis += [c20 * x * y, -c20 * y * z, c21 * (2 * zz - xx - yy), -c20 * x * z, c22 * (xx - yy)]
    basis += [-c30 * y * (3 * xx - yy), c31 * x * y * z, -c32 * y * (4 * zz - xx - yy)]
    basis += [c33 * z * (2 * zz - 3 * xx - 3 * yy)]
    basis += [-c32 * x * (4 * zz - xx - yy), c34 * z * (xx - yy), -c30 * x * (xx - 3 * yy)]
    return torch.stack(basis[: (degree + 1) ** 2], dim=-1)


def _sh_color(sh: Tensor, means: Tensor, camera: Camera, degree: int) -> Tensor:
    """(N, 3) color before the cut at zero."""
    if sh.ndim != 3 or sh.shape[1] < (degree + 1) ** 2:
        raise InputError(
            f"colors has shape {tuple(sh.shape)}, but sh_degree {degree} needs (N, K, 3) with K at least "
            f"{(degree + 1) ** 2}: lower sh_degree or give more coefficients"
        )
    to_mean = means - torch.as_tensor(camera.position, dtype=means.dtype, device=means.device)
    basis = sh_basis(to_mean / to_mean.norm(dim=-1, keepdim=True), degree)
    return (basis[:, :, None] * sh[:, : basis.shape[1]]).sum(1) + CONSTANTS["SH_OFFSET"]


def color(sh: Tensor, means: Tensor, camera: Camera, degree: int) -> Tensor:
    """(N, 3) colors max(SH + 0.5, 0) seen from the camera, with the gradient to means through the view direction.

    sh: (N, K, 3), K >= (degree + 1)^2; further coefficients are ignored. means: (N, 3) world.
    """
    return _sh_color(sh, means, camera, degree).relu()


def _tiles(means2d: Tensor, half_sides: Tensor, camera: Camera) -> Iterator[tuple[slice, slice, Tensor, Tensor]]:
    """Each tile's image rows and columns, pixel centres (P, 2), and the splats (K,) whose bounding boxes meet it."""
    with torch.no_grad():
        room = 1.001 * half_sides + 0.001  # for rounding
        low, high = means2d - room, means2d + room
    for top in range(0, camera.height, _TILE):
        for left in range(0, camera.width, _TILE):
            bottom, right = min(top + _TILE, camera.height), min(left + _TILE, camera.width)
            meets = (high > high.new_tensor([left, top])) & (low < low.new_tensor([right, bottom]))
            ys = torch.arange(top, bottom, dtype=low.dtype, device=low.device) + 0.5
            xs = torch.arange(left, right, dtype=low.dtype, device=low.device) + 0.5
            centres = torch.cartesian_prod(ys, xs).flip(-1)
            yield slice(top, bottom), slice(left, right), centres, meets.all(-1).nonzero().squeeze(-1)


def _densities(centres: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """(P, K) opacity exp(power), before the cuts at ALPHA_MIN and ALPHA_MAX."""
    dx, dy = (centres[:, None] - means2d).unbind(-1)
    a, b, c = conics.unbind(-1)
    return opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)


def _alphas(densities: Tensor) -> Tensor:
    return torch.where(densities < ALPHA_MIN, 0.0, densities.clamp(max=ALPHA_MAX))  # a clamp that holds: no gradient


def _transmittances(alphas: Tensor) -> Tensor:
    """(P, K + 1): before each splat, and behind the last."""
    return torch.cumprod(torch.cat([alphas.new_ones(len(alphas), 1), 1 - alphas], dim=1), dim=1)


def _composite(centres: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor) -> Tensor:
    """(P, F + 1): the features (K, F) of splats in depth order composited front to back; the final transmittance."""
    alphas = _alphas(_densities(centres, means2d, conics, opacities))
    with torch.no_grad():  # transmittance never rises: this drops the first splat that passes the limit and all behind
        kept = _transmittances(alphas)[:, 1:] > TRANSMITTANCE_MIN
    alphas = torch.where(kept, alphas, 0.0)
    transmittances = _transmittances(alphas)
    return torch.cat([(alphas * transmittances[:, :-1]) @ features, transmittances[:, -1:]], dim=1)


def rasterize(
    projection: Projection, colors: Tensor, camera: Camera, background: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite projected Gaussians, in any order, to image (H, W, 3), alpha (H, W) and depth (H, W).

    colors: (N, 3). background: (3,), none is black. Pixel (column, row) has its centre at
    (column + 0.5, row + 0.5).
    """
    order = projection.front_to_back()
    means2d, half_sides = projection.means2d[order], projection.half_sides[order]
    features = torch.cat([colors, projection.depths[:, None]], dim=1)
    pixels = torch.arange(camera.width * camera.height, device=order.device).view(camera.height, camera.width)
    where, parts = [], []
    for rows, columns, centres, near in _tiles(means2d, half_sides, camera):
        splats = order[near]
        groups = (group[splats] for group in (projection.means2d, projection.conics, projection.opacities, features))
        parts.append(checkpoint(_composite, centres, *groups, use_reentrant=False))  # memory for one tile at a time
        where.append(pixels[rows, columns].flatten())
    result = torch.cat(parts)[torch.cat(where).argsort()].view(camera.height, camera.width, 5)
    image, depth, transmittance = result[..., :3], result[..., 3], result[..., 4]
    if background is not None:
        image = image + transmittance[..., None] * background
    return image, 1 - transmittance, depth


def rasterize_reference(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    antialiased: bool | float = False,
    means2d_offset: Tensor | None = None,
) -> Rendering:
    """Render N Gaussians in the tensors' own precision, differentiable in all of them.

    means: (N, 3) world. quats: (N, 4) wxyz. scales: (N, 3). opacities: (N,). colors: (N, 3), or (N, K, 3) spherical
    harmonics when sh_degree is given. background: (3,), none is black. means2d_offset: (N, 2) zeros that are added to
    the projected means, so that their gradient is that of means2d. Rows of means2d that nobody sees are zero.
    """
    projection = project(means, quats, scales, opacities, camera, antialiased=antialiased)
    if means2d_offset is not None:
        projection = projection._replace(means2d=projection.means2d + means2d_offset)
    if sh_degree is not None:
        seen = projection.visible.nonzero().squeeze(-1)
        colors = _scattered(color(colors[seen], means[seen], camera, sh_degree), seen, len(means))
    image, alpha, depth = rasterize(projection, colors, camera, background)
    radii = projection.half_sides.detach().amax(-1).ceil().clamp(max=2.0**30).to(torch.int32)  # within int32
    return Rendering(image, alpha, depth, radii, projection.means2d)


@torch.no_grad()
def near_discontinuity(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    antialiased: bool | float = False,
    band: float = 1e-3,
    gate: float = 1e-6,
) -> Tensor:
    """(H, W) bool: pixels whose value or gradient may jump under rounding errors; tests give them no weight.

    band: relative distance of alpha to ALPHA_MIN or ALPHA_MAX, or of transmittance to TRANSMITTANCE_MIN.
    gate: relative distance of the depths of two Gaussians that follow each other in a pixel; distance of x/z, y/z to
    the frustum limits, and of a color to the cut at zero.
    """
    projection = project(means, quats, scales, opacities, camera, antialiased=antialiased)
    order = projection.front_to_back()
    means2d, conics, depths, opacities = (group[order] for group in (*projection[:3], projection.opacities))
    points = _camera_points(means[order], camera)
    limits = points.new_tensor(_frustum_limits(camera))
    fragile = ((points[:, :2, None] / points[:, 2:, None] - limits).abs() < gate).flatten(1).any(1)
    if sh_degree is not None:
        fragile |= (_sh_color(colors[order], means[order], camera, sh_degree).abs() < gate).any(1)

    mask = torch.zeros(camera.height, camera.width, dtype=torch.bool, device=means.device)
    for rows, columns, centres, near in _tiles(means2d, projection.half_sides[order], camera):
        densities = _densities(centres, means2d[near], conics[near], opacities[near])
        reached = densities > ALPHA_MIN * (1 - band)
        transmittances = _transmittances(_alphas(densities))
        furthest = torch.cummax(torch.where(reached, depths[near], -torch.inf), dim=1).values
        events = fragile[near] | (densities < ALPHA_MIN * (1 + band)) | ((densities / ALPHA_MAX - 1).abs() < band)
        events |= (transmittances[:, 1:] / TRANSMITTANCE_MIN - 1).abs() < band
        events[:, 1:] |= depths[near][1:] - furthest[:, :-1] < gate * depths[near][1:]
        live = transmittances[:, :-1] > TRANSMITTANCE_MIN
        mask[rows, columns] = (events & reached & live).any(1).view(mask[rows, columns].shape)
    return mask
