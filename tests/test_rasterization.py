"""gsplat's call against the float64 reference of `rasterize`, in the combinations that gsplat's own trainer uses."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.reference import project, rasterize_reference
from helpers.scenes import fragile_pixels, front_camera, oblique_camera, random_scene, relative
from scipy.spatial.transform import Rotation
from torch import Tensor

from lapgs_wgpu import rasterization
from lapgs_wgpu.splat.camera import Camera

CAMERAS = [oblique_camera(61, 47), front_camera(61, 47)]
VIEWMATS, KS = (torch.from_numpy(np.stack([getattr(c, n) for c in CAMERAS])).float() for n in ("T_cam_world", "K"))
BACKGROUNDS = torch.tensor([[0.3, 1.0, 0.1], [0.0, 0.2, 0.9]])


def expected(scene: dict[str, Tensor], sh: int | None, mode: str, raster: str, backgrounds: Tensor | None) -> Any:
    """Colors, alphas and the pixels where rounding decides, of the reference."""
    how: dict[str, Any] = {"sh_degree": sh, "antialiased": raster == "antialiased"}
    images, alphas, fragile = [], [], []
    for c, camera in enumerate(CAMERAS):
        background = None if backgrounds is None else backgrounds[c].double()
        drawn = rasterize_reference(**scene, camera=camera, background=background, **how)
        depth = drawn.depth / drawn.alpha.clamp(min=1e-10) if mode.endswith("ED") else drawn.depth
        parts = ([drawn.image] if "RGB" in mode else []) + ([depth[..., None]] if mode != "RGB" else [])
        images.append(torch.cat(parts, dim=-1))
        alphas.append(drawn.alpha[..., None])
        single = {name: tensor.detach().float() for name, tensor in scene.items()}
        fragile.append(fragile_pixels(single, camera, sh, antialiased=how["antialiased"]))
    return torch.stack(images), torch.stack(alphas), torch.stack(fragile)


@pytest.mark.kernels
@pytest.mark.subgroups
@pytest.mark.parametrize(
    ("mode", "sh", "raster", "backgrounds", "packed"),
    [
        ("RGB", 0, "classic", None, False),  # the trainer's first steps
        ("RGB", 3, "antialiased", BACKGROUNDS, True),
        ("RGB+ED", 2, "classic", None, True),  # with its depth loss, and in its evaluation
        ("RGB+D", None, "classic", BACKGROUNDS, False),  # colors by its appearance module
        ("ED", None, "classic", None, False),
    ],
)
def test_against_the_reference(mode: str, sh: int | None, raster: str, backgrounds: Any, packed: bool) -> None:
    scene = random_scene(300, 3, sh=None if sh is None else 16)
    mine = {name: tensor.clone().requires_grad_() for name, tensor in scene.items()}
    theirs = {name: tensor.double().requires_grad_() for name, tensor in scene.items()}
    image, alpha, meta = rasterization(
        **mine, viewmats=VIEWMATS, Ks=KS, width=61, height=47, sh_degree=sh, packed=packed, backgrounds=backgrounds,
        render_mode=mode, rasterize_mode=raster,
    )  # fmt: skip
    wanted, wanted_alpha, fragile = expected(theirs, sh, mode, raster, backgrounds)
    assert image.shape == wanted.shape
    steady = ~fragile
    if mode.endswith("ED"):  # what hardly covers a pixel has no depth to compare
        steady &= wanted_alpha[..., 0] > 0.01
    assert (image - wanted)[steady].abs().max() < 1e-4
    assert (alpha - wanted_alpha)[steady].abs().max() < 2e-5
    weights = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(1)) * steady[..., None]
    (image * weights).sum().backward()
    (wanted * weights).sum().backward()
    for name, tensor in theirs.items():
        if name != "colors" or "RGB" in mode:
            assert relative(mine[name].grad, tensor.grad) < 1e-4, name
    check_meta(meta, scene, raster, packed)


def check_meta(meta: dict[str, Any], scene: dict[str, Tensor], raster: str, packed: bool) -> None:
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (61, 47, 2)
    names = ("means", "quats", "scales", "opacities")
    tensors = [scene[name].double() for name in names]
    projections = [project(*tensors, camera, antialiased=raster == "antialiased") for camera in CAMERAS]
    seen = torch.stack([p.visible for p in projections])
    if packed:
        assert torch.equal(torch.stack([meta["camera_ids"], meta["gaussian_ids"]], 1), seen.nonzero())
        found = {name: meta[name] for name in ("means2d", "depths", "conics", "opacities")}
    else:
        assert torch.equal((meta["radii"] > 0).all(-1), seen)
        found = {name: meta[name][seen] for name in ("means2d", "depths", "conics", "opacities")}
    for name, tensor in found.items():
        assert relative(tensor.detach(), torch.stack([getattr(p, name) for p in projections])[seen]) < 1e-4, name
    assert meta["means2d"].grad.shape == meta["means2d"].shape
    assert meta["means2d"].grad.abs().sum() > 0


@pytest.mark.parametrize("sh", [None, 2])
def test_cameras_learn(sh: int | None) -> None:
    """The gradient by a pose that turns and moves, against differences of the reference."""
    scene, camera = random_scene(150, 1, sh=None if sh is None else 9), CAMERAS[0]
    weights = torch.randn(47, 61, 3, generator=torch.Generator().manual_seed(1)).double()
    how: dict[str, Any] = {"sh_degree": sh}

    def moved(change: np.ndarray) -> Camera:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(change[:3]).as_matrix(), change[3:]
        return Camera(camera.K, T @ camera.T_cam_world, 61, 47)

    def loss(change: np.ndarray) -> float:
        tensors = {name: tensor.double() for name, tensor in scene.items()}
        return float((rasterize_reference(**tensors, camera=moved(change), **how).image * weights).sum())

    theirs = np.array([(loss(1e-7 * row) - loss(-1e-7 * row)) / 2e-7 for row in np.eye(6)])
    change = torch.zeros(6, requires_grad=True)
    basis = torch.zeros(6, 4, 4)
    for i, (row, column) in enumerate([(2, 1), (0, 2), (1, 0), (0, 3), (1, 3), (2, 3)]):
        basis[i, row, column] = 1
        basis[i, column, row] -= float(i < 3)
    pose = (torch.eye(4) + torch.einsum("i,irc->rc", change, basis)) @ VIEWMATS[0]
    image, _, _ = rasterization(**scene, viewmats=pose[None], Ks=KS[:1], width=61, height=47, **how)
    (image[0] * weights).sum().backward()
    assert change.grad is not None
    assert np.linalg.norm(change.grad.numpy() - theirs) < 1e-3 * np.linalg.norm(theirs)


def test_far_plane() -> None:
    scene = random_scene(50, 3)
    image, alpha, _ = rasterization(**scene, viewmats=VIEWMATS[:1], Ks=KS[:1], width=8, height=8, far_plane=0.02)
    assert not image.any()
    assert not alpha.any()


REFUSED = {"absgrad": True, "sparse_grad": True, "distributed": True, "camera_model": "fisheye", "eps2d": 0.1}
REFUSED |= {"radius_clip": 3.0, "covars": torch.eye(3), "with_ut": True, "rays": torch.zeros(6), "render_mode": "d"}
REFUSED |= {"near_plane": 0.001, "sh_degree": 4, "rasterize_mode": "own"}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_supported_is_named(name: str) -> None:
    scene = random_scene(5, 3, sh=25 if name == "sh_degree" else None)
    with pytest.raises((NotImplementedError, ValueError), match=name):
        rasterization(**scene, viewmats=VIEWMATS, Ks=KS, width=8, height=8, **{name: REFUSED[name]})
