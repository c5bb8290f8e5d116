"""What goes wrong with captures of one's own is told before the training; and how times and splits are found."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import HEIGHT, WIDTH, Blobs, cameras, write_colmap
from PIL import Image, ImageFilter

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.images import check_film
from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.data.timestamps import disorder, frame_numbers, held_out, in_step
from lapgs_wgpu.data.validation import check_in_view, check_spacing, check_times, check_views
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.presets import load_config

CLOUD = Cloud(Blobs.random(200).means.numpy(), Blobs.random(200).colors.numpy())
FAST = {"schedule.steps": "3", "points.count": "60", "field.width": "16"}


def turned(camera: Camera) -> Camera:
    """Looking the other way."""
    return Camera(camera.K, np.diag([1.0, -1, -1, 1]) @ camera.T_cam_world, camera.width, camera.height)


def test_cameras_that_look_away_or_do_not_move() -> None:
    def warnings(taken: list[Camera]) -> list[str]:
        return check_views(CLOUD, {each: f"{i}.png" for i, each in enumerate(taken)}, Path("points3D.bin"))

    taken = cameras(6)
    assert warnings(taken) == []
    (warning,) = warnings([*taken[:2], turned(taken[2]), *taken[3:]])
    assert "2.png" in warning
    (warning,) = warnings([taken[1]] * 3)
    assert "hardly move" in warning
    with pytest.raises(InputError, match=r"points3D\.bin: .* 4 of 6"):
        warnings([*map(turned, taken[:4]), *taken[4:]])


def timed(times: Sequence[float], tested: Sequence[float] = (0.5,), taken: list[Camera] | None = None) -> Dataset:
    """A capture with a camera of its own for each time, unless given."""
    taken = taken or cameras(len(times))

    def views(split: str, times: Sequence[float]) -> tuple[View, ...]:
        return tuple(
            View(f"{split}_{i}", taken[i], time, "memory", lambda: np.zeros((HEIGHT, WIDTH, 3), np.uint8))
            for i, time in enumerate(times)
        )

    return Dataset("toy", views("train", times), views("test", tested), CLOUD)


SEVEN = [0, 0.1, 0.1, 0.3, 0.5, 0.7, 0.9]


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (timed(np.linspace(0, 1, 20)), []),
        (timed(np.repeat(np.linspace(0, 0.95, 20), 3)), []),  # three cameras
        (timed(SEVEN), []),  # each time is of another camera
        (timed([0, 0, 1, 1]), ["2 different times (0, 1)"]),
        (timed([*np.linspace(0, 0.3, 10), *np.linspace(0.6, 1, 10)], [0.1, 0.4, 0.5]), ["0.3 and 0.6", "2 test"]),
        (timed(np.linspace(0, 0.4, 20)), ["between 0.4 and 1,"]),
        (timed([*np.linspace(0.2, 0.4, 10), *np.linspace(0.8, 1, 10)]), ["0.4 and 0.8"]),
        (timed(SEVEN, taken=[cameras(1)[0]] * 7), ["train_2 and train_1 at 0.1"]),
    ],
)
def test_times_that_say_little(data: Dataset, named: list[str]) -> None:
    found = check_times(data, moving=True)
    assert len(found) == bool(named)
    assert all(part in found[0] for part in named)


def test_all_times_equal(device: Device, tmp_path: Path) -> None:
    """Then images are counted for the split, and a scene without motion is trained."""
    folder = write_colmap(tmp_path / "toy", device)
    (folder / "times.json").write_text(json.dumps({f"frame_{i:04d}.png": 7.5 for i in range(1, 7)}))
    data = load_dataset(folder)
    assert (len(data.train), len(data.test)) == (5, 1)
    with pytest.raises(InputError, match=r"times\.json.*--field static"):
        check_times(data, moving=True)
    train(load_config("tiny", FAST, method="static"), data, tmp_path / "run", device=device)
    with pytest.raises(InputError, match="--field static"):
        train(load_config("tiny", FAST, method="mlp"), data, tmp_path / "mlp", device=device)
    assert not (tmp_path / "mlp").exists()


@pytest.mark.parametrize(("count", "told"), [(4, "4 still cameras are 90 degrees apart"), (16, "")])
def test_still_cameras_far_apart(count: int, told: str) -> None:
    ring = [
        Camera.looking_at(
            [3 * np.cos(a), 3 * np.sin(a), 0.0], np.zeros(3), up=[0.0, 0.0, 1.0], fov_x=0.9, width=8, height=8
        )
        for a in 2 * np.pi * np.arange(count) / count
    ]
    found = check_spacing(timed(np.linspace(0, 1, 2 * count), taken=2 * ring))
    assert found == [] if not told else told in found[0]


def test_cameras_that_look_away_for_a_while(device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times, taken = np.linspace(0, 1, 11), cameras(11)
    assert check_in_view(timed(times, taken=taken), CLOUD.points) == []
    for i in (1, 4, 5, 6):
        taken[i] = turned(taken[i])
    (warning,) = check_in_view(timed(times, taken=taken), CLOUD.points)
    assert "at 4 of 11 times: train_1, train_4, train_5, train_6" in warning
    together = timed(np.repeat(times, 2), taken=[camera for one in taken for camera in (one, cameras(1)[0])])
    assert check_in_view(together, CLOUD.points) == [], "another camera sees it"
    train(load_config("tiny", FAST), timed(times, taken=taken), tmp_path / "run", device=device)
    assert warning in capsys.readouterr().err
    none = timed(times, taken=[turned(camera) for camera in cameras(11)])
    with pytest.raises(InputError, match="none of 11 training cameras"):
        train(load_config("tiny", FAST), none, tmp_path / "none", device=device)
    assert not (tmp_path / "none").exists()


def test_frames_out_of_order() -> None:
    images = [ImageName(f"frame_{i:03d}.jpg", ".") for i in range(10)]
    times = [float(i) for i in range(10)]
    assert disorder(images, times) == []
    times[4], times[5] = times[5], times[4]
    (warning,) = disorder(images, times)
    assert "frame_004.jpg at 5 to frame_005.jpg at 4" in warning
    images = [ImageName(f"cam{c}/{i + 10 * c:03d}.jpg", f"cam{c}") for c in range(2) for i in range(5)]
    (warning,) = disorder(images, [float(n) for n in frame_numbers(images)])
    assert "cam0 from 0 to 4" in warning, "no time in common"


def test_blurred_and_repeated_images(device: Device, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "toy", device, count=10)
    path = folder / "images/frame_0004.png"
    Image.open(path).filter(ImageFilter.GaussianBlur(3)).save(path)
    shutil.copyfile(folder / "images/frame_0007.png", folder / "images/frame_0008.png")
    sparse, blurred, repeated = load_dataset(folder).warnings
    assert "40 points" in sparse
    assert "blurred images: frame_0004.png (1 of 10)" in blurred
    assert "repeated images: frame_0008.png (1 of 10)" in repeated


def test_what_moves_a_little_is_not_repeated(tmp_path: Path) -> None:
    """A still camera, noise, and a small thing that moves."""
    rng = np.random.default_rng(0)
    background = rng.integers(60, 200, (240, 320, 3)).astype(float)
    paths = []
    for i in range(6):
        image = background + rng.normal(0, 2, background.shape)
        image[100:104, 10 + 4 * i : 14 + 4 * i] = 255
        paths.append(tmp_path / f"{i}.jpg")
        Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(paths[-1], quality=95)
    assert check_film(paths) == []


def test_held_out_views() -> None:
    one = [ImageName(f"{i}.jpg", ".") for i in range(20)]
    assert held_out(one, [i / 19 for i in range(20)]) == {4, 12}
    two = [ImageName(f"{c}/{i}.jpg", c) for i in range(6) for c in "ab"]
    assert held_out(two, [i / 5 for i in range(6) for _ in "ab"]) == {8, 9}, "both images of the fifth time"
    three = [ImageName(f"cam{c}/{i}.jpg", f"cam{c}") for c in (10, 2, 9) for i in range(2)]
    assert held_out(three, [0, 1] * 3) == {2, 3}, "cam2 comes first"


def test_frame_numbers() -> None:
    def numbers(*names: str) -> list[int]:
        return frame_numbers([ImageName(name, str(Path(name).parent)) for name in names])

    assert numbers("IMG_20240101_001.jpg", "IMG_20240101_010.jpg") == [1, 10]
    assert numbers("a/x7.jpg", "b/x7.jpg") == [7, 7], "the same time"
    assert numbers("cam00/v2_f1.jpg", "cam00/v2_f2.jpg", "cam01/v3_f1.jpg", "cam01/v3_f2.jpg") == [1, 2, 1, 2]
    with pytest.raises(InputError, match="2 numbers"):
        numbers("cam0_1.jpg", "cam1_2.jpg")
    assert sorted(["cam10", "cam2", "cam", "²", "2"], key=natural_key) == ["2", "cam", "cam2", "cam10", "²"]


def test_cameras_that_are_nearly_in_step_share_their_times() -> None:
    """Stamps of two films, which differ by rounding and by a twentieth of a frame; the third is half a frame late."""
    frame = 1 / 30
    films = [[n * frame for n in range(300)], [0.1 + (n * frame + 0.05 * frame * (n % 2)) - 0.1 for n in range(300)]]
    films.append([(n + 0.5) * frame for n in range(300)])
    names = [ImageName(f"{c}/{n}.jpg", str(c)) for c in range(3) for n in range(300)]
    values = [time for film in films for time in film]
    assert len(set(values)) > 700
    found = in_step(names, values)
    assert np.abs(np.subtract(found, values)).max() < 0.03 * frame
    assert len(set(found)) == 600
    for c in range(3):
        assert len(set(found[300 * c : 300 * (c + 1)])) == 300, "no two of a camera"


def test_times_that_are_in_step_stay_to_the_last_bit() -> None:
    times = [n / 7 for n in range(9)]
    names = [ImageName(f"{c}/{n}.jpg", c) for c in "abc" for n in range(9)]
    assert in_step(names, 3 * times) == 3 * times
    burst = [0.0, 1.0, 1.001, 2.0]
    assert in_step([ImageName(f"{n}.jpg") for n in range(4)], burst) == burst, "one camera"
    assert len(set(in_step([*names[:4], *names[9:13]], burst + burst))) == 4, "no two of a camera"
