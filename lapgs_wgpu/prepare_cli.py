"""The command lapgs-prepare."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lapgs_wgpu.command import HelpFormatter, Parser, guarded

DESCRIPTION = """\
Convert films to a capture for lapgs-train: choose images and reconstruct the cameras. Needs no other programs, but the
extra prepare: pip install 'lapgs-wgpu[prepare]'.

  lapgs-prepare walk.mp4 --out DIR              one moving camera: a pose for each image
  lapgs-prepare a.mp4 b.mp4 c.mp4 --out DIR     several static cameras: a pose for each film; all films must start at
                                                the same moment

Then train: lapgs-train hypernerf-tiny --data DIR (one camera) or neu3d-tiny (several). See docs/own-data.md."""


def prepare_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-prepare: returns the exit code."""
    return guarded("lapgs-prepare", _prepare, list(sys.argv[1:] if arguments is None else arguments))


def _prepare(arguments: list[str]) -> None:
    parser = Parser("lapgs-prepare", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    # fmt: off
    add = parser.add_argument
    add("films", nargs="+", metavar="FILM", help="films, one per camera, all of the same size in pixels")
    add("--out", required=True, metavar="DIR", help="output folder for the capture; must be new or empty")
    add("--fps", type=float, help="maximum number of images per second of film [10 for a moving camera, 30 for "
        "static ones; less if a film would give more than 300 images]")
    add("--size", type=int, default=1920, metavar="PIXELS", help="longer side of the images; larger frames are shrunk "
        "[1920]")
    add("--masks", metavar="DIR", help="for one moving camera: folder of PNG masks, white where something moves, "
        "with the file names of the images that an earlier run wrote; replaces the masks that are otherwise detected")
    # fmt: on
    given = parser.parse_args(arguments)
    from lapgs_wgpu.prepare.capture import prepare  # after --help: numpy and Pillow take a moment

    done = prepare(
        [Path(film) for film in given.films],
        Path(given.out),
        fps=given.fps,
        longer_side=given.size,
        masks=Path(given.masks) if given.masks else None,
    )
    print(
        f"{done.folder}: {done.images} images, {done.placed} of {done.cameras} cameras placed; "
        f"lapgs-train {done.preset} --data {done.folder}"
    )


if __name__ == "__main__":
    sys.exit(prepare_command())
