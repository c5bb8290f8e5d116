"""Inputs of lapgs-prepare as people have them: images, zip files, calibrations, and poses of other programs."""

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import opengl
from helpers.films import Board, drawn, noise_pictures, pose_errors, walk, write_film
from PIL import Image
from scipy.spatial.transform import Rotation

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.calibration import match_names, read_calibration
from lapgs_wgpu.prepare.capture import prepare
from lapgs_wgpu.prepare.inputs import open_inputs
from lapgs_wgpu.splat.camera import Camera

pytest.importorskip("av")
pytest.importorskip("pycolmap")

SIZE = 200, 150


def write_images(folder: Path, suffix: str = ".png", count: int = 6) -> list[Path]:
    folder.mkdir(parents=True)
    files = [folder / f"IMG_{i:04d}{suffix}" for i in range(8, 8 + count)]
    for file, picture in zip(files, noise_pictures(count), strict=True):
        exif = Image.Exif()
        exif[0x0112] = 6  # held upright
        exif.get_ifd(0x8769)[0xA405] = 26
        Image.fromarray(np.rot90(picture)).save(file, exif=exif)
    return files


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".avif", ".webp"])
@pytest.mark.parametrize("way", ["folder", "pattern", "files", "zip", "capture"])
def test_images(suffix: str, way: str, tmp_path: Path) -> None:
    """Of one camera, upright, in the order of their numbers, with their focal length. Folders in one are cameras."""
    files = write_images(tmp_path / "images", suffix)
    write_images(tmp_path / "rig/cam10", ".jpg")
    write_images(tmp_path / "rig/cam2", ".jpg")
    assert [film.path.name for film in open_inputs([tmp_path / "rig"], tmp_path / "work")] == ["cam2", "cam10"]
    with zipfile.ZipFile(tmp_path / "it.zip", "w") as file:
        for image in files:
            file.write(image, f"trip/{image.name}")
        file.writestr("__MACOSX/trip/._IMG_0009.jpg", "x")
    named = {"pattern": [tmp_path / "images" / f"*{suffix}"], "files": files[::-1], "zip": [tmp_path / "it.zip"]}
    (film,) = open_inputs(named.get(way, [tmp_path / ("images" if way == "folder" else ".")]), tmp_path / "work")
    frames = list(film.frames())
    assert [frame.name for frame in frames] == [file.stem for file in files]
    assert [frame.seconds for frame in frames] == pytest.approx(np.arange(6) / 30)
    assert frames[1].pixels(1000).shape == (48, 64, 3)
    assert np.abs(frames[1].pixels(1000).astype(int) - noise_pictures(6)[1]).mean() < 12
    assert b"\x00\x1a" in frames[0].exif


# Cameras that are known


def opencv(name: str, array: np.ndarray) -> str:
    rows, columns = array.reshape(len(array), -1).shape
    data = ", ".join(map(repr, array.ravel().tolist()))
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def qualisys(camera: Camera, number: int) -> str:
    R, place, K = np.diag([1, -1, -1]) @ camera.T_cam_world[:3, :3], 1000 * camera.position, 64 * camera.K
    turned = " ".join(f'r{i + 1}{j + 1}="{float(R[i, j])!r}"' for i in range(3) for j in range(3))
    lens = f'focalLengthU="{K[0, 0]}" focalLengthV="{K[1, 1]}" centerPointU="{K[0, 2] - 32}"'
    lens += f' centerPointV="{K[1, 2] - 32}" radialDistortion1="0.1" radialDistortion2="0.02"'
    return (
        f'<camera serial="cam{number}"><fov_video left="0" right="{camera.width - 1}" top="0" '
        f'bottom="{camera.height - 1}"/><transform x="{place[0]}" y="{place[1]}" z="{place[2]}" {turned}/>'
        f'<intrinsic {lens} tangentalDistortion1="0.001" tangentalDistortion2="0.002"/></camera>'
    )


def write_calibration(folder: Path, form: str, cameras: list[Camera], distortion: tuple[float, ...]) -> Path:
    """Of cam0, cam1, ... in one of the formats. distortion: k1, k2, p1, p2."""
    folder.mkdir(exist_ok=True)
    numbered = list(enumerate(cameras))
    near = [c.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]] for c in cameras]  # OpenCV's pixels
    turns = [Rotation.from_matrix(c.T_cam_world[:3, :3]).as_rotvec() for c in cameras]
    moves = [c.T_cam_world[:3, 3] for c in cameras]
    size = [cameras[0].width, cameras[0].height]
    if form == "Calib.qca.txt":
        text = f"<calibration><cameras>{''.join(qualisys(c, i) for i, c in numbered)}</cameras></calibration>"
    elif form == "Calib.toml":
        text = "".join(
            f'[c{i}]\nname = "cam{i}"\nsize = {[c.width, c.height]}\nmatrix = {near[i].tolist()}\n'
            f"distortions = {[*distortion]}\n"
            f"rotation = {turns[i].tolist()}\ntranslation = {moves[i].tolist()}\n"
            for i, c in numbered
        )
    elif form == "intri.yml":
        text = "%YAML:1.0\n---\n" + "".join(
            opencv(f"K_cam{i}", near[i]) + opencv(f"dist_cam{i}", np.array(distortion)) for i, _ in numbered
        )
        extrinsics = (opencv(f"R_cam{i}", turns[i]) + opencv(f"T_cam{i}", moves[i]) for i, _ in numbered)
        (folder / "extri.yml").write_text("%YAML:1.0\n---\n" + "".join(extrinsics))
    elif form == "panoptic.json":
        entries = [
            {"name": f"cam{i}", "resolution": size, "K": near[i].tolist(), "distCoef": [*distortion, 0.0],
             "R": c.T_cam_world[:3, :3].tolist(), "t": moves[i][:, None].tolist()}
            for i, c in numbered
        ]  # fmt: skip
        text = json.dumps({"cameras": entries})
    elif form == "transforms.json":
        names = ("k1", "k2", "p1", "p2")
        frames = [
            {"file_path": f"images/cam{i}.png", "fl_x": c.K[0, 0], "fl_y": c.K[1, 1], "cx": c.K[0, 2], "cy": c.K[1, 2],
             "transform_matrix": opengl(c).tolist()}
            for i, c in numbered
        ]  # fmt: skip
        text = json.dumps({"w": size[0], "h": size[1], **dict(zip(names, distortion, strict=True)), "frames": frames})
    else:
        lenses = (c.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() for c in cameras)
        lines = (
            f"{i} OPENCV {size[0]} {size[1]} {' '.join(map(str, [*k, *distortion]))}" for i, k in enumerate(lenses)
        )
        quaternions = (Rotation.from_rotvec(turn).as_quat()[[3, 0, 1, 2]].tolist() for turn in turns)
        poses = (f"{i} {' '.join(map(str, [*q, *moves[i]]))} {i} cam{i}.png\n" for i, q in enumerate(quaternions))
        text = "\n".join(lines)
        (folder / "images.txt").write_text("\n".join(poses))
        (folder / "points3D.txt").touch()
    (folder / form).write_text(text)
    return folder / form


FORMS = ["Calib.qca.txt", "Calib.toml", "intri.yml", "panoptic.json", "transforms.json", "cameras.txt"]


@pytest.mark.parametrize("form", FORMS)
def test_calibrations(form: str, tmp_path: Path) -> None:
    cameras = walk(3, *SIZE)
    path = write_calibration(tmp_path, form, cameras, (0.1, 0.02, 0.001, 0.002))
    found = read_calibration(path)
    names = match_names(found, [f"cam{i}.mp4" for i in range(3)])
    for i, camera in enumerate(cameras):
        lens, pose, _, sized = found[names[f"cam{i}.mp4"]]
        assert pose == pytest.approx(camera.T_cam_world, abs=1e-9)
        assert pytest.approx(camera.K) == lens.K
        assert (lens.radial, lens.tangential) == ((0.1, 0.02, 0), (0.001, 0.002))
        assert not sized or (lens.width, lens.height) == SIZE


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("none.toml", None, "does not exist"),
        ("a.txt", "hello", "known format"),
        ("a.qca.txt", "<a><camera/></a>", "focalLengthU"),
        ("a.qca.txt", "<a>", "cannot be read"),
        ("intri.yml", "%YAML:1.0\n" + opencv("K_1", np.eye(3)), "T_1"),
    ],
)
def test_what_is_no_calibration(name: str, text: str | None, words: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words):
        read_calibration(tmp_path / name)


def test_films_of_calibrated_cameras(tmp_path: Path) -> None:
    """One of which has rows that the others lack; no training changes such cameras."""
    cameras = walk(4, *SIZE)
    films = []
    for number, camera in enumerate(cameras):
        pictures = [drawn(camera, t, Board(0.4))[0][: 150 if number == 1 else 144] for t in np.linspace(0, 1, 6)]
        films.append(write_film(tmp_path / f"cam{number}.mp4", pictures, rate=10))
    with pytest.raises(InputError, match=r"200x150.*200x144"):
        prepare(films, tmp_path / "out", calibration=write_calibration(tmp_path, "Calib.toml", cameras, (0.0,) * 4))
    with pytest.raises(InputError, match="--poses"):
        prepare(films, tmp_path / "out", poses=tmp_path)
    with pytest.raises(InputError, match="--calibration"):
        prepare(films[:1], tmp_path / "out", calibration=tmp_path)
    sized = [Camera(c.K, c.T_cam_world, 200, 150 if i == 1 else 144) for i, c in enumerate(cameras)]
    prepare(films, tmp_path / "out", calibration=write_calibration(tmp_path, "Calib.toml", sized, (0.0,) * 4))
    data = load_dataset(tmp_path / "out")
    assert not data.own_footage
    seen = [data.test[0].camera, *data.cameras]
    assert {(c.width, c.height) for c in seen} == {(200, 144)}
    assert [c.K[1, 2] for c in seen] == pytest.approx([75, 72, 75, 75])
    places = ({f"{i}": c.position for i, c in enumerate(each)} for each in (seen, cameras))
    assert pose_errors(*places).max() < 1e-9


def test_poses_of_another_program(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """Are kept, and what moves is found with them."""
    cameras, board = walk(12, *SIZE), Board(0.5)
    (tmp_path / "images").mkdir()
    for i, camera in enumerate(cameras):
        Image.fromarray(drawn(camera, i / 11, board)[0]).save(tmp_path / f"images/cam{i}.png")
    path = write_calibration(tmp_path, "transforms.json", cameras[:-1], (0.0,) * 4)
    prepare([tmp_path / "images"], tmp_path / "out", poses=path)
    data = load_dataset(tmp_path / "out")
    assert data.own_footage
    found = {Path(view.source).stem: view.camera.position for view in (*data.train, *data.test)}
    assert pose_errors(found, {f"cam{i}": camera.position for i, camera in enumerate(cameras)}).max() < 1e-6
    with Image.open(tmp_path / "out/masks/cam6.png") as mask:
        assert (np.asarray(mask) > 127)[drawn(cameras[6], 6 / 11, board)[1]].mean() > 0.5
    assert re.search("(?s)11 of 12 images have cameras.*11 of 12 cameras placed", capfd.readouterr().out)
    film = write_film(tmp_path / "film.mp4", noise_pictures(12))
    with pytest.raises(InputError, match=r"such as .*cam0.*0 of 12"):
        prepare([film], tmp_path / "other", poses=path)
