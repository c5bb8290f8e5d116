"""Small captures as other programs export them, of what cameras see of blobs (`captures`)."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
from helpers.captures import HEIGHT, NEAR, WIDTH, cameras, film, moved, quaternion, write_colmap
from PIL import Image
from scipy.spatial.transform import Rotation

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera

COUNT = 6
GL = np.diag([1.0, -1.0, -1.0, 1.0])


def opengl(camera: Camera) -> np.ndarray:
    """(4, 4) camera to world, ARKit's axes."""
    return np.linalg.inv(camera.T_cam_world) @ GL


def write_record3d(folder: Path, device: Device, *, unpacked: bool = False, each: bool = True) -> Path:
    """unpacked: an .r3d. each: with intrinsics of each frame and times; without, K and fps."""
    images = folder / ("rgbd" if unpacked else "rgb")
    images.mkdir(parents=True)
    poses, coefficients = [], []
    for i, (camera, picture) in enumerate(film(device, COUNT, principal=(3, -2))):
        Image.fromarray(picture).save(images / f"{i}.jpg", quality=98, subsampling=0)
        pose, K = opengl(camera), camera.K
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), *pose[:3, 3].tolist()])
        coefficients.append([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    data: dict[str, Any] = {"w": WIDTH, "h": HEIGHT, "fps": 60, "K": K.T.ravel().tolist(), "poses": poses}
    if each:
        data |= {"perFrameIntrinsicCoeffs": coefficients, "frameTimestamps": [0.0, 0.1, 0.2, 0.3, 0.4, 0.6]}
    (folder / ("metadata" if unpacked else "metadata.json")).write_text(json.dumps(data))
    return folder


def write_polycam(folder: Path, device: Device, *, corrected: bool = True) -> Path:
    """corrected: with cameras of its optimizer; the others are wrong then."""
    for i, (camera, picture) in enumerate(film(device, COUNT, principal=(-2, 4))):
        name, K = str(9_900_000 + 125_000 * i), camera.K
        for kind in ("cameras", "corrected_cameras") if corrected else ("cameras",):
            pose = opengl(camera) if kind == "corrected_cameras" or not corrected else np.eye(4)
            data = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
            data |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDTH, "height": HEIGHT}
            (folder / "keyframes" / kind).mkdir(parents=True, exist_ok=True)
            data |= {"timestamp": int(name), "blur_score": 120.0}
            (folder / "keyframes" / kind / f"{name}.json").write_text(json.dumps(data))
        (folder / "keyframes/images").mkdir(exist_ok=True)
        Image.fromarray(picture).save(folder / f"keyframes/images/{name}.jpg", quality=98, subsampling=0)
    (folder / "mesh_info.json").write_text("{}")
    return folder


def write_arkit(folder: Path, device: Device) -> Path:
    """As NeRFCapture: intrinsics of each frame, no suffixes, timestamps since the phone was started."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, (camera, picture) in enumerate(film(device, COUNT, principal=(3, 3))):
        Image.fromarray(picture).save(folder / f"images/{i}.png")
        K = camera.K
        frame = {
            "file_path": f"images/{i}",
            "timestamp": 81234.5 + 0.2 * i,
            "transform_matrix": opengl(camera).tolist(),
        }
        frame |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": WIDTH, "h": HEIGHT}
        frames.append(frame | {"depth_path": f"images/{i}.depth.png"})
    head = {"fl_x": 1.0, "fl_y": 1.0, "cx": 320.0, "cy": 240.0, "w": WIDTH, "h": HEIGHT, "depth_integer_scale": 1.0}
    (folder / "transforms.json").write_text(json.dumps(head | {"frames": frames}))
    return folder


def write_megasam(folder: Path, device: Device) -> Path:
    """A text model in sparse/ without points or features; its camera states images that were shrunk and cropped."""
    taken = film(device, COUNT)
    scale = np.sqrt(384 * 512 / (WIDTH * HEIGHT))
    width, height = int(WIDTH * scale), int(HEIGHT * scale)
    (folder / "images").mkdir(parents=True)
    (folder / "sparse").mkdir()
    K = taken[0][0].resized(width, height).K
    size = f"{width - width % 8} {height - height % 8}"
    line = f"# a camera\n1 PINHOLE {size} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n"
    (folder / "sparse/cameras.txt").write_text(line)
    lines = ["# images"]
    for i, (camera, picture) in enumerate(taken):
        Image.fromarray(picture).save(folder / f"images/{i:05d}.png")
        pose = [*quaternion(camera.T_cam_world[:3, :3]), *camera.T_cam_world[:3, 3]]
        lines += [f"{i + 1} {' '.join(map(str, pose))} 1 {i:05d}.png", ""]
    (folder / "sparse/images.txt").write_text("\n".join(lines) + "\n")
    (folder / "sparse/points3D.txt").write_text("# Empty point cloud\n")
    return folder


def write_vggt(folder: Path, device: Device) -> Path:
    """A binary model in sparse/ with a PINHOLE camera for each image, and a cloud for viewers beside it."""
    write_colmap(folder, device, count=COUNT, model="PINHOLE", name="frame_{:03d}.png")
    shutil.move(folder / "sparse/0", folder / "moved")
    (folder / "sparse").rmdir()
    shutil.move(folder / "moved", folder / "sparse")
    data = (folder / "sparse/cameras.bin").read_bytes()
    one = data[8:]
    rows = b"".join(struct.pack("<I", 1 + i) + one[4:] for i in range(COUNT))
    (folder / "sparse/cameras.bin").write_bytes(struct.pack("<Q", COUNT) + rows)
    images = (folder / "sparse/images.bin").read_bytes()
    size = (len(images) - 8) // COUNT
    found = bytearray(images)
    for i in range(COUNT):
        struct.pack_into("<I", found, 8 + i * size + 4 + 56, 1 + i)
    (folder / "sparse/images.bin").write_bytes(bytes(found))
    (folder / "sparse/points.ply").write_bytes(b"ply\n")
    return folder


def write_endonerf(folder: Path, device: Device, *, depth: bool = True) -> Path:
    """A camera at the origin, before it the blobs, which move. With depth maps of 16 bits, in hundredths of a unit."""
    camera = cameras(1)[0]
    for name in ("images", "depth", "masks"):
        (folder / name).mkdir(parents=True)
    for i in range(10):
        blobs = moved(i)
        Image.fromarray(blobs.drawn(camera, device)).save(folder / f"images/frame-{i:06d}.color.png")
        z = float((blobs.means.double().numpy() @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]).mean())
        Image.fromarray(np.full((HEIGHT, WIDTH), round(100 * z), np.uint16)).save(folder / f"depth/{i:06d}.png")
    row = np.concatenate([np.eye(3, 4), [[HEIGHT], [WIDTH], [camera.K[0, 0]]]], axis=1)
    np.save(folder / "poses_bounds.npy", np.tile([*row.ravel(), 100 * NEAR, 1000 * NEAR], (10, 1)))
    if not depth:
        shutil.rmtree(folder / "depth")
    return folder
