"""The panel's section for camera paths."""

from __future__ import annotations

import time
from pathlib import Path

from imgui_bundle import imgui

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.path_editor import path_file_of
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import Viewport
from lapgs_wgpu.viewer.widgets import button, printable, tip


def draw_path(state: ViewState, viewport: Viewport) -> None:
    """Draw the key-frames and their buttons into the present imgui window."""
    editor = state.path
    if state.show_path:
        imgui.set_next_item_open(True)
        state.show_path = False
    if not imgui.collapsing_header("Camera path"):
        return
    file = path_file_of(state.scene.path or Path("training.ply"))
    if button("Add (K)"):
        state.add_key_frame()
    imgui.same_line()
    if button("Play" if editor.started is None else "Stop", enabled=len(editor.keys) > 1):
        editor.play(time.perf_counter())
    try:
        if button("Save", enabled=bool(editor.keys)):
            editor.save(file, viewport.canvas.get_physical_size(), state.clock.fps)
            state.message = f"saved {file}"
        tip(printable(str(file)))
        imgui.same_line()
        if button("Load", enabled=file.is_file()):
            editor.load(file)
    except InputError as error:
        state.message = str(error)
    if not editor.keys:
        return
    imgui.begin_child("key-frames", (0, 110), imgui.ChildFlags_.borders)
    for number, key in enumerate(editor.keys):
        label = f"{number + 1}:  {key.second:.2f} s   time {key.time:.3f}##{number}"
        if imgui.selectable(label, editor.chosen == number)[0]:
            editor.chosen, editor.started = number, None
            state.stand_on(key.pose, key.time)
    imgui.end_child()
    if editor.chosen is None:
        return
    imgui.set_next_item_width(100)
    # Enter ends the typing: the list must not be sorted while a number is not whole.
    enter = imgui.InputTextFlags_.enter_returns_true
    changed, second = imgui.input_float("second", editor.keys[editor.chosen].second, 0.25, 1.0, "%.2f", enter)
    if changed:
        editor.move(min(max(second, -3600.0), 86400.0))
    if button("Replace"):
        editor.replace(state.camera.pose, state.clock.time)
    tip("by the present camera and time")
    imgui.same_line()
    if button("Delete"):
        editor.delete()
