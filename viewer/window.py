"""The desktop window."""

from __future__ import annotations

from pathlib import Path

from .app import App
from .opened import Opened


def run_window(opened: Opened, *, size: tuple[int, int], transport: bool | None) -> None:
    """Show it until the window is closed. size: of the picture, logical pixels. transport: whether the time slider is
    shown; where the scene moves, by default."""
    from rendercanvas.glfw import RenderCanvas, glfw, loop

    canvas = RenderCanvas(title=f"{opened.path} - lapgs-view", size=size, update_mode="ondemand", max_fps=60)
    app = App(canvas, loop, opened, transport=transport)
    glfw.set_drop_callback(canvas._window, lambda window, paths: app.open(Path(paths[0])))
    loop.run()
