"""lapgs-view: the command."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lapgs_wgpu.command import guarded, print_devices
from lapgs_wgpu.errors import InputError

DESCRIPTION = """\
Look at a trained scene, or any 3DGS .ply, at any time from any side.

  lapgs-view runs/demo/checkpoint.ply --time-slider
"""


def view_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-view: returns the exit code."""
    return guarded("lapgs-view", _view, list(sys.argv[1:] if arguments is None else arguments))


def _view(arguments: list[str]) -> None:
    given = _parse(arguments)
    if given.list_devices:
        print_devices()
        return
    if given.file is None:
        raise InputError("name a .ply file; lapgs-view --help says more.")
    from lapgs_wgpu.gpu.device import open_device

    from .opened import open_scene

    opened = open_scene(Path(given.file), open_device(given.device))
    from .window import run_window

    run_window(opened, size=given.size, transport=given.time_slider)


def _parse(arguments: list[str]) -> Any:
    parser = argparse.ArgumentParser(
        "lapgs-view", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("file", nargs="?", metavar="FILE.ply", help="a checkpoint, or any 3DGS .ply")
    parser.add_argument(
        "--time-slider", action=argparse.BooleanOptionalAction, help="show the time slider [where the scene moves]"
    )
    parser.add_argument("--size", type=_size, default=(1280, 720), metavar="WxH", help="of the picture [1280x720]")
    parser.add_argument("--device", metavar="NAME", help="part of an adapter's name, or cpu, integrated, discrete")
    parser.add_argument("--list-devices", action="store_true", help="list the adapters, the default one first")
    return parser.parse_args(arguments)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None or not (0 < int(found[1]) <= 16384 and 0 < int(found[2]) <= 16384):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, such as 1280x720, got {text!r}")
    return int(found[1]), int(found[2])


if __name__ == "__main__":
    sys.exit(view_command())
