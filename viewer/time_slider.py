"""The time slider with its transport: play, step, frame rate, speed, loop."""

from __future__ import annotations

from imgui_bundle import imgui

from lapgs_wgpu.viewer.clock import LOOPS, SPEEDS
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.widgets import button, choice


def draw_time_slider(state: ViewState) -> None:
    """Fill the present imgui window."""
    clock = state.clock
    imgui.begin_disabled(not state.scene.playback.moves)
    last = clock.frames - 1
    imgui.set_next_item_width(-1)
    label = f"{clock.time:.3f}   frame {clock.frame} of {last}"
    # imgui reads % in a format; the label has none.
    moved, time = imgui.slider_float("##time", clock.time, 0.0, 1.0, label, imgui.SliderFlags_.no_input)
    if imgui.is_item_deactivated() and imgui.is_mouse_released(imgui.MouseButton_.left):
        # imgui leaves out where the mouse went since the last frame, which is far where frames take long.
        moved, time = True, _slider_value()
    if moved:
        clock.playing = False
        clock.seek(time)
    for text, width, action in (
        ("|<", 32, state.first_frame),
        ("<", 32, state.previous_frame),
        ("Pause" if clock.playing else "Play", 64, state.toggle_playing),
        (">", 32, state.next_frame),
        (">|", 32, state.last_frame),
    ):
        if button(text, width):
            action()
        imgui.same_line()
    imgui.set_next_item_width(70)
    changed, fps = imgui.input_float("fps", clock.fps, 0.0, 0.0, "%.4g")
    if changed:
        clock.fps = min(max(fps, 0.1), 1000.0)
    imgui.same_line()
    speeds = sorted({*SPEEDS, clock.speed})
    clock.speed = choice("speed", clock.speed, speeds, [f"{speed:g}x" for speed in speeds], width=70)
    imgui.same_line()
    clock.loop = choice("##loop", clock.loop, LOOPS, width=84)
    imgui.end_disabled()


def _slider_value() -> float:
    """Return the value, 0 to 1, at which the grab of the last item, a slider, lies under the mouse."""
    half_grab = imgui.get_style().grab_min_size / 2 + 2  # imgui's own padding
    left, right = imgui.get_item_rect_min().x + half_grab, imgui.get_item_rect_max().x - half_grab
    return float((imgui.get_mouse_pos().x - left) / max(right - left, 1.0))
