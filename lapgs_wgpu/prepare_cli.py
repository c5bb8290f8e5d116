"""The command lapgs-prepare."""

from __future__ import annotations

import argparse
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lapgs_wgpu.command import Parser, beside, guarded
from lapgs_wgpu.errors import InputError, quoted
from lapgs_wgpu.io.listing import listed

if TYPE_CHECKING:
    from lapgs_wgpu.prepare.diagnosis import Diagnosis

DESCRIPTION = """\
Convert films or images to a capture for lapgs-train: choose images and reconstruct the cameras. Needs no other
programs, but the extra prepare: pip install "lapgs-wgpu[prepare]".

  lapgs-prepare walk.mp4 --out DIR              one moving camera: a pose for each image
  lapgs-prepare a.mp4 b.mp4 c.mp4 --out DIR     several static cameras: a pose for each film; all films must start at
                                                the same time
  lapgs-prepare IMAGES --out DIR                a folder, zip file or pattern ("*.jpg") of one camera's images; folders
                                                in a folder are cameras
  lapgs-prepare cam*.mp4 --calibration FILE --out DIR   static cameras whose places are known
  lapgs-prepare IMAGES --poses SPARSE --out DIR         one moving camera that another program placed
  lapgs-prepare walk.mp4 --out DIR --train      the same, then train a model that suits this machine and the film
  lapgs-prepare --check DIR                     measure what a capture is worth, and what to film differently

DIR/report.html shows what was found. See docs/own-data.md."""


def options() -> Parser:
    parser = Parser("lapgs-prepare", DESCRIPTION)
    # fmt: off
    add = parser.add_argument
    add("films", nargs="*", type=Path, metavar="FILM", help="films, one per camera; or images, folders, patterns, zip "
        "files")
    add("--out", type=Path, metavar="DIR", help="output folder for the capture; must be new or empty")
    add("--fps", type=float, help="maximum number of images per second of film [10 for a moving camera, 30 for "
        "static ones; less if a film would give more than 300 images]")
    add("--masks", type=Path, metavar="DIR", help="for one moving camera: folder of PNG masks, white where something "
        "moves, with the file names of the images that an earlier run wrote; replaces the masks that are otherwise "
        "detected")
    add("--poses", type=Path, metavar="PATH", help="for one moving camera: the cameras of its images, by their names, "
        "from COLMAP's layout (so VGGT's and MegaSaM's) or nerfstudio's; masks and diagnosis are made as usual")
    add("--calibration", type=Path, metavar="FILE", help="for static cameras: their lenses and places, from COLMAP, "
        "nerfstudio (transforms.json), Qualisys (.qca.txt), Pose2Sim (.toml), OpenCV (.yml) or Panoptic (.json); each "
        "film is named as its camera. Images are undistorted, and no training changes these cameras")
    add("--check", type=Path, metavar="DIR", help="instead of films: measure the existing capture in DIR, of any "
        "format that lapgs-train reads, print parallax, path, motion, coverage and exposure, and write "
        "DIR/report.html. Can be combined with --train and --minutes only")
    add("--train", action="store_true", help="then train. Preset, image size and number of steps are chosen from the "
        "graphics adapter, the capture and a short measurement; the run folder is runs/NAME, NAME that of the capture")
    add("--minutes", type=float, metavar="M", help="with --train: how long the training takes, about, evaluation "
        "included; a machine that is busy later takes longer [the preset's whole schedule; on a graphics card at most "
        "an hour]")
    # fmt: on
    return parser


def _prepare(arguments: list[str]) -> None:
    given = options().parse_args(arguments)
    check_options(given)
    capture: Path = given.check or given.out
    run = Path("runs", capture.resolve().name)
    if given.train and run.exists() and (not run.is_dir() or listed(run)):  # now, not after minutes of work
        raise InputError(
            f"{run} is there already, and the training would be written to it; move it, work elsewhere, or go on with "
            f"it by {beside('lapgs-train')} --resume {quoted(run)}."
        )
    if given.out:
        _convert(given)
        # In a new process: on macOS, COLMAP's library and torch each bring an OpenMP, and the second one that is loaded
        # ends the process.
        if given.train and sys.platform == "darwin":
            minutes = [] if given.minutes is None else ["--minutes", str(given.minutes)]
            sys.stdout.flush()
            anew = [sys.executable, "-m", "lapgs_wgpu.prepare_cli", "--check", str(capture), "--train", *minutes]
            os.execv(sys.executable, anew)
    diagnosis = _measure(capture)
    if given.train:
        _train(capture, run, given.minutes, diagnosis)
    elif given.out:
        print(f"to train: {beside('lapgs-prepare')} --check {quoted(capture)} --train --minutes 20")


def check_options(given: argparse.Namespace) -> None:
    """Raises InputError for options that do not go together."""
    others = (given.out, given.fps, given.masks, given.poses, given.calibration)
    if given.check and (given.films or any(other is not None for other in others)):
        raise InputError("--check measures a capture that exists, and goes with --train and --minutes alone.")
    if not given.check and not (given.films and given.out):
        raise InputError("name films to convert and the capture's folder (--out), or a capture to measure (--check).")
    if given.minutes is not None and not (given.train and 0 < given.minutes <= 1e5):
        raise InputError(f"--minutes goes with --train, above 0 and at most 100000, got {given.minutes:g}.")


def _convert(given: argparse.Namespace) -> None:
    from lapgs_wgpu.prepare.capture import prepare  # after --help: numpy and Pillow take a while
    from lapgs_wgpu.prepare.poses import RefusedError
    from lapgs_wgpu.prepare.report import write_refusal

    chosen = {name: getattr(given, name) for name in ("fps", "masks", "poses", "calibration")}
    try:
        prepare(given.films, given.out, **chosen)
    except RefusedError as error:
        write_refusal(given.out, str(error))
        raise


def _measure(folder: Path) -> Diagnosis:
    """Print what a capture is worth, and write the report into its folder."""
    from lapgs_wgpu.prepare.diagnosis import diagnose
    from lapgs_wgpu.prepare.report import REPORT, write_report

    diagnosis = diagnose(folder)
    print(f"{folder}: {diagnosis}", flush=True)
    try:
        write_report(folder, diagnosis)
        print(f"{folder / REPORT} shows it with pictures", flush=True)
    except InputError as error:  # a training can follow all the same
        print(f"note: {error}", file=sys.stderr, flush=True)
    return diagnosis


def _train(capture: Path, run: Path, minutes: float | None, diagnosis: Diagnosis) -> None:
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.run import train
    from lapgs_wgpu.train.plan import plan_training
    from lapgs_wgpu.train.run_folder import result_text

    device = open_device()
    exposure = any(measure.name == "exposure" and measure.good is False for measure in diagnosis.measures)
    print("measuring some steps on this machine ...", file=sys.stderr, flush=True)
    plan = plan_training(capture, diagnosis.dataset, device, minutes=minutes, exposure=exposure)
    print(plan.text, flush=True)
    train(plan.config, plan.dataset, run, device=device)
    print(result_text(run))
    print(f"{beside('lapgs-view')} {quoted(run / 'checkpoint.ply')}")


prepare_command = partial(guarded, "lapgs-prepare", _prepare)

if __name__ == "__main__":
    sys.exit(prepare_command())
