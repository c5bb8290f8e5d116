"""From films to poses: python benchmarks/films.py DIR prints a Markdown table (docs/results.md).

DIR holds rendered/swing_mv, eight films of still cameras whose poses are known, and hypernerf/hand, pictures of a real
hand, which become a film. Two more rows are of a film that is rendered here: a walk past a room in which a moving board
covers much of the picture, with the masks that are found and with black ones, which leave out nothing.

python benchmarks/films.py --davis DIR OUT [FILM ...] measures films of DAVIS 2016, JPEGImages/480p and Annotations/480p
in DIR, against the annotated masks (docs/results.md): the mean intersection over union of all images. Captures stay in
OUT.

lapgs-prepare runs with a new HOME and nothing but its own programs on the PATH. Errors are distances of cameras from
the true ones after the best similarity, in parts of the cameras' spread.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.films import Board, drawn, pose_errors, walk, write_film

from lapgs_wgpu.data import load_dataset

PROGRAMS = Path(sys.executable).parent
FRAMES, RATE, SIZE, BOARD = 30, 10, (320, 240), Board(1.12, 0.35, 2.0)
Places = dict[str, NDArray[np.float64]]


class Prepared(NamedTuple):
    """folder: the capture. images: chosen. places: of the cameras, by image. focal: length, pixels. seconds: taken."""

    folder: Path
    images: int
    places: Places
    focal: float
    seconds: float


def prepare(out: Path, *arguments: str) -> Prepared:
    environment = {"HOME": str(out.parent), "PATH": str(PROGRAMS), "XDG_RUNTIME_DIR": str(out.parent)}
    command = [str(PROGRAMS / "lapgs-prepare"), *arguments, "--out", str(out)]
    started = time.perf_counter()
    subprocess.run(command, env=environment, check=True, stdout=sys.stderr)
    seconds = time.perf_counter() - started
    model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    found = [model.image(number) for number in model.reg_image_ids()]
    focal = float(next(iter(model.cameras.values())).params[0])
    images = sum(path.is_file() for path in (out / "images").rglob("*"))
    return Prepared(out, images, {image.name: np.array(image.projection_center()) for image in found}, focal, seconds)


def row(film: str, of: int, done: Prepared, camera_of: Callable[[str], str], true: Places, focal: float) -> str:
    """camera_of: the camera of an image; true, focal: the right places and the right length."""
    found = {camera_of(name): place for name, place in done.places.items()}
    errors = 100 * pose_errors(found, {name: true[name] for name in found})
    off = f"{np.median(errors):.2f} % | {errors.max():.2f} % | {100 * (done.focal / focal - 1):+.1f} %"
    return f"| {film} | {done.images} | {len(found)} of {of} | {off} | {done.seconds:.0f} |"


def still_cameras(data: Path, folder: Path) -> str:
    films = sorted((data / "rendered" / "swing_mv").glob("cam0*.mp4"))
    capture = load_dataset(data / "rendered" / "swing_mv")
    cameras = {
        film.stem: view.camera for film in films for view in (*capture.train, *capture.test) if film.stem in view.source
    }
    done = prepare(folder / "still", *map(str, films))
    true = {name: camera.position for name, camera in cameras.items()}
    focal = cameras[films[0].stem].K[0, 0]
    return row("eight still cameras", len(films), done, lambda name: name.split("/")[0], true, float(focal))


def hand(data: Path, folder: Path) -> str:
    pictures = sorted((data / "hypernerf" / "hand" / "rgb" / "1x").glob("*.png"))
    film = write_film(folder / "hand.mp4", [np.array(Image.open(file).convert("RGB")) for file in pictures], rate=15)
    done = prepare(folder / "hand", str(film), "--fps", "4")
    return f"| a real hand | {done.images} | {len(done.places)} of {done.images} | | | | {done.seconds:.0f} |"


def board(folder: Path) -> list[str]:
    cameras = walk(FRAMES, *SIZE)
    taken = [drawn(camera, i / (FRAMES - 1), BOARD) for i, camera in enumerate(cameras)]
    film = write_film(folder / "board.mp4", [picture for picture, _ in taken], rate=RATE)
    true, focal = {str(i): camera.position for i, camera in enumerate(cameras)}, float(cameras[0].K[0, 0])
    masked = prepare(folder / "masked", str(film))
    black = folder / "black"
    black.mkdir()
    for file in (masked.folder / "masks").glob("*.png"):
        Image.new("L", SIZE).save(black / file.name)
    plain = prepare(folder / "plain", str(film), "--masks", str(black))
    name = f"board over {np.mean([mask.mean() for _, mask in taken]):.0%}"

    def frame(image: str) -> str:  # images are named by milliseconds
        return str(round(int(Path(image).stem) * RATE / 1000))

    return [
        row(f"{name}, {what}", FRAMES, done, frame, true, focal)
        for what, done in (("masks found", masked), ("black masks", plain))
    ]


def _used() -> float:
    """Processor seconds of the programs that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def davis(folder: Path, captures: Path, films: list[str]) -> None:
    """Films of 24 frames a second, named by their folders; all where none is named. captures: new or empty folders."""
    print("| film | images | placed | path | moves, true | IoU | seconds | of processor time |")
    print("|---|---:|---:|---|---:|---:|---:|---:|", flush=True)
    captures.mkdir(parents=True, exist_ok=True)
    for film in films or sorted(path.name for path in (folder / "JPEGImages/480p").iterdir()):
        frames = sorted((folder / "JPEGImages/480p" / film).glob("*.jpg"))
        path = write_film(captures / f"{film}.mp4", [np.array(Image.open(file)) for file in frames], rate=24)
        out, started, used = captures / film, time.perf_counter(), _used()
        command = [str(PROGRAMS / "lapgs-prepare"), str(path), "--out", str(out)]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        seconds = f"{time.perf_counter() - started:.0f} | {_used() - used:.0f}"
        (captures / f"{film}.txt").write_text(done.stdout)
        if done.returncode:
            print(f"| {film} | | refused | | | | {seconds} |", flush=True)
            continue
        faults = next(line for line in done.stdout.splitlines() if "path: " in line)
        kind = "a pan" if "placed as a pan" in done.stdout else faults.split("path: ")[1].split(" (wanted")[0]
        model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
        overlaps, shares = [], []
        masks = sorted((out / "masks").glob("*.png"))
        for file in masks:
            number = round(int(file.stem) * 24 / 1000)
            with Image.open(folder / "Annotations/480p" / film / f"{frames[number].stem}.png") as image:
                true = np.asarray(image) > 0
            with Image.open(file) as image:
                found = np.asarray(image.resize(true.shape[::-1], Image.Resampling.NEAREST)) > 127
            union = (found | true).sum()
            overlaps.append((found & true).sum() / union if union else 1.0)
            shares.append(true.mean())
        print(
            f"| {film} | {len(masks)} | {model.num_reg_images()} | {kind} | {np.mean(shares):.1%} | "
            f"{np.mean(overlaps):.2f} | {seconds} |",
            flush=True,
        )


def main(data: Path) -> None:
    print("| film | images | cameras placed | off, median | largest | focal length | seconds |")
    print("|---|---:|---:|---:|---:|---:|---:|", flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(still_cameras(data, folder), flush=True)
        print(hand(data, folder), flush=True)
        print("\n".join(board(folder)), flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--davis":
        davis(Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:])
    else:
        main(Path(sys.argv[1]).absolute())
