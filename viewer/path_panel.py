"""The panel's section for camera paths."""

from __future__ import annotations

import time
from pathlib import Path

from imgui_bundle import imgui

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.path import CameraPath
from lapgs_wgpu.viewer.path_file import PathFile, write_path
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import Viewport
from lapgs_wgpu.viewer.widgets import button, printable, tip


def draw_path(state: ViewState, viewport: Viewport) -> None:
    """Draw the number of key-frames and their buttons into the present imgui window."""
    editor = state.path
    if state.show_path:
        imgui.set_next_item_open(True)
        state.show_path = False
    if not imgui.collapsing_header("Camera path"):
        return
    if button("Add (K)"):
        state.add_key_frame()
    imgui.same_line()
    if button("Undo", enabled=bool(editor.keys)):
        editor.undo()
    imgui.same_line()
    if button("Play" if editor.started is None else "Stop", enabled=len(editor.keys) > 1):
        editor.play(time.perf_counter())
    file = (state.scene.path or Path("training")).with_suffix(".camera_path.json")
    if button("Save", enabled=bool(editor.keys)):
        try:
            write_path(file, PathFile(CameraPath(editor.keys), viewport.canvas.get_physical_size(), state.clock.fps))
            state.message = f"saved {file}"
        except InputError as error:
            state.message = str(error)
    tip(printable(str(file)))
    imgui.same_line()
    imgui.text(f"{len(editor.keys)} key-frames")
