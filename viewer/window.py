"""The desktop window."""

from __future__ import annotations

import importlib.util
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lapgs_wgpu.errors import InputError, pip_install
from lapgs_wgpu.viewer.app import App, window_title
from lapgs_wgpu.viewer.gui_library import check_imgui
from lapgs_wgpu.viewer.initial_state import InitialState
from lapgs_wgpu.viewer.loaded_scene import LoadedScene

_OTHERWISE = "take --backend http to look in a browser (also from another machine), or --screenshot FILE.png"


def choose_backend(wanted: str, *, otherwise: str = _OTHERWISE) -> str:
    """glfw or qt: the wanted one, or for `auto` the first that works here. otherwise: what works without a window.
    Raises InputError where it does not."""
    check_imgui()
    if wanted != "auto":
        reason = _CHECKS[wanted]()
        if reason:
            raise InputError(f"--backend {wanted}: {reason}.")
        return wanted
    reasons = {}
    for name, check in _CHECKS.items():
        reason = check()
        if reason is None:
            return name
        reasons[name] = reason
    raise InputError(f"no window can be opened here ({reasons['glfw']}): {otherwise}.")


def run_window(
    scene: LoadedScene, *, backend: str, size: tuple[int, int], transport: bool | None, start: InitialState
) -> None:
    """Show it until the window is closed. backend: what choose_backend returned. size: of the picture, logical pixels.
    transport: whether the time slider is shown; where the scene moves, by default. start: what else the window begins
    with. Raises InputError where the scene has no such thing, and DeviceError where the device is lost or full."""

    def drop(path: Path) -> None:
        app.open(path)

    canvas, loop = make_canvas(backend, window_title(scene.path), size, drop)
    app = App(canvas, loop, scene, transport=transport)
    app.state.takes_drops = True
    start.apply(app.state)
    loop.run()
    if app.failed is not None:
        raise app.failed


def make_canvas(
    backend: str, title: str, size: tuple[int, int], drop: Callable[[Path], None] | None = None
) -> tuple[Any, Any]:
    """A window that draws when it is asked to, and its event loop. drop: is told of a file dropped on it."""
    options = {"title": title, "size": size, "update_mode": "ondemand", "max_fps": 60}
    return (_qt_canvas if backend == "qt" else _glfw_canvas)(options, drop)


def _glfw_canvas(options: dict[str, Any], drop: Callable[[Path], None] | None) -> tuple[Any, Any]:
    from rendercanvas.glfw import RenderCanvas, glfw, loop

    canvas = RenderCanvas(**options)
    if drop is not None:
        glfw.set_drop_callback(canvas._window, lambda window, paths: drop(Path(paths[0])))
    return canvas, loop


def _qt_canvas(options: dict[str, Any], drop: Callable[[Path], None] | None) -> tuple[Any, Any]:
    import PySide6.QtWidgets  # noqa: F401  (rendercanvas takes the Qt that is imported)
    from rendercanvas.qt import RenderCanvas, loop

    class Window(RenderCanvas):
        def dragEnterEvent(self, event: Any) -> None:  # noqa: N802
            if event.mimeData().hasUrls():
                event.acceptProposedAction()

        def dropEvent(self, event: Any) -> None:  # noqa: N802
            if drop is not None:
                drop(Path(event.mimeData().urls()[0].toLocalFile()))

    # Without this rendercanvas takes each picture through the processor, and under load stops drawing.
    canvas = Window(present_method="screen", **options)
    canvas.setAcceptDrops(drop is not None)
    return canvas, loop


def _glfw_lacks() -> str | None:
    """Why glfw opens no window here, or None."""
    try:
        import glfw
    except ImportError:
        return f"glfw is not installed: {pip_install('viewer')}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns, and a window without this check would abort the process
        if glfw.init():
            return None
    return "there is no display" if _no_display() else "glfw finds no display that it can use"


def _qt_lacks() -> str | None:
    if importlib.util.find_spec("PySide6") is None:
        return "PySide6 is not installed: pip install PySide6"
    # Qt aborts the process where there is none.
    return f"there is no display: {_OTHERWISE}" if _no_display() and not os.environ.get("QT_QPA_PLATFORM") else None


def _no_display() -> bool:
    return sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


_CHECKS = {"glfw": _glfw_lacks, "qt": _qt_lacks}
