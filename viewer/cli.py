"""The command lapgs-view."""

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module

from lapgs_wgpu.command import guarded, print_devices
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.options import parse_options

# What a call does -> the module of the viewer that does it, and its function, which opens the file, too.
_JOBS = {
    "screenshot": ("offscreen", "write_screenshot"),
    "video": ("offscreen", "write_video"),
    "export": ("export", "write_export"),
    "http": ("remote", "run_remote"),
    "glfw": ("window", "run_window"),
}


def _view(arguments: list[str]) -> None:
    given, job = parse_options(arguments)
    if job == "list_devices":
        print_devices()
        return
    if given.file is None:
        raise InputError("name a file or a folder of frames; lapgs-view --help says more.")
    from lapgs_wgpu.gpu.device import open_device

    with ThreadPoolExecutor(1) as other:
        device = other.submit(open_device, given.device)  # beside all that follows, which takes as long together
        module, function = _JOBS[job]
        getattr(import_module(f"lapgs_wgpu.viewer.{module}"), function)(given, device.result)


view_command = partial(guarded, "lapgs-view", _view)

if __name__ == "__main__":
    sys.exit(view_command())
