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
  lapgs-view runs/demo/checkpoint.ply --backend http      in a browser
"""
NEW_TOKEN = ""  # stands for --token without a text


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
    entry = _entry(given)
    from lapgs_wgpu.gpu.device import open_device

    from .opened import open_scene
    from .window import choose_backend, run_window

    backend = "http" if entry else choose_backend(given.backend)
    opened = open_scene(Path(given.file), open_device(given.device))
    if entry:
        from .remote import run_remote

        run_remote(opened, entry, transport=given.time_slider)
    else:
        run_window(opened, backend=backend, size=given.size, transport=given.time_slider)


def _entry(given: Any) -> Any:
    """Where browsers come in, already listening; None where they do not."""
    if given.backend != "http":
        for option in ("host", "port", "token"):
            if getattr(given, option) is not None:
                raise InputError(f"--{option} goes with --backend http.")
        return None
    from .guard import new_token
    from .remote import DEFAULT_HOST, DEFAULT_PORT, open_entry

    port = DEFAULT_PORT if given.port is None else given.port
    token = new_token() if given.token == NEW_TOKEN else given.token
    return open_entry(given.host or DEFAULT_HOST, port, token)


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
    parser.add_argument(
        "--backend",
        choices=("auto", "glfw", "qt", "http"),
        default="auto",
        help="what shows it: a window (auto: glfw, else qt), or with http any browser [auto]",
    )
    remote = parser.add_argument_group("with --backend http")
    remote.add_argument(
        "--host", metavar="ADDRESS", help="to listen on; any but this machine's own needs --token [127.0.0.1]"
    )
    remote.add_argument("--port", type=_port, metavar="N", help="0: any that is free [8080]")
    remote.add_argument(
        "--token",
        nargs="?",
        const=NEW_TOKEN,
        metavar="TEXT",
        help="what a browser must know to come in, 16 characters or more; one is made where no TEXT is given",
    )
    return parser.parse_args(arguments)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 65535, got {text!r}")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None or not (0 < int(found[1]) <= 16384 and 0 < int(found[2]) <= 16384):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, such as 1280x720, got {text!r}")
    return int(found[1]), int(found[2])


if __name__ == "__main__":
    sys.exit(view_command())
