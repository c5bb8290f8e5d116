"""The GUI over the image (Dear ImGui): the view's panel, overlay, help."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from imgui_bundle import imgui
from wgpu.utils.imgui import ImguiRenderer

from lapgs_wgpu.viewer.clock import LOOPS, SPEEDS
from lapgs_wgpu.viewer.controls import KEYS, MOUSE
from lapgs_wgpu.viewer.frame import Frame
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS, MODES
from lapgs_wgpu.viewer.view_state import TrainingControl, ViewState
from lapgs_wgpu.viewer.viewport import Viewport

T = TypeVar("T")
_FIXED = imgui.WindowFlags_.no_move | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_saved_settings
_BAR = _FIXED | imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_scrollbar
_FITTING = imgui.WindowFlags_.always_auto_resize
_GAP = 8.0
_ACCENT = (0.95, 0.60, 0.25, 1.0)


class Panels(ImguiRenderer):
    """The GUI of a ViewState, which `render` draws over what the viewport's canvas shows."""

    def __init__(self, state: ViewState, viewport: Viewport) -> None:
        super().__init__(viewport.device.wgpu_device, viewport.canvas, viewport.format)
        self.state, self.viewport = state, viewport
        self._covered: list[tuple[float, float, float, float]] = []
        self.set_gui(self._draw)
        imgui.get_io().set_ini_filename("")
        imgui.get_io().config_flags &= ~imgui.ConfigFlags_.nav_enable_keyboard  # the keys are the viewer's
        style = imgui.get_style()
        style.window_rounding, style.frame_rounding, style.grab_rounding = 6.0, 4.0, 4.0
        style.window_border_size = 0.0
        style.grab_min_size = 14.0
        style.hover_flags_for_tooltip_mouse = imgui.HoveredFlags_.allow_when_disabled  # at once
        style.set_color_(imgui.Col_.window_bg, (0.08, 0.08, 0.09, 0.85))
        style.set_color_(imgui.Col_.slider_grab, _ACCENT)
        style.set_color_(imgui.Col_.slider_grab_active, _ACCENT)

    def _on_mouse(self, event: dict[str, Any]) -> None:
        """A button goes down where its event says: a finger is there without a move."""
        self.backend.io.add_mouse_pos_event(event["x"], event["y"])
        super()._on_mouse(event)

    def covers(self, x: float, y: float) -> bool:
        """Whether a place on the canvas, logical pixels, lies under a panel. imgui itself knows this only from the
        next frame on."""
        return any(left <= x < right and top <= y < bottom for left, top, right, bottom in self._covered)

    @contextmanager
    def _panel(self, title: str, place: tuple[float, float], flags: int, closable: bool | None = None) -> Iterator[Any]:
        """A panel, and a note of where it lies. Yields whether it stays open. place: on the canvas, shares of its width
        and height; the panel's own point at these shares lies there."""
        sides = self.viewport.canvas.get_logical_size()
        corner = tuple(_GAP + share * (side - 2 * _GAP) for share, side in zip(place, sides, strict=True))
        imgui.set_next_window_pos(corner, imgui.Cond_.always, place)
        yield imgui.begin(title, closable, flags)[1]
        (x, y), (width, height) = imgui.get_window_pos(), imgui.get_window_size()
        self._covered.append((x, y, x + width, y + height))
        imgui.end()

    def _draw(self) -> None:
        state, frame = self.state, self.viewport.frame
        self._covered.clear()
        if state.show_help:
            with self._panel("Keys and mouse", (0.5, 0.5), _FIXED | _FITTING, closable=True) as stays:
                if imgui.begin_table("keys", 2):
                    for shown, text in (*((key.shown, key.help) for key in KEYS), *MOUSE):
                        imgui.table_next_row()
                        imgui.table_next_column()
                        imgui.text_colored(_ACCENT, shown)
                        imgui.table_next_column()
                        imgui.text(text)
                    imgui.end_table()
            state.show_help = bool(stays)
        if not state.show_panels:
            return
        imgui.set_next_window_size((230, 0))
        with self._panel("View", (0.0, 0.0), _FIXED):
            self._view()
        if state.show_overlay and frame is not None:
            imgui.set_next_window_bg_alpha(0.6)
            with self._panel("overlay", (1.0, 0.0), _BAR | _FITTING | imgui.WindowFlags_.no_nav):
                self._overlay(frame)
        if state.show_transport:
            imgui.set_next_window_size((self.viewport.canvas.get_logical_size()[0] - 2 * _GAP, 62))
            with self._panel("transport", (0.0, 1.0), _BAR):
                _time_slider(state)

    def _view(self) -> None:
        """Fill the panel at the left."""
        state, frame = self.state, self.viewport.frame
        state.mode = _choice("mode", state.mode, state.renderer.modes())
        imgui.set_item_tooltip(MODES[state.mode])
        if frame is not None and frame.request.mode in ("depth", "motion"):
            imgui.text(f"dark {frame.low:.3g}, bright {frame.high:.3g}")
        state.background = _choice("ground", state.background, list(BACKGROUNDS.values()), list(BACKGROUNDS))
        imgui.set_item_tooltip("background")
        _, state.antialiased = imgui.checkbox("antialiased", state.antialiased)
        imgui.set_item_tooltip("Mip-Splatting's filter, as antialiased trainings draw (X)")
        if _button("Reset", tip="camera back to where it started (R)"):
            state.camera.reset()
        imgui.same_line()
        if _button("Help", tip="keys and mouse (?)"):
            state.show_help = not state.show_help
        if state.training is not None:
            self._training(state.training)
        if views := state.scene.views:
            chosen = _choice("camera", state.view, range(len(views)), [view.name for view in views])
            if chosen != state.view:
                state.stand_at(chosen)

    def _training(self, training: TrainingControl) -> None:
        imgui.separator_text("Training")
        last = training.last
        if last is not None:
            imgui.progress_bar(last.step / last.steps, (-1, 0), f"step {last.step} of {last.steps}")
            imgui.text(f"{last.psnr:.2f} dB   {self.state.scene.playback.count:,} Gaussians")
        if _button("Go on" if training.paused else "Pause"):
            self.state.toggle_pause()
        imgui.same_line()
        if _button("Step", tip="one step of the optimizer, then pause"):
            self.state.step_training()

    def _overlay(self, frame: Frame) -> None:
        camera, scale = frame.request.camera, self.viewport.scale
        imgui.text(f"{1 / max(frame.seconds, 1e-4):.1f} frames a second   {1000 * frame.seconds:.1f} ms")
        imgui.text(f"{frame.splats:,} of {self.state.scene.playback.count:,} splats")
        imgui.text(f"{camera.width}x{camera.height}" + (f" ({100 * scale:.0f} %)" if scale < 1 else ""))
        imgui.text(self.viewport.device.info.name[:34])


def _time_slider(state: ViewState) -> None:
    """Fill the present imgui window with the slider and its transport: play, step, frame rate, speed, loop."""
    clock = state.clock
    imgui.begin_disabled(not state.scene.playback.moves)
    last = clock.frames - 1
    imgui.set_next_item_width(-1)
    label = f"{clock.time:.3f}   frame {clock.frame} of {last}"
    # imgui reads % in a format; the label has none.
    moved, time = imgui.slider_float("##time", clock.time, 0.0, 1.0, label, imgui.SliderFlags_.no_input)
    if imgui.is_item_deactivated() and imgui.is_mouse_released(imgui.MouseButton_.left):
        # imgui leaves out where the mouse went since the last frame, which is far where frames take long.
        half_grab = imgui.get_style().grab_min_size / 2 + 2  # imgui's own padding
        left, right = imgui.get_item_rect_min().x + half_grab, imgui.get_item_rect_max().x - half_grab
        moved, time = True, (imgui.get_mouse_pos().x - left) / max(right - left, 1.0)
    if moved:
        clock.playing = False
        clock.seek(time)
    for text, width, action in (
        ("|<", 32, partial(clock.seek, 0.0)),
        ("<", 32, partial(clock.step, -1)),
        ("Pause" if clock.playing else "Play", 64, clock.toggle),
        (">", 32, partial(clock.step, 1)),
        (">|", 32, partial(clock.seek, 1.0)),
    ):
        if _button(text, width):
            action()
        imgui.same_line()
    imgui.set_next_item_width(70)
    changed, fps = imgui.input_float("fps", clock.fps, 0.0, 0.0, "%.4g")
    if changed:
        clock.fps = min(max(fps, 0.1), 1000.0)
    imgui.same_line()
    speeds = sorted({*SPEEDS, clock.speed})
    clock.speed = _choice("speed", clock.speed, speeds, [f"{speed:g}x" for speed in speeds], width=70)
    imgui.same_line()
    clock.loop = _choice("##loop", clock.loop, LOOPS, width=84)
    imgui.end_disabled()


def _button(label: str, width: float = 66, tip: str = "") -> bool:
    pressed = bool(imgui.button(label, (width, 0)))
    if tip:
        imgui.set_item_tooltip(tip)
    return pressed


def _choice(label: str, present: T, choices: Sequence[T], names: Sequence[str] | None = None, width: float = -70) -> T:
    imgui.set_next_item_width(width)
    at = choices.index(present) if present in choices else -1
    changed, chosen = imgui.combo(label, at, list(map(str, choices if names is None else names)))
    return choices[chosen] if changed else present
