"""Captures of a few known Gaussians, drawn and written out in the layouts of other projects: what readers must undo."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from torch import Tensor

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterize

WIDTH, HEIGHT = 64, 48
NEAR, FAR = 2.0, 8.0  # around what the cameras see
Change = Callable[[Path, dict[str, Any]], Any]


class Blobs(NamedTuple):
    """Colored Gaussians of different sizes around a place that is not the origin."""

    means: Tensor
    scales: Tensor
    colors: Tensor

    @staticmethod
    def random(count: int = 40, seed: int = 0) -> Blobs:
        generator = torch.Generator().manual_seed(seed)
        means = torch.rand(count, 3, generator=generator) * 2 - 1 + torch.tensor([0.3, -0.2, 0.5])
        scales = 0.05 + 0.15 * torch.rand(count, 1, generator=generator).expand(count, 3)
        return Blobs(means, scales, torch.rand(count, 3, generator=generator))

    def drawn(self, camera: Camera, device: Device) -> np.ndarray:
        """(H, W, 3) uint8."""
        quats = torch.tensor([[1.0, 0, 0, 0]]).expand(len(self.means), 4)
        opacities = torch.full((len(self.means),), 0.9)
        image = rasterize(self.means, quats, self.scales, opacities, self.colors, camera, device=device).image
        return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def cameras(count: int, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """On an arc with z up, at different heights, all looking near the blobs' middle."""
    turns = np.linspace(-0.6, 0.6, count)
    return [
        Camera.looking_at(
            [4.5 * np.sin(turn), -4.5 * np.cos(turn), 0.5 + 0.8 * (i % 2)],
            [0.3, -0.2, 0.5],
            up=[0, 0, 1],
            fov_x=0.9,
            width=width,
            height=height,
        )
        for i, turn in enumerate(turns)
    ]


def shifted(camera: Camera, dx: float, dy: float) -> Camera:
    """With its principal point elsewhere."""
    return Camera(camera.K + np.array([[0, 0, dx], [0, 0, dy], [0, 0, 0]]), camera.T_cam_world, WIDTH, HEIGHT)


def agreement(data: Dataset, blobs: Blobs, device: Device, views: Sequence[int] | None = None) -> float:
    """The smallest PSNR, in dB, between the pictures of the views and the blobs drawn from the cameras as read."""
    assert data.normalization is not None
    means = torch.from_numpy(data.normalization.points(blobs.means.double().numpy())).float()
    moved = Blobs(means, blobs.scales * data.normalization.scale, blobs.colors)
    everything = [*data.train, *data.test]
    found = []
    for view in everything if views is None else [everything[i] for i in views]:
        error = view.load().astype(float)[..., :3] - moved.drawn(view.camera, device)
        found.append(10 * np.log10(255**2 / max(np.square(error).mean(), 1e-3)))
    return float(min(found))


# The layout of nerfies and HyperNeRF


def bent(blobs: Blobs, camera: Camera, device: Device, fields: dict[str, Any]) -> np.ndarray:
    """The picture that a lens of these fields takes: each pixel's ray is straightened by iteration, and looked up in a
    picture of four times the resolution and twice the angle."""
    gain, margin = 4, 2
    size = (camera.width * gain * margin, camera.height * gain * margin)
    K = np.array([[camera.K[0, 0] * gain, 0, size[0] / 2], [0, camera.K[1, 1] * gain, size[1] / 2], [0, 0, 1]])
    large = blobs.drawn(Camera(K, camera.T_cam_world, *size), device).astype(float)
    (k1, k2, k3), (p1, p2) = fields["radial_distortion"], fields["tangential_distortion"]
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    y_bent = (rows - camera.K[1, 2]) / camera.K[1, 1]
    x_bent = (columns - camera.K[0, 2] - fields["skew"] * y_bent) / camera.K[0, 0]
    x, y = x_bent, y_bent
    for _ in range(40):
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            (x_bent - 2 * p1 * x * y - p2 * (r2 + 2 * x**2)) / radial,
            (y_bent - p1 * (r2 + 2 * y**2) - 2 * p2 * x * y) / radial,
        )
    at = [y * K[1, 1] + K[1, 2] - 0.5, x * K[0, 0] + K[0, 2] - 0.5]
    channels = [map_coordinates(large[..., channel], at, order=1) for channel in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def bright(picture: np.ndarray) -> np.ndarray:
    """(H, W) bool: what `write_nerfies` makes a mask of."""
    return picture.max(axis=2) > 64


def write_nerfies(
    folder: Path, device: Device, *, count: int = 5, lens: dict[str, Any] | None = None, change: Change | None = None
) -> Path:
    """A capture of `count` pictures, the last one for testing; scene.json moves and scales it; rgb/1x and rgb/2x, and
    covisible/ with masks of what is bright.

    lens: fields of the camera files. change: spoils files (by name without .json) before they are written.
    """
    blobs = Blobs.random()
    fields = {"skew": 0.0, "radial_distortion": [0.0] * 3, "tangential_distortion": [0.0] * 2} | (lens or {})
    principal = np.array(fields.pop("principal_point", [WIDTH / 2, HEIGHT / 2]))
    ids = [f"left_{i:06d}" for i in range(count)]
    files: dict[str, Any] = {
        "scene": {"scale": 0.2, "center": [0.5, -1.0, 0.25], "near": NEAR * 0.2, "far": FAR * 0.2},
        "dataset": {"count": count, "ids": ids, "train_ids": ids[:-1], "val_ids": ids[-1:]},
        "metadata": {name: {"warp_id": i, "appearance_id": i, "camera_id": 0} for i, name in enumerate(ids)},
    }
    for name, camera in zip(ids, cameras(count), strict=True):
        camera = shifted(camera, *(principal - [WIDTH / 2, HEIGHT / 2]))
        aspect = fields.get("pixel_aspect_ratio", 1.0)
        camera = Camera(camera.K * np.array([[1.0], [aspect], [1.0]]), camera.T_cam_world, WIDTH, HEIGHT)
        camera.K[1, 2] = principal[1]
        picture = bent(blobs, camera, device, fields) if lens else blobs.drawn(camera, device)
        for factor in (1, 2):
            (folder / f"rgb/{factor}x").mkdir(parents=True, exist_ok=True)
            small = Image.fromarray(picture).resize((WIDTH // factor, HEIGHT // factor), Image.Resampling.BOX)
            small.save(folder / f"rgb/{factor}x/{name}.png")
            if name == ids[-1]:
                (folder / f"covisible/{factor}x/val").mkdir(parents=True)
                Image.fromarray(bright(np.asarray(small))).save(folder / f"covisible/{factor}x/val/{name}.png")
        files[f"camera/{name}"] = {
            "orientation": camera.T_cam_world[:3, :3].tolist(),
            "position": camera.position.tolist(),
            "focal_length": camera.K[0, 0],
            "principal_point": principal.tolist(),
            "pixel_aspect_ratio": aspect,
            "image_size": [WIDTH, HEIGHT],
            **fields,
        }
    np.save(folder / "points.npy", blobs.means.numpy())
    if change:
        change(folder, files)
    (folder / "camera").mkdir()
    for name, data in files.items():
        (folder / f"{name}.json").write_text(data if isinstance(data, str) else json.dumps(data))
    return folder


# The layout of Neu3D


def llff_row(camera: Camera, scale: float = 1.0) -> list[float]:
    """A row of poses_bounds.npy; scale: of the pictures that it says against those of the camera."""
    right, down, forward = camera.T_cam_world[:3, :3]
    size = [camera.height * scale, camera.width * scale, camera.K[0, 0] * scale]
    return [*np.stack([down, right, -forward, camera.position, size], axis=1).ravel(), NEAR, FAR]


def write_neu3d(
    folder: Path, device: Device, *, count: int = 4, frames: int = 3, video: bool = False, change: Change | None = None
) -> Path:
    """Cameras that see the same blobs move along x, a picture or a video frame each; poses for twice their size.

    change: spoils the folder, and the array "poses", which is written afterwards.
    """
    taken = cameras(count)
    arrays: dict[str, Any] = {"poses": np.array([llff_row(camera, 2.0) for camera in taken])}
    for number, camera in enumerate(taken):
        pictures = [moved(frame).drawn(camera, device) for frame in range(frames)]
        if video:
            folder.mkdir(parents=True, exist_ok=True)
            write_video(folder / f"cam{number:02d}.mp4", pictures)
        else:
            (folder / f"cam{number:02d}/images").mkdir(parents=True)
            for frame, picture in enumerate(pictures):
                Image.fromarray(picture).save(folder / f"cam{number:02d}/images/{frame:04d}.png")
    if change:
        change(folder, arrays)
    np.save(folder / "poses_bounds.npy", arrays["poses"])
    return folder


def moved(frame: int) -> Blobs:
    """The blobs in a frame of `write_neu3d`."""
    blobs = Blobs.random()
    return blobs._replace(means=blobs.means + torch.tensor([0.15 * frame, 0, 0]))


def write_video(path: Path, pictures: Sequence[np.ndarray], *, cut: float = 0.0) -> None:
    """H.264 with colors at full resolution, almost lossless; one keyframe, at the beginning.

    cut: seconds at the beginning that an edit list leaves out.
    """
    av = __import__("av")
    options = {"avoid_negative_ts": "disabled", "use_editlist": "1"} if cut else {}
    with av.open(str(path), "w", options=options) as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = pictures[0].shape[1], pictures[0].shape[0], "yuv444p"
        frames = [av.VideoFrame.from_ndarray(picture, "rgb24") for picture in pictures]
        for packet in [*(packet for frame in frames for packet in stream.encode(frame)), *stream.encode()]:
            packet.pts -= round(cut / packet.time_base)
            packet.dts -= round(cut / packet.time_base)
            file.mux(packet)


def write_points(path: Path, points: np.ndarray, colors: np.ndarray | None = None) -> None:
    """A .ply cloud as 3DGS's readers store it: floats x y z, and bytes red green blue."""
    fields = [(name, "<f4") for name in "xyz"] + ([(name, "u1") for name in ("red", "green", "blue")])
    rows = np.zeros(len(points), np.dtype(fields if colors is not None else fields[:3]))
    for column, name in enumerate("xyz"):
        rows[name] = points[:, column]
    if colors is not None:
        for column, name in enumerate(("red", "green", "blue")):
            rows[name] = colors[:, column]
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[rows.dtype[name].str]} {name}\n" for name in rows.dtype.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


# A sparse model of COLMAP, and nerfstudio's transforms.json

COLMAP_MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}


def quaternion(R: np.ndarray) -> np.ndarray:
    """wxyz of a rotation."""
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([w, x, y, z])


def write_model(
    folder: Path,
    model: str,
    size: tuple[int, int],
    parameters: Sequence[float],
    poses: dict[str, Camera],
    points: np.ndarray,
    colors: np.ndarray,
    *,
    binary: bool,
) -> None:
    """A sparse model with one camera, each picture seeing two points, each point seen by two pictures."""
    folder.mkdir(parents=True)
    rows = [(name, [*quaternion(c.T_cam_world[:3, :3]), *c.T_cam_world[:3, 3]]) for name, c in poses.items()]
    if binary:
        number = COLMAP_MODELS[model]
        camera = struct.pack(f"<QIiQQ{len(parameters)}d", 1, 7, number, *size, *parameters)
        (folder / "cameras.bin").write_bytes(camera)
        images = struct.pack("<Q", len(rows))
        for i, (name, pose) in enumerate(rows):
            images += struct.pack("<I7dI", i + 1, *pose, 7) + name.encode() + b"\0"
            images += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.5, 2.5, -1)
        (folder / "images.bin").write_bytes(images)
        cloud = struct.pack("<Q", len(points))
        for i, (point, color) in enumerate(zip(points.tolist(), colors.tolist(), strict=True)):
            cloud += struct.pack("<Q3d3BdQ", i + 1, *point, *color, 0.5, 2) + struct.pack("<4I", 1, 0, 2, 1)
        (folder / "points3D.bin").write_bytes(cloud)
        return
    text = " ".join(map(repr, map(float, parameters)))
    (folder / "cameras.txt").write_text(f"# Cameras\n7 {model} {size[0]} {size[1]} {text}\n")
    lines = ["# Images"]
    for i, (name, pose) in enumerate(rows):
        lines += [f"{i + 1} {' '.join(map(repr, map(float, pose)))} 7 {name}", "1.5 2.5 -1 1.5 2.5 -1" if i else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Points"]
    for i, (point, color) in enumerate(zip(points.tolist(), colors.tolist(), strict=True)):
        lines.append(f"{i + 1} {' '.join(map(repr, point))} {' '.join(map(str, color))} 0.5 1 0 2 1")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def film(
    device: Device, count: int, lens: dict[str, Any] | None = None, principal: tuple[float, float] = (0, 0)
) -> list[tuple[Camera, np.ndarray]]:
    """What a camera on the arc sees, whose principal point is moved and whose lens has these coefficients (k1, k2, k3,
    p1, p2)."""
    found = []
    for camera in cameras(count):
        camera = shifted(camera, *principal)
        k = [(lens or {}).get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2")]
        fields = {"radial_distortion": k[:3], "tangential_distortion": k[3:], "skew": 0.0}
        blobs = Blobs.random()
        found.append((camera, bent(blobs, camera, device, fields) if lens else blobs.drawn(camera, device)))
    return found


def write_colmap(
    folder: Path,
    device: Device,
    *,
    count: int = 6,
    model: str = "PINHOLE",
    lens: dict[str, Any] | None = None,
    binary: bool = True,
    principal: tuple[float, float] = (0, 0),
    name: str = "frame_{:04d}.png",
) -> Path:
    """One camera that moves past the blobs; the cloud is their middles, in their colors."""
    poses = {}
    (folder / "images").mkdir(parents=True)
    for i, (camera, picture) in enumerate(film(device, count, lens, principal)):
        poses[name.format(i + 1)] = camera
        path = folder / "images" / name.format(i + 1)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(picture).save(path)
    K = camera.K
    values = {"fx": K[0, 0], "fy": K[1, 1], "f": K[0, 0], "cx": K[0, 2], "cy": K[1, 2], **(lens or {})}
    names = {
        "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy", "SIMPLE_RADIAL": "f cx cy k1", "RADIAL": "f cx cy k1 k2",
        "OPENCV": "fx fy cx cy k1 k2 p1 p2", "OPENCV_FISHEYE": "fx fy cx cy k1 k2 p1 p2",
    }[model]  # fmt: skip
    blobs = Blobs.random()
    write_model(
        folder / "sparse/0",
        model,
        (WIDTH, HEIGHT),
        [values.get(each, 0.0) for each in names.split()],
        poses,
        blobs.means.double().numpy(),
        (blobs.colors * 255).round().byte().numpy(),
        binary=binary,
    )
    return folder


def write_rig(folder: Path, device: Device, *, count: int = 4, frames: int = 3) -> Path:
    """Still cameras: the blobs move; COLMAP has seen the first picture of each camera alone."""
    poses = {}
    for number, camera in enumerate(cameras(count)):
        (folder / f"images/cam{number:02d}").mkdir(parents=True)
        poses[f"cam{number:02d}/0000.png"] = camera
        for frame in range(frames):
            picture = Image.fromarray(moved(frame).drawn(camera, device))
            picture.save(folder / f"images/cam{number:02d}/{frame:04d}.png")
    blobs = Blobs.random()
    parameters = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
    colors = (blobs.colors * 255).round().byte().numpy()
    means = blobs.means.double().numpy()
    write_model(folder / "sparse/0", "PINHOLE", (WIDTH, HEIGHT), parameters, poses, means, colors, binary=True)
    return folder


def write_nerfstudio(
    folder: Path,
    device: Device,
    *,
    count: int = 6,
    lens: dict[str, Any] | None = None,
    principal: tuple[float, float] = (0, 0),
    each: bool = False,
    change: Change | None = None,
) -> Path:
    """The same camera in transforms.json, with a cloud as text. each: every frame has its own intrinsics.

    change: spoils the file's object before it is written.
    """
    data: dict[str, Any] = {"camera_model": "OPENCV", "frames": [], "ply_file_path": "sparse_pc.ply"}
    (folder / "images").mkdir(parents=True)
    for i, (camera, picture) in enumerate(film(device, count, lens, principal)):
        Image.fromarray(picture).save(folder / f"images/frame_{i + 1:05d}.png")
        K = camera.K
        intrinsics = {"w": WIDTH, "h": HEIGHT, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        intrinsics |= lens or {}
        pose = np.linalg.inv(camera.T_cam_world) @ np.diag([1.0, -1, -1, 1])
        frame = {
            "file_path": f"./images/frame_{i + 1:05d}.png",
            "transform_matrix": pose.tolist(),
            "time": 2.0 + i / 10,
        }
        data["frames"].append(frame | intrinsics if each else frame)
        if not each:
            data |= intrinsics
    blobs = Blobs.random()
    rows = np.concatenate([blobs.means.numpy(), (blobs.colors * 255).round().numpy()], axis=1).tolist()
    properties = "".join(f"property {kind} {name}\n" for kind, name in CLOUD_PROPERTIES)
    text = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    text += "".join(f"{x} {y} {z} {r:.0f} {g:.0f} {b:.0f}\n" for x, y, z, r, g, b in rows)
    (folder / "sparse_pc.ply").write_text(text)
    if change:
        change(folder, data)
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


CLOUD_PROPERTIES = [("float", "x"), ("float", "y"), ("float", "z")] + [("uint8", c) for c in ("red", "green", "blue")]
