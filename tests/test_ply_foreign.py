"""Variants of .ply files that other programs write: each is shown as it is meant, or refused with the reason."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.ply_files import assert_same, columns_of, ply_bytes, random_still, read_ply
from helpers.scene_files import moving_scene

from lapgs_wgpu.data.cloud import read_cloud, read_points
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.checkpoint import read_checkpoint
from lapgs_wgpu.motion.scene import load
from lapgs_wgpu.motion.scene_file import read_scene
from lapgs_wgpu.viewer.export import export_still
from lapgs_wgpu.viewer.loaded_scene import load_scene
from lapgs_wgpu.viewer.options import parse_options

N = 200


def changed(folder: Path, change: dict[str, tuple[int, float]], without: tuple[str, ...] = ()) -> Path:
    """A file of random Gaussians of degree 0, in which a row of some columns has another value."""
    columns = {name: (kind, values.copy()) for name, (kind, values) in columns_of(random_still(N, 0)).items()}
    for name, (row, value) in change.items():
        columns[name][1][row] = value
    file = folder / "a.ply"
    file.write_bytes(ply_bytes({name: column for name, column in columns.items() if name not in without}))
    return file


def commented(file: Path, *comments: str) -> Path:
    lines = "".join(f"comment {comment}\n" for comment in comments).encode()
    file.write_bytes(file.read_bytes().replace(b"element vertex", lines + b"element vertex", 1))
    return file


def test_values_that_are_legal(tmp_path: Path) -> None:
    plain = random_still(N, 0)
    rotation = {f"rot_{i}": (5, 0.0) for i in range(4)}
    still = read_ply(changed(tmp_path, {"opacity": (3, np.inf), "scale_2": (4, -np.inf), **rotation}))
    assert 1 / (1 + np.exp(-still.opacity_logits[3])) == 1
    assert np.exp(still.log_scales[4, 2]) == pytest.approx(1e-7)
    assert still.quats[5].tolist() == [1, 0, 0, 0]
    np.testing.assert_array_equal(still.means, plain.means)
    still = read_ply(changed(tmp_path, {"opacity": (3, -np.inf)}))  # cannot be seen
    np.testing.assert_array_equal(still.means, np.delete(plain.means, 3, axis=0))


@pytest.mark.parametrize(("name", "value"), [("x", np.nan), ("f_dc_1", np.inf), ("scale_0", 45.0)])
def test_single_bad_rows_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, value: float
) -> None:
    still = read_ply(changed(tmp_path, {name: (7, value)}))
    np.testing.assert_array_equal(still.means, np.delete(random_still(N, 0).means, 7, axis=0))
    assert f"a.ply: 1 of {N}" in capsys.readouterr().err


def test_flat_gaussians_and_colors_in_place_of_harmonics(tmp_path: Path) -> None:
    still = read_ply(changed(tmp_path, {}, without=("scale_2",)))
    np.testing.assert_allclose(np.exp(still.log_scales[:, 2]), 1e-7, rtol=1e-5)
    spheres = read_ply(changed(tmp_path, {}, without=("scale_1", "scale_2", *(f"rot_{i}" for i in range(4)))))
    np.testing.assert_array_equal(spheres.log_scales, np.repeat(random_still(N, 0).log_scales[:, :1], 3, axis=1))
    assert (spheres.quats == [1, 0, 0, 0]).all()
    columns = {name: column for name, column in columns_of(random_still(N, 0)).items() if "f_dc" not in name}
    levels = np.arange(3 * N).reshape(3, N) % 256
    columns |= dict(zip(("red", "green", "blue"), (("uchar", level) for level in levels), strict=True))
    (tmp_path / "b.ply").write_bytes(ply_bytes(columns))
    found = read_ply(tmp_path / "b.ply").sh[:, 0] * 0.28209479 + 0.5
    np.testing.assert_allclose(found, levels.T / 255, atol=1e-6)


def test_a_line_end_behind_the_rows_and_any_encoding_of_comments(tmp_path: Path) -> None:
    file = changed(tmp_path, {})
    data = file.read_bytes().replace(b"element", b"comment \xb3\xa1\xbe\xb0.jpg\nelement", 1)
    for end in (b"\n", b"\r\n"):
        file.write_bytes(data + end)
        assert_same(read_ply(file), random_still(N, 0))


@pytest.mark.parametrize("names", [("trbf_center", "omega_0"), ("vx", "mean_t"), ("motion", "lifetime")])
def test_gaussians_that_move_are_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    columns = columns_of(random_still(3, 0)) | dict.fromkeys(names, ("float", [0.0, 0.0, 0.0]))
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    with pytest.raises(InputError, match=f"{', '.join(names)}, 2 in all"):
        read_ply(tmp_path / "a.ply")


def test_properties_that_are_not_used_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = columns_of(random_still(3, 0)) | {"filter_3D": ("float", [0.0, 0.0, 0.0])}
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    read_ply(tmp_path / "a.ply")
    assert "filter_3D" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["double", "text"])
def test_doubles_far_from_the_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    offset = np.array([448262.0, 5411932.0, 120.0])
    means = random_still(N, 0).means.astype(float) + offset
    columns = columns_of(random_still(N, 0)) | {name: ("double", means[:, i]) for i, name in enumerate("xyz")}
    file = tmp_path / "a.ply"
    data = ply_bytes(columns)
    if kind == "text":
        rows = "".join(" ".join(repr(float(v[row])) for _, v in columns.values()) + "\n" for row in range(N))
        head = data.partition(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii")
        data = head + b"end_header\n" + rows.encode()
    file.write_bytes(data)
    scene = read_scene(file)
    taken = np.array(json.loads(scene.metadata["offset"]))
    np.testing.assert_allclose(scene.gaussians["means"] + taken, means, rtol=0, atol=1e-6)
    assert np.abs(scene.gaussians["means"]).max() < 10
    assert "448262" in capsys.readouterr().err


@pytest.mark.parametrize(("antialiased", "comments"), [(True, b""), (0.1, b"comment LowPass: 0.1\n")])
def test_an_antialiased_still_is_drawn_as_its_checkpoint(
    tmp_path: Path, device: Device, antialiased: bool | float, comments: bytes
) -> None:
    scene = moving_scene(device, sh_degree=3)
    scene.antialiased = antialiased
    scene.save(tmp_path / "a.ply")
    loaded = load_scene(tmp_path / "a.ply", lambda: device)
    assert export_still(loaded, tmp_path / "still.ply", 0.5).psnr >= 100
    assert b"\ncomment SplatRenderMode: mip\n" + comments + b"end_header" in (tmp_path / "still.ply").read_bytes()
    assert load(tmp_path / "still.ply", device).antialiased == antialiased
    assert not load_scene(tmp_path / "still.ply", lambda: device, antialiased=False).playback.at(0.0).antialiased
    plain = load_scene(tmp_path / "a.ply", lambda: device, antialiased=False)
    export_still(plain, tmp_path / "plain.ply", 0.5)
    assert b"comment" not in (tmp_path / "plain.ply").read_bytes()


def test_the_vertical_axis(tmp_path: Path, device: Device) -> None:
    def up(file: Path, axis: str | None = None) -> list[float]:
        view = load_scene(file, lambda: device, up=axis).initial_view
        assert (view.camera.position - view.focus) @ view.up > 0  # seen from above
        return [float(value) for value in view.up]

    assert up(changed(tmp_path, {})) == [0, -1, 0]
    assert up(commented(changed(tmp_path, {}), "Vertical Axis: z")) == [0, 0, 1]
    file = commented(changed(tmp_path, {}), "Exported from Brush", "Vertical axis: y")
    assert up(file) == [0, 1, 0]
    assert up(file, "-x") == [-1, 0, 0]
    assert read_checkpoint(file).metadata == {"up": "y"}
    assert parse_options(["a.ply", "--up", "-y"])[0].up == "-y"


COLORS = {
    "bytes": ("uchar", ("red", "green", "blue"), 255),
    "fractions": ("float", ("red", "green", "blue"), 1),
    "doubles": ("double", ("r", "g", "b"), 255),
    "words": ("ushort", ("diffuse_red", "diffuse_green", "diffuse_blue"), 65535),
    "capitals": ("uchar", ("R", "G", "B"), 255),
}


@pytest.mark.parametrize("name", COLORS)
def test_colors_of_clouds(tmp_path: Path, name: str) -> None:
    kind, names, white = COLORS[name]
    true = np.random.default_rng(0).integers(0, 256, (50, 3)) / 255
    true[0] = 1
    values = true * white if white == 1 else np.round(true * white)
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    types = {"uchar": ">u1", "ushort": ">u2", "float": ">f4", "double": ">f8"}
    rows = np.zeros(50, [(axis, ">f4") for axis in "xyz"] + [(channel, types[kind]) for channel in names])
    for i in range(3):
        rows["xyz"[i]], rows[names[i]] = points[:, i], values[:, i]
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 50\n" + "".join(f"property float {a}\n" for a in "xyz")
    head += "".join(f"property {kind} {channel}\n" for channel in names)
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + rows.tobytes() + b"\x03" + bytes(12))
    found, colors = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(found, points)
    assert colors is not None
    np.testing.assert_allclose(colors, true, atol=1e-6)


def test_a_cloud_whose_colors_are_not_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = dict.fromkeys([*"xyz", "intensity"], ("float", [0.0, 1.0]))
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    assert read_points(tmp_path / "a.ply")[1] is None
    assert "intensity" in capsys.readouterr().err


def test_few_points_of_a_cloud_that_are_nan_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    points[[3, 7, 9], [0, 1, 2]] = np.nan, np.inf, -np.inf
    np.save(tmp_path / "points.npy", points)
    assert len(read_cloud(tmp_path / "points.npy").points) == 297
    assert "3 of 300 points, which are left out" in capsys.readouterr().err
    np.save(tmp_path / "points.npy", points[:299])
    with pytest.raises(InputError, match="3 of 299 points"):
        read_cloud(tmp_path / "points.npy")


def test_half_precision(tmp_path: Path) -> None:
    still = random_still(N, 0)
    columns = columns_of(still)
    rows = np.stack([values for _, values in columns.values()], axis=1).astype("<f2")
    head = ply_bytes(columns).partition(b"end_header\n")[0].replace(b"property float", b"property half")
    (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + rows.tobytes())
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").means, still.means.astype(np.float16))


def test_faces_before_the_vertices_are_refused_by_name(tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
    head += "element vertex 1\n" + "".join(f"property float {a}\n" for a in "xyz") + "end_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + bytes(13))
    with pytest.raises(InputError, match="'face'"):
        read_points(tmp_path / "a.ply")
