"""lapgs-prepare: make a capture of videos with the programs ffmpeg and colmap (docs/own-data.md has the commands)."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from lapgs_wgpu.command import HelpFormatter, Parser, guarded
from lapgs_wgpu.data.readers.colmap import IMAGES, SPARSE
from lapgs_wgpu.data.readers.colmap_model import count_images, is_model
from lapgs_wgpu.data.timestamps import write_times
from lapgs_wgpu.errors import InputError

DESCRIPTION = """\
Convert videos to a capture for lapgs-train: extract images with ffmpeg, estimate camera poses with COLMAP. The programs
ffmpeg and colmap must be installed.

  lapgs-prepare walk.mp4 --out DIR              one moving camera: a pose for each image
  lapgs-prepare a.mp4 b.mp4 c.mp4 --out DIR     several static cameras: a pose for each video; all videos must start at
                                                the same moment

Then train: lapgs-train hypernerf-tiny --data DIR (one camera) or neu3d-tiny (several). See docs/own-data.md."""
FRAMES_PER_SECOND = 10.0
NEIGHBOURS = 20  # a moving camera: match each image with so many before and after
FEWEST = 0.5  # of the images need a pose
ADVICE = "they may overlap too little, so film slower, with more texture and overlap"


def prepare_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-prepare: returns the exit code."""
    return guarded("lapgs-prepare", _prepare, list(sys.argv[1:] if arguments is None else arguments))


def _prepare(arguments: list[str]) -> None:
    parser = Parser("lapgs-prepare", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    # fmt: off
    add = parser.add_argument
    add("videos", nargs="+", metavar="VIDEO", help="video files, one per camera, all of the same resolution")
    add("--out", required=True, metavar="DIR", help="output folder for the capture; must be new or empty")
    add("--fps", type=float, default=FRAMES_PER_SECOND, help="maximum number of extracted images per second of video "
        f"[{FRAMES_PER_SECOND:g}]")
    # fmt: on
    given = parser.parse_args(arguments)
    prepare([Path(video) for video in given.videos], Path(given.out), given.fps)


def prepare(videos: Sequence[Path], out: Path, fps: float) -> None:
    """Write images/, times.json and sparse/0. fps: images per second, at most. Raises InputError."""
    if not 0 < fps <= 1000:
        raise InputError(f"--fps must be above 0 and at most 1000, got {fps:g}.")
    for video in videos:
        if not video.is_file():
            raise InputError(f"{video} does not exist; name the videos of the capture.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not an empty folder; name a new one with --out.")
    programs = {name: _program(name) for name in ("ffmpeg", "colmap")}
    out.mkdir(parents=True, exist_ok=True)
    times: dict[str, float] = {}
    for index, video in enumerate(videos):
        folder = out / IMAGES / f"cam{index:02d}" if len(videos) > 1 else out / IMAGES
        for picture in extract(programs["ffmpeg"], video, folder, fps):
            times[picture.relative_to(out / IMAGES).as_posix()] = int(picture.stem) / 1000
    write_times(out, times)
    if len(videos) > 1:
        first = [sorted((out / IMAGES / f"cam{i:02d}").iterdir())[0] for i in range(len(videos))]
        registered = reconstruct(programs["colmap"], out, first)
        wanted = len(videos)
    else:
        registered = reconstruct(programs["colmap"], out, None)
        wanted = len(times)
    preset = "neu3d-tiny" if len(videos) > 1 else "hypernerf-tiny"
    print(f"{out}: {len(times)} images, {registered} of {wanted} cameras registered; lapgs-train {preset} --data {out}")
    if registered < max(2, FEWEST * wanted):
        raise InputError(
            f"colmap registered {registered} of {wanted} images (at least half are needed): {ADVICE}; "
            f"{out / 'colmap.log'} has its output."
        )


def extract(ffmpeg: str, video: Path, folder: Path, fps: float) -> list[Path]:
    """Extract the images of a video, at most `fps` per second, in order. Each file name is a time in milliseconds."""
    folder.mkdir(parents=True, exist_ok=True)
    # The frame rate of phones varies: take the next frame that comes 1 / fps after the last one taken.
    chosen = f"select=isnan(prev_selected_t)+gte(t-prev_selected_t\\,{1 / fps - 5e-4:.6f}),settb=1/1000"
    timed = ["-fps_mode", "passthrough", "-enc_time_base", "1/1000", "-frame_pts", "1"]
    command = [ffmpeg, "-nostdin", "-v", "error", "-i", str(video), "-vf", chosen, *timed, "-qscale:v", "2"]
    _run([*command, str(folder / "%08d.jpg")], folder.parent / "ffmpeg.log", f"{video}: ffmpeg")
    (folder.parent / "ffmpeg.log").unlink(missing_ok=True)
    pictures = sorted(folder.glob("*.jpg"))
    if len(pictures) < 2:
        raise InputError(f"{video} gave {len(pictures)} images at {fps:g} per second; is it a video?")
    return pictures


def reconstruct(colmap: str, out: Path, pictures: Sequence[Path] | None) -> int:
    """Run colmap and copy the largest model to sparse/0. Return the number of its images, which share one lens.

    pictures: one image of each static camera; None for all images of a moving camera, in the order of their names.
    """
    log, images, work = out / "colmap.log", out / IMAGES, out / "colmap"
    work.mkdir()
    database = ["--database_path", str(work / "database.db")]
    listed: list[str] = []
    if pictures is not None:
        names = "\n".join(path.relative_to(images).as_posix() for path in pictures)
        (work / "list.txt").write_text(names + "\n", encoding="utf-8")
        listed = ["--image_list_path", str(work / "list.txt")]
    model = "OPENCV" if pictures is None else "SIMPLE_RADIAL"  # few images do not determine more parameters

    def run(step: str, *options: str) -> None:
        print(f"colmap {step} ...", file=sys.stderr, flush=True)
        _run([colmap, step, *options], log, f"colmap {step}")

    lens = ["--ImageReader.single_camera", "1", "--ImageReader.camera_model", model]
    given = [*database, "--image_path", str(images)]
    run("feature_extractor", *given, *listed, *lens, *_no_gpu(colmap, "feature_extractor"))
    matcher = "exhaustive_matcher" if pictures is not None else "sequential_matcher"
    overlap = [] if pictures is not None else ["--SequentialMatching.overlap", str(NEIGHBOURS)]
    run(matcher, *database, *overlap, *_no_gpu(colmap, matcher))
    (work / SPARSE).mkdir()
    try:
        run("mapper", *given, "--output_path", str(work / SPARSE))
    except InputError as error:  # some versions of colmap fail if they find nothing
        raise InputError(f"{str(error).removesuffix('.')}: {ADVICE}.") from None
    models = [path for path in sorted((work / SPARSE).iterdir()) if is_model(path)]
    if not models:
        raise InputError(f"colmap found no cameras for the images in {images}: {ADVICE}; {log} has its output.")
    best = max(models, key=count_images)
    (out / SPARSE).mkdir()
    shutil.copytree(best, out / SPARSE / "0")
    return count_images(best)


def _no_gpu(colmap: str, step: str) -> list[str]:
    """The option that disables the GPU for a step; its name depends on the version of colmap."""
    done = subprocess.run([colmap, step, "-h"], capture_output=True, text=True, check=False, env=_environment())
    option = re.search(r"--(\w+\.use_gpu)", done.stdout + done.stderr)
    return [f"--{option[1]}", "0"] if option else []


def _program(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        raise InputError(f"the program {name} is not installed; on Debian and Ubuntu: sudo apt-get install {name}.")
    return path


def _run(command: list[str], log: Path, name: str) -> None:
    """Run a program and append its output to a file. Raises InputError with the last line of output if it fails."""
    with log.open("ab") as file:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, check=False, env=_environment()
        )
    if done.returncode != 0:
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = said[-1].strip()[:200] if said else "nothing"
        raise InputError(f"{name} failed with code {done.returncode}, its last words: {last}; {log} has the rest.")


def _environment() -> dict[str, str]:
    """The environment for colmap, whose Qt needs a display unless this variable is set."""
    return {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
