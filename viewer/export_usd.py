"""Export to OpenUSD, through usd-core: a ParticleField3DGaussianSplat (OpenUSD 26.03) with time samples."""

import math
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.ply_elements import Floats
from lapgs_wgpu.progress import counted
from lapgs_wgpu.viewer.export_loss import Loss, measure, plain_factors
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, direction, nearest_axis
from lapgs_wgpu.viewer.moving_files import USD_DEGREE, USD_HARMONICS, USD_KIND, SampledPlayback, load_pxr, read_usd


def export_usd(scene: LoadedScene, file: Path, frames: int | None = None) -> Loss:
    """Write Gaussians, and compare what usd-core reads with the scene. Atomic.

    frames: number of times, evenly from 0 to 1; by default those of the clip, at least 61. Coordinates are the scene's,
    below a transform that turns its up axis to z where it is neither y nor z. Values that do not change have one
    sample. Raises InputError where the file cannot be written, or usd-core is missing.
    """
    pxr = load_pxr()
    frames = frames or max(61, scene.clock().frames) if scene.playback.moves else 1
    with atomic_write(file) as target, tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / f"{file.stem}{'.usdc' if file.suffix.lower() == '.usdz' else file.suffix.lower()}"
        stage = pxr.Usd.Stage.CreateNew(str(made))
        _write(pxr, stage, scene, frames)
        stage.Save()
        del stage
        if file.suffix.lower() == ".usdz":
            packed = made.with_suffix(".usdz")
            pxr.UsdUtils.CreateNewUsdzPackage(pxr.Sdf.AssetPath(str(made)), str(packed))
            made = packed
        with made.open("rb") as source:
            shutil.copyfileobj(source, target)
    return measure(scene, SampledPlayback(scene.playback.device, read_usd(file)))


def _write(pxr: Any, stage: Any, scene: LoadedScene, frames: int) -> None:
    stage.GetRootLayer().customLayerData = {"view": scene.initial_view._replace(frames=frames).to_json()}
    axis, tokens = nearest_axis(scene.initial_view.up), pxr.UsdGeom.Tokens
    pxr.UsdGeom.SetStageUpAxis(stage, tokens.y if axis == "y" else tokens.z)  # it knows these two
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rate = max(1, frames - 1) / scene.clock().seconds
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(frames - 1)
    world = pxr.UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    up, above = (pxr.Gf.Vec3d(*direction(name)) for name in (axis, "y" if axis == "y" else "z"))
    upright = pxr.Gf.Matrix4d().SetRotate(pxr.Gf.Rotation(up, above))
    world.AddTransformOp().Set(upright)
    view, distance = scene.camera(), scene.camera().distance
    pose = np.linalg.inv(view.camera(640, 480).T_cam_world) @ np.diag([1.0, -1, -1, 1])  # USD looks along -z, y is up
    camera = pxr.Gf.Camera(
        pxr.Gf.Matrix4d(pose.T) * upright,  # USD multiplies rows
        clippingRange=pxr.Gf.Range1f(0.01 * distance, 100 * distance),
    )
    camera.SetPerspectiveFromAspectRatioAndFieldOfView(640 / 480, math.degrees(view.fov_y), pxr.Gf.Camera.FOVVertical)
    pxr.UsdGeom.Camera.Define(stage, "/World/Camera").SetFromCamera(camera, pxr.Usd.TimeCode.Default())
    splats = stage.DefinePrim("/World/Splats", USD_KIND)
    pxr.Usd.ColorSpaceAPI.Apply(splats).CreateColorSpaceNameAttr("srgb_rec709_display")
    splats.GetAttribute(USD_DEGREE).Set(scene.playback.at(0.0).sh_degree)
    factors = plain_factors(scene).astype(np.float32)
    last: dict[str, Floats] = {}  # what was written
    for number, t in enumerate(counted(np.linspace(0, 1, frames).tolist(), frames, "frames")):
        for name, values in _values(scene, t, factors).items():
            attribute = splats.GetAttribute(name)
            if name not in last:
                attribute.Set(values)  # for programs that ask for no time
            else:
                if name == "orientations":  # -q turns as q does, but not what lies between frames
                    values[(values * last[name]).sum(axis=1) < 0] *= -1
                if np.array_equal(values, last[name]):
                    continue
                attribute.Set(last[name], number - 1)  # until then it stood still
            attribute.Set(values, number)
            last[name] = values


def _values(scene: LoadedScene, t: float, factors: Floats) -> dict[str, Floats]:
    """The attributes' values at a time. factors: (N,) of the opacities."""
    now = scene.playback.at(t)
    means, quats, scales, opacities, sh = read_all([now.means, now.quats, now.scales, now.opacities, now.sh])
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    reach = 3 * scales.max(axis=1, keepdims=True)
    return {
        "positions": means,
        "orientations": np.roll(unit, -1, axis=1),  # the real part is last in memory
        "scales": scales,
        "opacities": factors * opacities,
        USD_HARMONICS: sh.reshape(-1, 3),
        "extent": np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)]),
    }
