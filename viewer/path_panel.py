"""The panel's section for camera paths."""

from __future__ import annotations

import time
from pathlib import Path

from imgui_bundle import imgui

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.gui_library import printable
from lapgs_wgpu.viewer.path_editor import path_file_of
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import Viewport


def draw_path(state: ViewState, viewport: Viewport) -> None:
    """Draw the key-frames and their buttons into the present imgui window."""
    editor = state.path
    if state.show_path:
        imgui.set_next_item_open(True)
        state.show_path = False
    if not imgui.collapsing_header("Camera path"):
        return
    if imgui.button("Add (K)", (66, 0)):
        state.add_key_frame()
    imgui.same_line()
    imgui.begin_disabled(len(editor.keys) < 2)
    if imgui.button("Play" if editor.started is None else "Stop", (66, 0)):
        editor.play(time.perf_counter())
    imgui.end_disabled()
    file = path_file_of(state.scene.path or Path("training.ply"))
    for text, action, possible in (
        ("Save", lambda: editor.save(file, viewport.canvas.get_physical_size(), state.clock.fps), bool(editor.keys)),
        ("Load", lambda: editor.load(file), file.is_file()),
    ):
        if text == "Load":
            imgui.same_line()
        imgui.begin_disabled(not possible)
        if imgui.button(text, (66, 0)):
            try:
                kept = action()
                state.message = f"{'saved' if text == 'Save' else 'loaded'} {file}"
                state.message += f"; the path that was there is {kept.name} now" if kept else ""
            except InputError as error:
                state.message = str(error)
        imgui.end_disabled()
        if imgui.is_item_hovered():
            imgui.set_tooltip(printable(str(file)))
    if not editor.keys:
        return
    imgui.begin_child("key-frames", (0, 110), imgui.ChildFlags_.borders)
    for number, key in enumerate(editor.keys):
        label = f"{number + 1}:  {key.second:.2f} s   time {key.time:.3f}##{number}"
        if imgui.selectable(label, editor.chosen == number)[0]:
            editor.chosen, editor.started = number, None
            state.stand_on(key.pose, key.time)
    imgui.end_child()
    if editor.chosen is not None:
        imgui.set_next_item_width(100)
        now = editor.keys[editor.chosen].second
        # Enter ends the typing: the list must not be sorted while a number is not whole.
        enter = imgui.InputTextFlags_.enter_returns_true
        changed, second = imgui.input_float("second", now, 0.25, 1.0, "%.2f", enter)
        if changed:
            editor.move(min(max(second, -3600.0), 86400.0))
        if imgui.button("Replace", (66, 0)):
            editor.replace(state.camera, state.clock.time)
        if imgui.is_item_hovered():
            imgui.set_tooltip("by the present camera and time")
        imgui.same_line()
        if imgui.button("Delete", (66, 0)):
            editor.delete()
