"""The desktop window, by glfw."""

import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

from lapgs_wgpu.errors import InputError, optional_module, pip_install
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.viewer.app import App
from lapgs_wgpu.viewer.loaded_scene import given_scene
from lapgs_wgpu.viewer.options import SIZE


def check_window(otherwise: str) -> None:
    """Raises InputError where no window can be opened here. otherwise: what works without one."""
    check_imgui()
    glfw = optional_module("glfw", "the window needs glfw", "viewer")
    with warnings.catch_warnings(action="ignore"):  # it warns, and a window without this check would abort the process
        if glfw.init():
            return
    missing = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    reason = "there is no display" if missing else "glfw finds no display that it can use"
    raise InputError(f"no window can be opened here ({reason}): {otherwise}.")


def check_imgui() -> None:
    """Raises InputError where the package is missing, or a library of the system that it does not bring."""
    try:
        import imgui_bundle  # noqa: F401
    except ModuleNotFoundError:
        raise InputError(f"the viewer needs imgui-bundle: {pip_install('viewer')}.") from None
    except ImportError as error:
        raise InputError(
            f"imgui-bundle cannot be loaded ({error}); on Debian and Ubuntu: sudo apt-get install -y libx11-6 libxext6."
        ) from None


def run_window(given: Any, device: Callable[[], Device]) -> None:
    """Show the file in a window, as the options of lapgs-view say, until it is closed. Raises InputError, before the
    file is read where no window can be opened, and DeviceError where the device is lost or full."""
    check_window("take --backend http to look in a browser (also from another machine), or --screenshot FILE.png")
    scene = given_scene(given, device)
    canvas, loop = make_canvas(f"{scene.path} - lapgs-view", given.size or SIZE)
    app = App(canvas, loop, scene)
    app.state.begin(given)
    loop.run()
    if app.failed is not None:
        raise app.failed


def make_canvas(title: str, size: tuple[int, int]) -> tuple[Any, Any]:
    """Make a window that draws on request, and its event loop."""
    from rendercanvas.glfw import RenderCanvas, loop

    return RenderCanvas(title=title, size=size, update_mode="ondemand", max_fps=60), loop
