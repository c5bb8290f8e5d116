"""Captures of a few known Gaussians, drawn and written out in each layout that is read: what readers must undo."""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from helpers.dnerf_scene import make_scene
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from torch import Tensor

from lapgs_wgpu.data import Dataset, View
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterize

WIDTH, HEIGHT, COUNT = 64, 48, 6
NEAR, FAR = 2.0, 8.0  # around what the cameras see
GL = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenCV's camera axes and OpenGL's
Lens = Mapping[str, float]  # k1, k2, k3, p1, p2, skew; what is absent is 0
_drawn: dict[bytes, np.ndarray] = {}  # images that were drawn before, as most tests write the same captures


class Blobs(NamedTuple):
    """Colored Gaussians of different sizes around a place that is not the origin."""

    means: Tensor
    scales: Tensor
    colors: Tensor

    @staticmethod
    def random(count: int = 40, seed: int = 0) -> "Blobs":
        generator = torch.Generator().manual_seed(seed)
        means = torch.rand(count, 3, generator=generator) * 2 - 1 + torch.tensor([0.3, -0.2, 0.5])
        scales = 0.05 + 0.15 * torch.rand(count, 1, generator=generator).expand(count, 3)
        return Blobs(means, scales, torch.rand(count, 3, generator=generator))

    def drawn(self, camera: Camera, device: Device) -> np.ndarray:
        """(H, W, 3) uint8."""
        key = b"".join(np.ascontiguousarray(a).tobytes() for a in (*self, camera.K, camera.T_cam_world, camera.width))
        if key not in _drawn:
            quats = torch.tensor([[1.0, 0, 0, 0]]).expand(len(self.means), 4)
            opacities = torch.full((len(self.means),), 0.9)
            image = rasterize(self.means, quats, self.scales, opacities, self.colors, camera, device=device).image
            _drawn[key] = (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        return _drawn[key]

    @property
    def bytes_of_colors(self) -> np.ndarray:
        return (self.colors * 255).round().byte().numpy()


def moved(frame: int) -> Blobs:
    """The blobs in a frame of the captures in which they move, along x."""
    blobs = Blobs.random()
    return blobs._replace(means=blobs.means + torch.tensor([0.15 * frame, 0, 0]))


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


def bent(blobs: Blobs, camera: Camera, device: Device, lens: Lens) -> np.ndarray:
    """The image that a lens takes: each pixel's ray is straightened by iteration, and looked up in an image of four
    times the resolution and twice the angle."""
    gain, margin = 4, 2
    size = (camera.width * gain * margin, camera.height * gain * margin)
    K = np.array([[camera.K[0, 0] * gain, 0, size[0] / 2], [0, camera.K[1, 1] * gain, size[1] / 2], [0, 0, 1]])
    large = blobs.drawn(Camera(K, camera.T_cam_world, *size), device).astype(float)
    k1, k2, k3, p1, p2, skew = (lens.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2", "skew"))
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    y_bent = (rows - camera.K[1, 2]) / camera.K[1, 1]
    x_bent = (columns - camera.K[0, 2] - skew * y_bent) / camera.K[0, 0]
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


class Shot(NamedTuple):
    """camera: the pinhole of the image, whatever its lens. image: (H, W, 3) uint8."""

    camera: Camera
    image: np.ndarray

    def save(self, file: Path, **options: Any) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(self.image).save(file, **options)


def film(
    device: Device,
    count: int = COUNT,
    *,
    lens: Lens | None = None,
    principal: tuple[float, float] = (0, 0),
    aspect: float = 1.0,
) -> list[Shot]:
    """What one camera on the arc sees. principal: offset of its principal point. aspect: height of its pixels."""
    shots = []
    for camera in cameras(count):
        K = camera.K * [[1.0], [aspect], [1.0]]
        K[:2, 2] = np.array([WIDTH / 2, HEIGHT / 2]) + principal
        camera = Camera(K, camera.T_cam_world, WIDTH, HEIGHT)
        blobs = Blobs.random()
        shots.append(Shot(camera, bent(blobs, camera, device, lens) if lens else blobs.drawn(camera, device)))
    return shots


def agreement(
    data: Dataset, device: Device, blobs_of: Callable[[View], Blobs | None] = lambda _: Blobs.random()
) -> float:
    """The smallest PSNR, in dB, between the images of the views and the blobs drawn from the cameras as read.

    blobs_of: what a view shows; None leaves the view out.
    """
    assert data.normalization is not None
    found = []
    for view in (*data.train, *data.test):
        blobs = blobs_of(view)
        if blobs is None:
            continue
        means = torch.from_numpy(data.normalization.points(blobs.means.double().numpy())).float()
        placed = Blobs(means, blobs.scales * data.normalization.scale, blobs.colors)
        error = view.load().astype(float)[..., :3] - placed.drawn(view.camera, device)
        found.append(10 * np.log10(255**2 / max(np.square(error).mean(), 1e-3)))
    return float(min(found))


def opengl(camera: Camera) -> np.ndarray:
    """(4, 4) camera to world, OpenGL's and ARKit's axes."""
    return np.linalg.inv(camera.T_cam_world) @ GL


def intrinsics(camera: Camera, names: str) -> dict[str, float]:
    """Size, focal lengths and principal point, in the order of the six names."""
    K = camera.K
    return dict(zip(names.split(), (WIDTH, HEIGHT, K[0, 0], K[1, 1], K[0, 2], K[1, 2]), strict=True))


def write_points(path: Path, points: np.ndarray, colors: np.ndarray | None = None, *, text: bool = False) -> None:
    """A .ply cloud as 3DGS's readers store it: floats x y z, and bytes red green blue."""
    fields = [(name, "<f4") for name in "xyz"] + ([(name, "u1") for name in ("red", "green", "blue")])
    rows = np.zeros(len(points), np.dtype(fields if colors is not None else fields[:3]))
    for name, column in zip(rows.dtype.names or (), (*points.T, *(() if colors is None else colors.T)), strict=True):
        rows[name] = column
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[rows.dtype[name].str]} {name}\n" for name in rows.dtype.names or ())
    form = "ascii" if text else "binary_little_endian"
    header = f"ply\nformat {form} 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    body = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode() if text else rows.tobytes()
    path.write_bytes(header.encode() + body)


# nerfies, HyperNeRF


def bright(image: np.ndarray) -> np.ndarray:
    """(H, W) bool: where an image is bright, of which masks are made."""
    return image.max(axis=2) > 64


def write_nerfies(
    folder: Path,
    device: Device,
    *,
    count: int = 5,
    lens: Lens | None = None,
    principal: tuple[float, float] = (0, 0),
    aspect: float = 1.0,
) -> Path:
    """`count` images, the last one for testing; scene.json moves and scales the scene; rgb/1x and rgb/2x."""
    ids = [f"left_{i:06d}" for i in range(count)]
    lens = lens or {}
    files: dict[str, Any] = {
        "scene": {"scale": 0.2, "center": [0.5, -1.0, 0.25], "near": NEAR * 0.2, "far": FAR * 0.2},
        "dataset": {"count": count, "ids": ids, "train_ids": ids[:-1], "val_ids": ids[-1:]},
        "metadata": {name: {"warp_id": i, "appearance_id": i, "camera_id": 0} for i, name in enumerate(ids)},
    }
    for name, shot in zip(ids, film(device, count, lens=lens, principal=principal, aspect=aspect), strict=True):
        for factor in (1, 2):
            small = Image.fromarray(shot.image).resize((WIDTH // factor, HEIGHT // factor), Image.Resampling.BOX)
            Shot(shot.camera, np.asarray(small)).save(folder / f"rgb/{factor}x/{name}.png")
        files[f"camera/{name}"] = {
            "orientation": shot.camera.T_cam_world[:3, :3].tolist(),
            "position": shot.camera.position.tolist(),
            "focal_length": shot.camera.K[0, 0],
            "principal_point": shot.camera.K[:2, 2].tolist(),
            "pixel_aspect_ratio": aspect,
            "image_size": [WIDTH, HEIGHT],
            "skew": lens.get("skew", 0.0),
            "radial_distortion": [lens.get(name, 0.0) for name in ("k1", "k2", "k3")],
            "tangential_distortion": [lens.get(name, 0.0) for name in ("p1", "p2")],
        }
    np.save(folder / "points.npy", Blobs.random().means.numpy())
    (folder / "camera").mkdir()
    for name, data in files.items():
        (folder / f"{name}.json").write_text(json.dumps(data))
    return folder


# Neu3D


def llff_row(camera: Camera, scale: float = 1.0) -> list[float]:
    """A row of poses_bounds.npy; scale: of the images that it says against those of the camera."""
    right, down, forward = camera.T_cam_world[:3, :3]
    size = [camera.height * scale, camera.width * scale, camera.K[0, 0] * scale]
    return [*np.stack([down, right, -forward, camera.position, size], axis=1).ravel(), NEAR, FAR]


def write_neu3d(folder: Path, device: Device, *, count: int = 4, frames: int = 3, video: bool = False) -> Path:
    """Cameras that see the moving blobs, an image or a video frame each; poses for twice their size."""
    taken = cameras(count)
    for number, camera in enumerate(taken):
        images = [moved(frame).drawn(camera, device) for frame in range(frames)]
        if video:
            folder.mkdir(parents=True, exist_ok=True)
            write_video(folder / f"cam{number:02d}.mp4", images)
        for frame, image in enumerate(() if video else images):
            Shot(camera, image).save(folder / f"cam{number:02d}/images/{frame:04d}.png")
    np.save(folder / "poses_bounds.npy", np.array([llff_row(camera, 2.0) for camera in taken]))
    return folder


def write_panoptic(folder: Path, device: Device, *, count: int = 4, frames: int = 3) -> Path:
    """Cameras that see the moving blobs; the first is held out."""
    for name, taken in (("test", {0: cameras(count)[0]}), ("train", dict(enumerate(cameras(count))))):
        if name == "train":
            del taken[0]
        rows = {
            "fn": [[f"{number}/{frame:06d}.png" for number in taken] for frame in range(frames)],
            "k": [[camera.K.tolist() for camera in taken.values()]] * frames,
            "w2c": [[camera.T_cam_world.tolist() for camera in taken.values()]] * frames,
            "cam_id": [list(taken)] * frames,
        }
        for number, camera in taken.items():
            for frame in range(frames):
                Shot(camera, moved(frame).drawn(camera, device)).save(folder / f"ims/{number}/{frame:06d}.png")
        (folder / f"{name}_meta.json").write_text(json.dumps({"w": WIDTH, "h": HEIGHT, **rows}))
    return folder


def write_video(path: Path, images: Sequence[np.ndarray], *, cut: float = 0.0) -> None:
    """H.264 with colors at full resolution, almost lossless; one keyframe, at the beginning.

    cut: seconds at the beginning that an edit list leaves out.
    """
    av = __import__("av")
    options = {"avoid_negative_ts": "disabled", "use_editlist": "1"} if cut else {}
    with av.open(str(path), "w", options=options) as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = images[0].shape[1], images[0].shape[0], "yuv444p"
        frames = [av.VideoFrame.from_ndarray(image, "rgb24") for image in images]
        for packet in [*(packet for frame in frames for packet in stream.encode(frame)), *stream.encode()]:
            packet.pts -= round(cut / packet.time_base)
            packet.dts -= round(cut / packet.time_base)
            file.mux(packet)


# COLMAP, and what writes its models: MegaSaM, VGGT

# The parameters of each model of a camera, and its number in binary files.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
}


def write_model(
    folder: Path,
    poses: Mapping[str, Camera],
    model: str,
    lens: Lens,
    *,
    binary: bool,
    points: bool = True,
    each: bool = False,
    offset: NDArray[np.float64] | float = 0.0,
) -> None:
    """A sparse model; each image sees two points, each point is seen by two images. each: a camera of its own for
    every image, else one for all. offset: (3,), added to the points."""
    folder.mkdir(parents=True)
    number, names = COLMAP_MODELS[model]
    K = next(iter(poses.values())).K
    values = {"fx": K[0, 0], "fy": K[1, 1], "f": K[0, 0], "cx": K[0, 2], "cy": K[1, 2], **lens}
    parameters = [float(values.get(name, 0.0)) for name in names.split()]
    ids = range(7, 7 + len(poses)) if each else [7] * len(poses)
    rows = [
        (name, [*np.roll(Rotation.from_matrix(c.T_cam_world[:3, :3]).as_quat(), 1), *c.T_cam_world[:3, 3]], camera)
        for (name, c), camera in zip(poses.items(), ids, strict=True)
    ]
    blobs = Blobs.random()
    cloud = (
        list(zip((blobs.means.double().numpy() + offset).tolist(), blobs.bytes_of_colors.tolist(), strict=True))
        if points
        else []
    )
    if binary:
        content = {name: struct.pack("<Q", n) for name, n in
                   (("cameras", len(set(ids))), ("images", len(rows)), ("points3D", len(cloud)))}  # fmt: skip
        for camera in dict.fromkeys(ids):
            content["cameras"] += struct.pack("<IiQQ", camera, number, WIDTH, HEIGHT)
            content["cameras"] += struct.pack(f"<{len(parameters)}d", *parameters)
        for i, (name, pose, camera) in enumerate(rows, 1):
            content["images"] += struct.pack("<I7dI", i, *pose, camera) + name.encode() + b"\0"
            content["images"] += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.5, 2.5, -1)
        for i, (point, color) in enumerate(cloud, 1):
            content["points3D"] += struct.pack("<Q3d3BdQ4I", i, *point, *color, 0.5, 2, 1, 0, 2, 1)
        for name, data in content.items():
            (folder / f"{name}.bin").write_bytes(data)
        return
    lines = {"cameras": ["# Cameras"], "images": ["# Images"], "points3D": ["# Points"]}
    for camera in dict.fromkeys(ids):
        lines["cameras"].append(f"{camera} {model} {WIDTH} {HEIGHT} {' '.join(map(repr, parameters))}")
    for i, (name, pose, camera) in enumerate(rows, 1):
        row = f"{i} {' '.join(map(repr, map(float, pose)))} {camera} {name}"
        lines["images"] += [row, "1.5 2.5 -1 1.5 2.5 -1" if i > 1 else ""]
    for i, (point, color) in enumerate(cloud, 1):
        lines["points3D"].append(f"{i} {' '.join(map(repr, point))} {' '.join(map(str, color))} 0.5 1 0 2 1")
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(text) + "\n")


def write_colmap(
    folder: Path,
    device: Device,
    *,
    count: int = COUNT,
    model: str = "PINHOLE",
    lens: Lens | None = None,
    principal: tuple[float, float] = (0, 0),
    binary: bool = True,
    name: str = "frame_{:04d}.png",
    sparse: str = "sparse/0",
    points: bool = True,
    each: bool = False,
) -> Path:
    """One camera that moves past the blobs; the cloud is their middles, in their colors."""
    shots = {name.format(i): shot for i, shot in enumerate(film(device, count, lens=lens, principal=principal), 1)}
    for file, shot in shots.items():
        shot.save(folder / "images" / file)
    poses = {file: shot.camera for file, shot in shots.items()}
    write_model(folder / sparse, poses, model, lens or {}, binary=binary, points=points, each=each)
    return folder


def write_megasam(folder: Path, device: Device) -> Path:
    return write_colmap(folder, device, binary=False, name="{:05d}.png", sparse="sparse", points=False)


def write_vggt(folder: Path, device: Device) -> Path:
    """With a cloud for viewers beside the model."""
    write_colmap(folder, device, sparse="sparse", each=True)
    (folder / "sparse/points.ply").write_bytes(b"ply\n")
    return folder


def write_rig(folder: Path, device: Device, *, count: int = 4, frames: int = 3) -> Path:
    """Still cameras see the moving blobs; COLMAP has seen the first image of each camera alone."""
    poses = {f"cam{number:02d}/0000.png": camera for number, camera in enumerate(cameras(count))}
    for file, camera in poses.items():
        for frame in range(frames):
            Shot(camera, moved(frame).drawn(camera, device)).save(folder / "images" / file[:6] / f"{frame:04d}.png")
    write_model(folder / "sparse/0", poses, "PINHOLE", {}, binary=True, points=True, each=False)
    return folder


# nerfstudio's transforms.json, and ARKit's poses in it


def write_nerfstudio(
    folder: Path,
    device: Device,
    *,
    count: int = COUNT,
    lens: Lens | None = None,
    principal: tuple[float, float] = (0, 0),
    each: bool = False,
) -> Path:
    """One camera that moves past the blobs, and a cloud as text. each: every frame has its own intrinsics."""
    data: dict[str, Any] = {"camera_model": "OPENCV", "frames": [], "ply_file_path": "sparse_pc.ply"}
    for i, shot in enumerate(film(device, count, lens=lens, principal=principal)):
        file = f"images/frame_{i + 1:05d}.png"
        shot.save(folder / file)
        own = {**intrinsics(shot.camera, "w h fl_x fl_y cx cy"), **(lens or {})}
        frame = {"file_path": f"./{file}", "transform_matrix": opengl(shot.camera).tolist(), "time": 2.0 + i / 10}
        data["frames"].append({**frame, **(own if each else {})})
        data |= {} if each else own
    blobs = Blobs.random()
    write_points(folder / "sparse_pc.ply", blobs.means.numpy(), blobs.bytes_of_colors, text=True)
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def write_arkit(folder: Path, device: Device) -> Path:
    """As NeRFCapture: no cloud, no suffixes, timestamps since the phone was started, intrinsics of the file that say
    nothing."""
    write_nerfstudio(folder, device, principal=(3, 3), each=True)
    (folder / "sparse_pc.ply").unlink()
    data = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(data["frames"]):
        frame |= {"file_path": frame["file_path"][2:-4], "timestamp": 81234.5 + 0.2 * i}
        frame |= {"depth_path": f"images/{i}.depth.png"}
        del frame["time"]
    head = {"fl_x": 1.0, "fl_y": 1.0, "cx": 320.0, "cy": 240.0, "w": WIDTH, "h": HEIGHT, "depth_integer_scale": 1.0}
    (folder / "transforms.json").write_text(json.dumps(head | {"frames": data["frames"]}))
    return folder


# Record3D, Polycam, EndoNeRF


def write_record3d(folder: Path, device: Device, *, unpacked: bool = False, each: bool = True) -> Path:
    """unpacked: an .r3d. each: with intrinsics of each frame and times; without, K and fps."""
    shots = film(device, principal=(3, -2))
    for i, shot in enumerate(shots):
        shot.save(folder / ("rgbd" if unpacked else "rgb") / f"{i}.jpg", quality=98, subsampling=0)
    poses = [opengl(shot.camera) for shot in shots]
    rows = [[*Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), *pose[:3, 3].tolist()] for pose in poses]
    K = shots[0].camera.K
    data: dict[str, Any] = {"w": WIDTH, "h": HEIGHT, "fps": 60, "K": K.T.ravel().tolist(), "poses": rows}
    if each:
        data |= {"perFrameIntrinsicCoeffs": [[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]] * COUNT}
        data |= {"frameTimestamps": [0.0, 0.1, 0.2, 0.3, 0.4, 0.6]}
    (folder / ("metadata" if unpacked else "metadata.json")).write_text(json.dumps(data))
    return folder


def write_polycam(folder: Path, device: Device, *, corrected: bool = True) -> Path:
    """corrected: with cameras of its optimizer; the others are wrong then."""
    for i, shot in enumerate(film(device, principal=(-2, 4))):
        name = str(9_900_000 + 125_000 * i)
        shot.save(folder / f"keyframes/images/{name}.jpg", quality=98, subsampling=0)
        for kind in ("cameras", "corrected_cameras") if corrected else ("cameras",):
            pose = np.eye(4) if corrected and kind == "cameras" else opengl(shot.camera)
            data = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
            data |= intrinsics(shot.camera, "width height fx fy cx cy")
            (folder / "keyframes" / kind).mkdir(exist_ok=True)
            data |= {"timestamp": int(name), "blur_score": 120.0}
            (folder / "keyframes" / kind / f"{name}.json").write_text(json.dumps(data))
    (folder / "mesh_info.json").write_text("{}")
    return folder


def write_endonerf(folder: Path, device: Device, *, depth: bool = True) -> Path:
    """A camera at the origin, before it the moving blobs. With depth maps of 16 bits, in hundredths of a unit."""
    camera = cameras(1)[0]
    for i in range(10):
        blobs = moved(i)
        Shot(camera, blobs.drawn(camera, device)).save(folder / f"images/frame-{i:06d}.color.png")
        z = float((blobs.means.double().numpy() @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]).mean())
        if depth:
            plane = np.full((HEIGHT, WIDTH), round(100 * z), np.uint16)
            Shot(camera, plane).save(folder / f"depth/{i:06d}.png")
    (folder / "masks").mkdir()
    row = np.concatenate([np.eye(3, 4), [[HEIGHT], [WIDTH], [camera.K[0, 0]]]], axis=1)
    np.save(folder / "poses_bounds.npy", np.tile([*row.ravel(), 100 * NEAR, 1000 * NEAR], (10, 1)))
    return folder


# Every layout that is read.
WRITERS: dict[str, Callable[[Path, Device], Path]] = {
    "D-NeRF": lambda folder, device: make_scene(folder),
    "COLMAP": partial(write_colmap, binary=False),
    "COLMAP binary": write_colmap,
    "nerfstudio": write_nerfstudio,
    "ARKit": write_arkit,
    "nerfies": write_nerfies,
    "Neu3D": write_neu3d,
    "films": partial(write_neu3d, count=3, video=True),
    "Record3D": write_record3d,
    "Polycam": write_polycam,
    "EndoNeRF": write_endonerf,
}
