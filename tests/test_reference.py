"""The float64 oracle against hand-computed pixels, a literal loop, finite differences, and textbook formulas."""

import math
from importlib.resources import files
from typing import Any

import numpy as np
import pytest
import torch
from helpers.reference import (
    ALPHA_MAX,
    ALPHA_MIN,
    CONSTANTS,
    DILATION,
    TRANSMITTANCE_MIN,
    color,
    near_discontinuity,
    project,
    rasterize_reference,
    sh_basis,
)
from helpers.scenes import Scene, front_camera, oblique_camera, random_scene
from scipy.special import lpmv
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import Rendering
from lapgs_wgpu.splat.rotation import rotation_matrices

IDENTITY = [1.0, 0.0, 0.0, 0.0]
FRONT = front_camera(9, 7, 10.0)  # its axis meets the centre of the middle pixel


@pytest.fixture(autouse=True, scope="module")
def _float64_on_one_thread() -> Any:
    dtype, threads = torch.get_default_dtype(), torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    yield
    torch.set_default_dtype(dtype)
    torch.set_num_threads(threads)


def splats(*rows: tuple[list[float], float, float, list[float]]) -> Scene:
    """Round Gaussians from (mean, scale, opacity, color)."""
    means, scales, opacities, colors = zip(*rows, strict=True)
    return {
        "means": torch.tensor(means, dtype=torch.float64),
        "quats": torch.tensor([IDENTITY] * len(rows)),
        "scales": torch.tensor(scales)[:, None].expand(-1, 3).clone(),
        "opacities": torch.tensor(opacities),
        "colors": torch.tensor(colors, dtype=torch.float64),
    }


# One Gaussian, by hand


def test_the_logarithm_of_the_smallest_alpha() -> None:
    """A constant of its own, since WGSL cannot be relied on to compute it when compiled."""
    assert CONSTANTS["LOG2_ALPHA_MIN"] == pytest.approx(math.log2(ALPHA_MIN), rel=1e-15)


def test_single_gaussian_pixels_by_hand() -> None:
    scene = splats(([0, 0, 2], 0.3, 0.8, [0.2, 0.5, 0.9]))
    background = torch.tensor([1.0, 0.0, 0.5])
    image, alpha, depth, radii, means2d = rasterize_reference(**scene, camera=FRONT, background=background)
    variance = (10.0 / 2 * 0.3) ** 2 + 0.3  # focal / z * scale, squared, and the dilation
    off = 0.8 * math.exp(-0.5 * (2**2 + 1**2) / variance)
    assert means2d.tolist() == [[4.5, 3.5]]
    assert alpha[3, 4].item() == pytest.approx(0.8, abs=1e-14)
    torch.testing.assert_close(image[3, 4], torch.tensor([0.2 * 0.8 + 0.2, 0.5 * 0.8, 0.9 * 0.8 + 0.5 * 0.2]))
    assert alpha[4, 6].item() == pytest.approx(off, abs=1e-14)  # two columns right, one row down
    assert image[4, 6, 1].item() == pytest.approx(0.5 * off, abs=1e-14)
    assert depth[4, 6].item() == pytest.approx(2 * off, abs=1e-14)
    assert radii.tolist() == [math.ceil(math.sqrt(2 * math.log(0.8 * 255) * variance))]
    assert radii.dtype == torch.int32


@pytest.mark.parametrize(("antialiased", "low_pass"), [(True, 0.3), (0.1, 0.1)])
def test_antialiased_opacity_by_hand(antialiased: bool | float, low_pass: float) -> None:
    """A Gaussian whose half axes are 0.6 and 0.2 pixels, and turned, so that its covariance is no diagonal."""
    quat = torch.tensor([[math.cos(0.3), 0, 0, math.sin(0.3)]])
    mean, scales, opacity = torch.tensor([[0.0, 0, 2]]), torch.tensor([[0.12, 0.04, 0.3]]), torch.tensor([0.9])
    projection = project(mean, quat, scales, opacity, FRONT, antialiased=antialiased)
    faded = 0.9 * 0.6 * 0.2 / math.sqrt((0.36 + low_pass) * (0.04 + low_pass))
    assert projection.opacities.item() == pytest.approx(faded, abs=1e-14)
    tau = 2 * math.log(255 * faded)
    assert projection.tau.item() == pytest.approx(tau, abs=1e-12)


def test_wxyz_rotation() -> None:
    """w first: (w, 0, 0, z) turns about z, by 90 degrees x to y; length does not matter."""
    about_z = rotation_matrices(torch.tensor([[1.0, 0, 0, 1], [5.0, 0, 0, 5]]))
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(about_z, expected.expand(2, 3, 3))
    about_x = rotation_matrices(torch.tensor([[math.cos(0.3), math.sin(0.3), 0, 0]]))[0]
    torch.testing.assert_close(about_x @ torch.tensor([0.0, 1, 0]), torch.tensor([0, math.cos(0.6), math.sin(0.6)]))


# Compositing rules


def test_nearer_gaussian_comes_first_and_ties_go_by_index() -> None:
    red, green = [1.0, 0, 0], [0, 1.0, 0]
    for rows, expected in (
        ([([0, 0, 3], 0.3, 0.5, red), ([0, 0, 2], 0.2, 0.6, green)], (0.4 * 0.5, 0.6)),
        ([([0, 0, 2], 0.3, 0.5, red), ([0, 0, 2], 0.3, 0.6, green)], (0.5, 0.5 * 0.6)),
        ([([0, 0, 2], 0.3, 0.6, green), ([0, 0, 2], 0.3, 0.5, red)], (0.4 * 0.5, 0.6)),
    ):
        pixel = rasterize_reference(**splats(*rows), camera=FRONT).image[3, 4]
        assert pixel.tolist() == pytest.approx([*expected, 0.0], abs=1e-14)


def test_pixel_stops_before_the_gaussian_that_would_pass_the_limit() -> None:
    opacities = [0.9, 0.98, 0.96, 0.5]  # transmittance 0.1, 0.002, then 0.00008 would be too little
    rows = [([0, 0, 2.0 + i], 0.3 * (1 + i), opacity, [0.0, 0, 1]) for i, opacity in enumerate(opacities)]
    rows[3][3][:] = [1.0, 0, 0]  # weak enough to pass alone, yet behind the stop
    out = rasterize_reference(**splats(*rows), camera=FRONT)
    assert out.alpha[3, 4].item() == pytest.approx(1 - 0.002, abs=1e-14)
    assert out.image[3, 4].tolist() == pytest.approx([0, 0, 0.998], abs=1e-14)
    assert out.depth[3, 4].item() == pytest.approx(2 * 0.9 + 3 * 0.098, abs=1e-14)


def test_alpha_is_clamped_and_faint_alpha_skipped() -> None:
    scene = splats(([0, 0, 2], 0.3, 1.0, [1.0, 1, 1]))
    scene["opacities"].requires_grad_()
    out = rasterize_reference(**scene, camera=front_camera(31, 31, 10.0))
    assert out.alpha[15, 15].item() == pytest.approx(ALPHA_MAX, abs=1e-14)
    assert torch.autograd.grad(out.alpha[15, 15], scene["opacities"], retain_graph=True)[0].item() == 0
    assert torch.autograd.grad(out.alpha[15, 16], scene["opacities"])[0].item() > 0
    variance, squared = (5 * 0.3) ** 2 + DILATION, (torch.arange(31) - 15.0) ** 2
    squared = squared[:, None] + squared
    reached = torch.exp(-0.5 * squared / variance) >= ALPHA_MIN
    assert torch.equal(out.alpha > 0, reached)
    assert reached.any()
    assert not reached.all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (17, 8)])
def test_no_gaussians_show_the_background(width: int, height: int) -> None:
    scene = {name: group[:0] for name, group in random_scene(1, 0).items()}
    background = torch.tensor([0.1, 0.2, 0.3])
    out = rasterize_reference(**scene, camera=front_camera(width, height, 10.0), background=background)
    assert torch.equal(out.image, background.expand(height, width, 3))
    assert out.alpha.count_nonzero() == out.depth.count_nonzero() == out.radii.numel() == 0
    assert not near_discontinuity(**scene, camera=front_camera(width, height, 10.0)).any()


# Against a literal loop


def literal(scene: Scene, camera: Camera, background: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The conventions word by word: one pixel, one Gaussian at a time, textbook matrices, no shared code."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    W, t = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
    image, alpha, depth = np.zeros((camera.height, camera.width, 3)), *np.zeros((2, camera.height, camera.width))
    gaussians = []
    for mean, (w, *v), scale, opacity, rgb in zip(*(group.tolist() for group in scene.values()), strict=True):
        x, y, z = W @ np.array(mean) + t
        if z <= 0.01:
            continue
        v = np.array(v) / math.sqrt(w * w + np.dot(v, v))
        w = math.copysign(math.sqrt(max(0.0, 1 - v @ v)), w)
        skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        R = np.eye(3) + 2 * w * skew + 2 * skew @ skew  # Rodrigues
        u_max, u_min = (camera.width - cx) / fx + 0.15 * camera.width / fx, -cx / fx - 0.15 * camera.width / fx
        v_max, v_min = (camera.height - cy) / fy + 0.15 * camera.height / fy, -cy / fy - 0.15 * camera.height / fy
        tx, ty = z * min(max(x / z, u_min), u_max), z * min(max(y / z, v_min), v_max)
        J = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
        cov = J @ W @ R @ np.diag(np.square(scale)) @ R.T @ W.T @ J.T + 0.3 * np.eye(2)
        gaussians.append((z, np.array([fx * x / z + cx, fy * y / z + cy]), np.linalg.inv(cov), opacity, np.array(rgb)))
    gaussians.sort(key=lambda gaussian: gaussian[0])
    for row in range(camera.height):
        for column in range(camera.width):
            T = 1.0
            for z, centre, conic, opacity, rgb in gaussians:
                d = np.array([column + 0.5, row + 0.5]) - centre
                density = opacity * math.exp(-0.5 * d @ conic @ d)
                if density < 1 / 255:
                    continue
                a = min(0.99, density)
                if T * (1 - a) <= 1e-4:
                    break
                image[row, column] += T * a * rgb
                depth[row, column] += T * a * z
                T *= 1 - a
            image[row, column] += T * background
            alpha[row, column] = 1 - T
    return image, alpha, depth


@pytest.mark.parametrize(("width", "height"), [(1, 1), (19, 13), (16, 8)])
def test_equals_the_literal_loop(width: int, height: int) -> None:
    camera = oblique_camera(width, height)
    scene = random_scene(40, seed=3, spread=1.0, size=0.3)
    scene["opacities"][:10] = 0.999
    background = torch.tensor([0.3, 0.6, 0.9])
    out = rasterize_reference(**scene, camera=camera, background=background)
    sure = ~near_discontinuity(**scene, camera=camera, band=1e-9, gate=0.0).numpy()
    for ours, expected in zip(out[:3], literal(scene, camera, background.numpy()), strict=True):
        np.testing.assert_allclose(ours.numpy()[sure], expected[sure], atol=1e-12)
    assert sure.mean() > 0.9
    if width > 1:
        assert out.radii.count_nonzero() < 40, "nothing was culled: the scene is too easy"


# Spherical harmonics


def directions_on_the_sphere() -> tuple[Tensor, Tensor]:
    """Gauss-Legendre times uniform points and their weights: exact for polynomials of degree 6 and more."""
    heights, weights = np.polynomial.legendre.leggauss(8)
    azimuths = np.arange(16) * (2 * np.pi / 16)
    z, phi = (grid.ravel() for grid in np.meshgrid(heights, azimuths, indexing="ij"))
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=-1)
    return torch.from_numpy(points), torch.from_numpy(np.repeat(weights, 16) * 2 * np.pi / 16)


def test_sh_basis_equals_associated_legendre_functions() -> None:
    """Order l, m = -l..l; sine for negative m; scipy's lpmv holds the Condon-Shortley phase."""
    points, _ = directions_on_the_sphere()
    x, y, z = points.numpy().T
    phi = np.arctan2(y, x)
    expected = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            k = abs(m)
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * math.factorial(degree - k) / math.factorial(degree + k))
            wave = np.sin(k * phi) if m < 0 else np.cos(k * phi)
            expected.append((math.sqrt(2) if m else 1) * norm * lpmv(k, degree, z) * wave)
    for degree in range(4):
        count = (degree + 1) ** 2
        np.testing.assert_allclose(sh_basis(points, degree), np.stack(expected[:count], axis=-1), atol=1e-13)


def test_sh_looks_from_the_camera_to_the_mean() -> None:
    sh = torch.zeros(1, 4, 3)
    sh[0, 3] = 1.0  # -C1 x
    camera = Camera.looking_at([5.0, 1, 1], [0, 1, 1], up=[0, 0, 1], fov_x=0.8, width=9, height=7)
    assert color(sh, torch.tensor([[0.0, 1, 1]]), camera, 1)[0, 0].item() == pytest.approx(
        0.5 + math.sqrt(0.75 / math.pi)
    )


@pytest.mark.parametrize("degree", [4, -1, 2])
def test_impossible_sh_degree_is_refused(degree: int) -> None:
    with pytest.raises(InputError, match="degree"):
        color(torch.zeros(1, 25 if degree == 4 else 4, 3), torch.ones(1, 3), FRONT, degree)


# Gradients


def delicate_scene(sh_degree: int | None) -> tuple[Scene, Camera]:
    """Six Gaussians that between them are clamped, skipped, stopped and beyond the frustum's margin."""
    camera = oblique_camera(9, 7)
    sh = None if sh_degree is None else (sh_degree + 1) ** 2
    scene = random_scene(6, seed=11, sh=sh, spread=0.12, size=0.25)
    scene["opacities"] = torch.tensor([1.0, 0.97, 0.96, 0.95, 0.9, 0.7])
    scene["means"][5] = torch.tensor([2.2, 0.5, 0.1])
    scene["scales"][0] = torch.tensor([0.8, 0.9, 0.7])
    scene["scales"][5] = torch.tensor([0.9, 0.7, 0.8])
    return scene, camera


def loss(out: Rendering) -> Tensor:
    weights = torch.sin(torch.arange(out.image.numel())).view_as(out.image)
    return (
        (weights * out.image).sum() + (weights[..., 0] * out.alpha).sum() + (weights[..., 1] * out.depth.square()).sum()
    )


def test_delicate_scene_visits_every_rule() -> None:
    scene, camera = delicate_scene(None)
    geometry = [scene[name] for name in ("means", "quats", "scales", "opacities")]
    projection = project(*geometry, camera)
    assert projection.visible.all(), "a Gaussian is culled"
    beyond = projection.means2d[5, 0].item() / camera.width
    assert beyond > 1.15, f"Gaussian 5 is at {beyond} image widths"
    each = [
        rasterize_reference(**{name: group[i : i + 1] for name, group in scene.items()}, camera=camera).alpha
        for i in range(6)
    ]
    alphas = torch.stack(each)
    assert (alphas > ALPHA_MAX - 1e-12).any(), "no clamp"
    assert (alphas == 0).any(), "no skip"
    assert ((1 - alphas).prod(0) <= TRANSMITTANCE_MIN).any(), "no stop"


@pytest.mark.parametrize(
    ("sh_degree", "antialiased"),
    [(None, False), (0, False), (1, False), (2, False), (3, False), (None, True), (None, 0.1)],
)
def test_gradcheck(sh_degree: int | None, antialiased: bool | float) -> None:
    scene, camera = delicate_scene(sh_degree)
    how: dict[str, Any] = {"camera": camera, "sh_degree": sh_degree, "antialiased": antialiased}
    risky = near_discontinuity(**scene, **how, band=1e-4, gate=1e-5)
    assert not risky.any(), "finite differences would cross a discontinuity"
    inputs = scene | {"means2d_offset": torch.zeros(6, 2), "background": torch.tensor([0.2, 0.7, 0.4])}

    def scalar(*groups: Tensor) -> Tensor:
        named = dict(zip(inputs, groups, strict=True))
        return loss(rasterize_reference(**named, **how))

    groups = [group.requires_grad_() for group in inputs.values()]
    every_number = sh_degree is None  # else one random direction a group, for speed
    assert torch.autograd.gradcheck(scalar, groups, eps=1e-6, atol=1e-6, rtol=1e-6, fast_mode=not every_number)
    for name, gradient in zip(inputs, torch.autograd.grad(scalar(*groups), groups), strict=True):
        assert gradient.abs().max() > 1e-3, f"{name} has no gradient: the check is empty"


def test_constants_stand_once_in_the_shader() -> None:
    text = files("lapgs_wgpu.shaders.common").joinpath("constants.wgsl").read_text()
    names = [line.split()[1].rstrip(":") for line in text.splitlines() if line.startswith("const")]
    assert sorted(names) == sorted(CONSTANTS)
    assert CONSTANTS["ALPHA_MIN"] == 1 / 255
