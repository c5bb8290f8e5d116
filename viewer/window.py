"""The desktop window."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .app import App
from .opened import Opened


def run_window(opened: Opened, *, size: tuple[int, int], transport: bool | None) -> None:
    """Show it until the window is closed. size: of the picture, logical pixels. transport: whether the time slider is
    shown; where the scene moves, by default."""
    canvas, loop = make_canvas(f"{opened.path} - lapgs-view", size)
    app = App(canvas, loop, opened, transport=transport)
    from rendercanvas.glfw import glfw

    glfw.set_drop_callback(canvas._window, lambda window, paths: app.open(Path(paths[0])))
    loop.run()


def make_canvas(title: str, size: tuple[int, int]) -> tuple[Any, Any]:
    """A window that draws when it is asked to, and its event loop."""
    from rendercanvas.glfw import RenderCanvas, loop

    return RenderCanvas(title=title, size=size, update_mode="ondemand", max_fps=60), loop
