"""What is wrong with a capture's files is refused in one line that names the file and the field."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.captures import (
    HEIGHT,
    WIDTH,
    WRITERS,
    Blobs,
    cameras,
    llff_row,
    write_colmap,
    write_nerfies,
    write_neu3d,
    write_points,
)
from helpers.damaged_captures import (
    GONE,
    Damage,
    array,
    claimed_size,
    gone,
    image,
    item,
    put,
    refused,
    replaced,
    rows,
    text,
    word,
)
from helpers.damaged_files import with_checksums
from helpers.dnerf_scene import camera_to_world, make_scene

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device

NAN, FAR = math.nan, 1e12
Case = tuple[Damage, str]  # and the words, without spaces, that the error must name

TRAIN = "transforms_train.json"


def of_frame(field: str, value: Any) -> Damage:
    return put(TRAIN, "frames", 1, field, value)


def with_axes(factors: list[float]) -> Damage:
    pose = np.array(camera_to_world(1))
    pose[:3, :3] *= factors
    return of_frame("transform_matrix", pose.tolist())


def other_entry(row: int, column: int, value: Any) -> Damage:
    pose = camera_to_world(1)
    pose[row][column] = value
    return of_frame("transform_matrix", pose)


def without_pixels(folder: Path) -> None:
    """Pillow ends in an IndexError where a PNG has no IDAT."""
    path = folder / "train/r_001.png"
    path.write_bytes(with_checksums(path.read_bytes().replace(b"IDAT", b"IDAU")))


DNERF: list[Case] = [
    (gone(TRAIN), TRAIN),
    (gone("transforms_test.json"), "transforms_test.json"),
    (text(TRAIN, '{"frames": [}'), TRAIN),
    (text(TRAIN, "[" * 100_000), TRAIN),
    (text(TRAIN, '{"camera_angle_x": 1' + "0" * 5000 + "}"), TRAIN),
    (put(TRAIN, "camera_angle_x", GONE), f"{TRAIN} camera_angle_x"),
    (put(TRAIN, "camera_angle_x", 39.6), "camera_angle_x radians 39.6"),
    (of_frame("fl_x", 1e9), f"{TRAIN} fl_x 1"),
    (put(TRAIN, "k4", 0.1), "k4"),
    (put(TRAIN, "camera_model", "OPENCV_FISHEYE"), "camera_model OPENCV_FISHEYE"),
    (put(TRAIN, "frames", []), "frames"),
    (of_frame("file_path", GONE), f"{TRAIN} file_path"),
    (of_frame("file_path", "a\0b"), f"{TRAIN} file_path"),
    (text("train/r_001.png", "hello"), "r_001.png"),
    (lambda folder: (gone("train/r_001.png")(folder), (folder / "train/r_001.png").mkdir()), f"{TRAIN} r_001.png"),
    (without_pixels, "r_001.png"),
    (image("test/r_000.png", (10, 7)), "test/r_000.png 10x7 train/r_000.png 12x8"),
    (of_frame("time", GONE), f"{TRAIN} time"),
    (of_frame("time", 1.5), f"{TRAIN} time 1.5"),
    (of_frame("time", NAN), f"{TRAIN} time nan"),
    (of_frame("transform_matrix", [[1]] * 4), f"{TRAIN} transform_matrix"),
    (of_frame("transform_matrix", np.transpose(camera_to_world(1)).tolist()), TRAIN),
    (other_entry(0, 3, "x"), "transform_matrix 'x'"),
    (other_entry(0, 3, 10**400), "transform_matrix"),
    (with_axes([2, 2, 2]), "transform_matrix rotation"),
    (with_axes([1, 1, -1]), "transform_matrix left-handed"),
]

MODEL = "sparse/0"


def times(**others: Any) -> Damage:
    values = {f"frame_{i:04d}.png": i for i in range(1, 7)} | {f"{name}.png": value for name, value in others.items()}
    return text("times.json", json.dumps(values))


COLMAP: list[Case] = [
    (gone("images"), "images"),
    (gone("images/frame_0002.png", "images/frame_0003.png"), "frame_0002.png images.txt"),
    (gone(f"{MODEL}/points3D.txt"), "points3D.txt"),
    (replaced(f"{MODEL}/cameras.txt", "PINHOLE", "EQUIRECTANGULAR"), "cameras.txt EQUIRECTANGULAR panoramas"),
    (word(f"{MODEL}/cameras.txt", 1, 4, "1e-9"), "cameras.txt"),
    (word(f"{MODEL}/cameras.txt", 1, 6, "nan"), "cx nan"),
    (word(f"{MODEL}/cameras.txt", 1, 3, "64"), "64x48 64x64 cameras.txt"),
    (word(f"{MODEL}/images.txt", 1, 8, "9"), "images.txt"),
    (word(f"{MODEL}/images.txt", 1, 1, "3"), "images.txt"),
    (word(f"{MODEL}/images.txt", 1, 5, "1e12"), "frame_0001.png 1e+12"),
    (word(f"{MODEL}/points3D.txt", 1, 1, "x"), "points3D.txt"),
    (word(f"{MODEL}/points3D.txt", 3, 1, "nan"), "points3D.txt"),
    (text(f"{MODEL}/images.txt", "#\n"), MODEL),
    (text(f"{MODEL}/images.txt", b"\xff\xfe"), "images.txt"),
    (text("times.json", '{"frame_0001.png": 1}'), "times.json frame_0002.png"),
    (times(frame_0002="one"), "times.json frame_0002.png 'one'"),
]
COUNT_OF_POINT = 8 + 8 + 24 + 3 + 8  # where the first point says how many images see it


def packed(file: str, at: int, number: int) -> Damage:
    """Another 64-bit count in a binary file."""

    def change(folder: Path) -> None:
        data = bytearray((folder / file).read_bytes())
        data[at : at + 8] = struct.pack("<Q", number)
        (folder / file).write_bytes(bytes(data))

    return change


BINARY: list[Case] = [
    *((packed(f"{MODEL}/{name}.bin", 0, count), f"{name}.bin")
      for name in ("cameras", "images", "points3D") for count in (1000, 2**64 - 1)),
    (packed(f"{MODEL}/points3D.bin", COUNT_OF_POINT, 2**61), "points3D.bin"),
    (replaced(f"{MODEL}/images.bin", b".png\0" + struct.pack("<Q", 2), b".png\0" + struct.pack("<Q", 2**61)),
     "images.bin"),
    (text(f"{MODEL}/images.bin", struct.pack("<QI7dI", 1, 1, 1, *6 * [0.0], 7) + 200 * b"a"), "images.bin"),
    (text(f"{MODEL}/cameras.bin", struct.pack("<QIiQQ8d", 1, 7, 5, WIDTH, HEIGHT, *8 * [1.0])),
     "cameras.bin OPENCV_FISHEYE"),
    (text(f"{MODEL}/cameras.bin", struct.pack("<QIiQQ8d", 1, 7, 77, WIDTH, HEIGHT, *8 * [1.0])), "cameras.bin 77"),
]  # fmt: skip

FILE = "transforms.json"


def opencv(folder: Path) -> None:
    data = json.loads((folder / FILE).read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])).tolist()
    (folder / FILE).write_text(json.dumps(data))


CLOUD = "sparse_pc.ply"
NERFSTUDIO: list[Case] = [
    (put(FILE, "frames", 1, "file_path", "../other/a.png"), "frame file_path"),
    (lambda folder: [put(FILE, "frames", i, "file_path", f"images/x{i}.png")(folder) for i in (1, 2)], "images/x1.png"),
    (put(FILE, "frames", 1, "file_path", "images/frame_00001.png"), "frame_00001.png"),
    (put(FILE, "frames", 1, "time", GONE), "frame time"),
    (put(FILE, "ply_file_path", "x.ply"), "ply_file_path x.ply"),
    (put(FILE, "fl_x", GONE), "fl_x"),
    (put(FILE, "w", 32), "64x48 32x48"),
    (put(FILE, "is_fisheye", True), "is_fisheye"),
    (put(FILE, "k1", -90), "frame"),
    (put(FILE, "test_filenames", ["x.png"]), "test_filenames"),
    (put(FILE, "test_filenames", [f"images/frame_{i:05d}.png" for i in range(1, 7)]), "images"),
    (opencv, "OpenGL"),
    (lambda folder: (opencv(folder), put(FILE, "ply_file_path", GONE)(folder)), "OpenGL"),
    (replaced(CLOUD, "element vertex 40", "element vertex 41"), f"{CLOUD} 41"),
    (replaced(CLOUD, "end_header\n", "end_header\nnan nan nan 0 0 0\n"), CLOUD),
]
ARKIT: list[Case] = [(put(FILE, "frames", 1, "timestamp", GONE), "frame timestamp")]

ID, TEST_ID = "left_000001", "left_000004"
CAMERA = f"camera/{ID}.json"
NERFIES: list[Case] = [
    *((gone(name), name) for name in ("scene.json", "metadata.json", CAMERA, "rgb")),
    (gone(f"rgb/1x/{ID}.png", "rgb/1x/left_000002.png"), f"rgb/1x/{ID}.png dataset.json"),
    (put("dataset.json", "ids", GONE), "dataset.json ids"),
    (put("dataset.json", "ids", ["../../x"]), "dataset.json ids ../../x"),
    (put("dataset.json", "ids", ["a", "a"]), "dataset.json"),
    (put("dataset.json", "train_ids", ["x"]), "train_ids"),
    (put("dataset.json", "val_ids", [ID]), f"train_ids {ID}"),
    (put("scene.json", "scale", NAN), "scene.json scale nan"),
    (put("scene.json", "near", 9), "scene.json near far"),
    (put("metadata.json", ID, GONE), f"metadata.json {ID}"),
    (put("metadata.json", ID, "warp_id", GONE), f"metadata.json {ID} warp_id"),
    (put("metadata.json", ID, "time_id", 4), "metadata.json time_id"),
    (put(CAMERA, "orientation", np.diag([1, 1, -1]).tolist()), "left-handed"),
    (put(CAMERA, "position", [0, 0, FAR]), "position 1e+12"),
    (put(CAMERA, "focal_length", 1e9), f"{CAMERA} focal_length"),
    (put(CAMERA, "radial_distortion", [900, 0, 0]), f"{CAMERA} radial_distortion"),
    (put(CAMERA, "image_size", [64, 64]), f"rgb/1x 64x48 64x64 {CAMERA}"),
    (array("points.npy", np.zeros((0, 3))), "points.npy"),
    (array("points.npy", np.full((5, 3), NAN)), "points.npy"),
    # A cloud in other coordinates: moved as scene.json says, larger, smaller.
    (rows("points.npy", lambda p: (p - [0.5, -1.0, 0.25]) * 0.2 + [40, 0, 0]), "points.npy"),
    (rows("points.npy", lambda p: p * 1e3), "points.npy"),
    (rows("points.npy", lambda p: p * 1e-4 + [0.3, -0.2, 0.5]), "points.npy"),
]  # fmt: skip

POSES = "poses_bounds.npy"


def square(folder: Path) -> None:
    for file in folder.glob("cam*/images/*.png"):
        image(str(file), (64, 64))(folder)


def cloud(points: np.ndarray) -> Damage:
    return lambda folder: write_points(folder / "points3D.ply", points)


def opencv_rows(_: np.ndarray) -> np.ndarray:
    """Whose third axis points ahead."""
    found = np.array([llff_row(camera) for camera in cameras(4)])
    found[:, [2, 7, 12]] *= -1
    return found


NEU3D: list[Case] = [
    (text(POSES, "hello"), POSES),
    (replaced(POSES, b"'<f8'", b"'|O' "), POSES),
    (replaced(POSES, b"(4, 17), }          ", b"(9999999999, 17), }"), POSES),
    (rows(POSES, lambda p: p[:, :14]), f"{POSES} 17"),
    (item(POSES, 1, 2, NAN), f"{POSES} nan"),
    (item(POSES, 2, 14, 0), f"{POSES} focal"),
    (item(POSES, 3, slice(15, 17), [8, 2]), POSES),
    (item(POSES, 0, slice(0, 3), [2, 0, 0]), f"{POSES} rotation"),
    (rows(POSES, opencv_rows), f"{POSES} left-handed"),
    (gone("cam01", "cam02", "cam03"), "cameras"),
    (gone(*(f"cam01/images/{i:04d}.png" for i in range(3))), "cam01/images"),
    (gone("cam02/images/0001.png"), "cam02 cam00"),
    (image("cam02/images/0002.png", (32, 24)), "cam02/images/0002.png 32x24 64x48"),
    (square, f"cam00 64x64 128x96 {POSES}"),
    (image("cam01/images/x_001.png", (WIDTH, HEIGHT)), "cam01 cam00"),
    (cloud(Blobs.random().means.numpy() + np.array([50, 0, 0])), "points3D.ply"),
]

RECORD3D: list[Case] = [
    (put("metadata.json", "poses", [[0, 0, 0, 1, 0, 0, 0]] * 5), "5.jpg"),
    (put("metadata.json", "poses", 2, [1, 1, 0, 0, 0, 0, 0]), "frame"),
    (put("metadata.json", "perFrameIntrinsicCoeffs", 1, 0, "x"), "perFrameIntrinsicCoeffs"),
    (put("metadata.json", "frameTimestamps", [0.0]), "frameTimestamps"),
    (put("metadata.json", "w", GONE), "w"),
]
POLYCAM: list[Case] = [
    (gone("keyframes/images/9900000.jpg", "keyframes/images/10025000.jpg"), "9900000 9900000.json"),
    (put("keyframes/corrected_cameras/*.json", "fx", GONE), "fx"),
    (put("keyframes/corrected_cameras/*.json", "t_00", 3.0), "rotation"),
    (gone(*(f"keyframes/corrected_cameras/{9_900_000 + 125_000 * i}.json" for i in range(6))), "camera"),
]
ENDONERF: list[Case] = [
    (rows(POSES, lambda p: p[:-1]), "poses"),
    (item(POSES, 3, 15, 0.0), "row"),
    (gone("depth/000003.png"), "depth"),
    (image("depth/000000.png", (5, 5), "I;16"), "000000.png"),
    (claimed_size("depth/000000.png", 30_000), "000000.png"),
    (text("depth/000000.png", "hello"), "000000.png"),
]

CASES = {
    "D-NeRF": DNERF,
    "COLMAP": COLMAP,
    "COLMAP binary": BINARY,
    "nerfstudio": NERFSTUDIO,
    "ARKit": ARKIT,
    "nerfies": NERFIES,
    "Neu3D": NEU3D,
    "Record3D": RECORD3D,
    "Polycam": POLYCAM,
    "EndoNeRF": ENDONERF,
}


@pytest.mark.parametrize(("layout", "number"), [(name, i) for name, cases in CASES.items() for i in range(len(cases))])
def test_a_bad_capture_is_refused(layout: str, number: int, device: Device, tmp_path: Path) -> None:
    damage, named = CASES[layout][number]
    folder = WRITERS[layout](tmp_path / "toy", device)
    damage(folder)
    refused(folder, *named.split())


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_files_of_another_length(name: str, device: Device, tmp_path: Path) -> None:
    """Cut anywhere, or with more than they declare: never read beyond the end."""
    toy = write_colmap(tmp_path / "toy", device)
    path = toy / f"{MODEL}/{name}.bin"
    whole = path.read_bytes()
    for data in (*(whole[:size] for size in (0, 4, 8, 9, len(whole) // 2, len(whole) - 1)), whole + b"x"):
        path.write_bytes(data)
        refused(toy, f"{name}.bin")


def test_too_few_images(device: Device, tmp_path: Path) -> None:
    refused(write_colmap(tmp_path / "toy", device, count=4), "4 images")


def test_folders_of_another_kind(device: Device, tmp_path: Path) -> None:
    """None, a file, a folder of scenes, and one of two formats."""
    refused(tmp_path / "nowhere", "nowhere")
    (tmp_path / "file").write_text("")
    refused(tmp_path / "file", "file")
    write_neu3d(tmp_path / "scenes/hook", device)
    refused(tmp_path / "scenes", "hook", "transforms_train.json", "dataset.json", "poses_bounds.npy", "Neu3D")
    write_nerfies(tmp_path / "scenes/hook", device)
    refused(tmp_path / "scenes/hook", "HyperNeRF", "Neu3D")


def test_an_image_lost_or_spoilt_after_opening_is_named(tmp_path: Path) -> None:
    folder = make_scene(tmp_path / "toy")
    views = load_dataset(folder).train
    gone("train/r_000.png")(folder)
    replaced("train/r_001.png", b"IEND", b"IENX")(folder)
    path = folder / "train/r_001.png"
    path.write_bytes(path.read_bytes()[:-60])
    image("train/r_002.png", (32, 24))(folder)
    for view, file in zip(views, ("r_000.png", "r_001.png", "r_002.png"), strict=True):
        with pytest.raises(InputError, match=file):
            view.load()


@pytest.mark.parametrize("name", ["../other/r", "/etc/passwd", "train/../../other/r", "C:\\r", "\\\\host\\r", "..\\r"])
def test_images_lie_in_the_scene(name: str, tmp_path: Path) -> None:
    """Also those that exist."""
    other = make_scene(tmp_path / "other")
    (other / "r.png").write_bytes((other / "train/r_000.png").read_bytes())
    folder = make_scene(tmp_path / "toy")
    of_frame("file_path", name)(folder)
    refused(folder, TRAIN, "file_path", "folder")


def test_a_link_in_a_scene_is_followed(tmp_path: Path) -> None:
    other, folder = make_scene(tmp_path / "other"), make_scene(tmp_path / "toy")
    (folder / "elsewhere").symlink_to(other / "train")
    of_frame("file_path", "train/../elsewhere/./r_000")(folder)
    assert len(load_dataset(folder).train) == 3
