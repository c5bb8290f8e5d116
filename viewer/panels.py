"""The GUI over the picture (Dear ImGui): transport, view, overlay, files, help. It reads and sets App's attributes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from imgui_bundle import imgui
from wgpu.utils.imgui import ImguiRenderer

from .app import COMPARES, App
from .choices import BACKGROUNDS, MODES
from .clock import LOOPS, SPEEDS
from .keys import KEYS, MOUSE
from .path_panel import draw_path
from .present import HEAT

if TYPE_CHECKING:
    from .live import Training

_FIXED = imgui.WindowFlags_.no_move | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_saved_settings
_BAR = _FIXED | imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_scrollbar
_TEXT = _BAR | imgui.WindowFlags_.no_inputs | imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_nav
_GAP = 8.0
_SIDE = 230.0  # width of the panel at the left
_ACCENT = (0.95, 0.60, 0.25, 1.0)
_COMPARE_NAMES = ("no comparison", "side by side", "split", "error, 4 times")


class _Renderer(ImguiRenderer):
    """wgpu's, but keys are kept from the viewer only while text is typed: after a click on a panel, imgui would
    otherwise hold on to them."""

    def _on_key(self, event: dict[str, Any]) -> None:
        passed_on = dict(event)
        super()._on_key(passed_on)
        if self.backend.io.want_text_input:
            event["stop_propagation"] = True


def _slider_value() -> float:
    """0 to 1 where the grab of the last item, a slider, stands in its middle under the mouse."""
    half_grab = imgui.get_style().grab_min_size / 2 + 2  # imgui's own padding
    left, right = imgui.get_item_rect_min().x + half_grab, imgui.get_item_rect_max().x - half_grab
    return float((imgui.get_mouse_pos().x - left) / max(right - left, 1.0))


class Panels:
    """Draws the GUI of an App onto its canvas."""

    def __init__(self, app: App) -> None:
        self.app = app
        self._covered: list[tuple[float, float, float, float]] = []
        self._renderer = _Renderer(app.device.wgpu_device, app.canvas, app.format)
        self._renderer.set_gui(self._draw)
        self._folder = app.opened.path.resolve().parent if app.opened.path else Path.cwd()
        self._browsing = False
        imgui.get_io().set_ini_filename("")
        imgui.get_io().config_flags &= ~imgui.ConfigFlags_.nav_enable_keyboard  # the keys are the viewer's
        _style()

    def render(self) -> None:
        """Draw over what the canvas shows."""
        self._renderer.render()

    def covers(self, x: float, y: float) -> bool:
        """Whether a place on the canvas, logical pixels, lies under a panel. imgui itself knows this only from the
        next frame on."""
        return any(left <= x < right and top <= y < bottom for left, top, right, bottom in self._covered)

    def _end(self) -> None:
        """The panel that was begun last is whole."""
        (x, y), (width, height) = imgui.get_window_pos(), imgui.get_window_size()
        self._covered.append((x, y, x + width, y + height))
        imgui.end()

    def _draw(self) -> None:
        app = self.app
        self._covered.clear()
        if app.show_help:
            self._help()
        if not app.show_panels:
            return
        self._view()
        if app.show_overlay:
            self._overlay()
        if app.show_transport:
            self._transport()
        if app.message:
            self._message(app.message)

    # The time slider -------------------------------------------------------------------------------------------------

    def _transport(self) -> None:
        app, clock = self.app, self.app.clock
        width, height = app.canvas.get_logical_size()
        bar = 62.0
        imgui.set_next_window_pos((_GAP, height - bar - _GAP))
        imgui.set_next_window_size((width - 2 * _GAP, bar))
        imgui.begin("transport", None, _BAR)
        imgui.begin_disabled(not app.opened.playback.moves)
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
            clock.seek(min(max(time, 0.0), 1.0))
        for text, action in (("|<", app.first_frame), ("<", app.previous_frame)):
            if imgui.button(text, (32, 0)):
                action()
            imgui.same_line()
        if imgui.button("Pause" if clock.playing else "Play", (64, 0)):
            app.toggle_playing()
        imgui.same_line()
        for text, action in ((">", app.next_frame), (">|", app.last_frame)):
            if imgui.button(text, (32, 0)):
                action()
            imgui.same_line()
        imgui.set_next_item_width(70)
        changed, fps = imgui.input_float("fps", clock.fps, 0.0, 0.0, "%.4g")
        if changed:
            clock.fps = min(max(fps, 0.1), 1000.0)
        imgui.same_line()
        imgui.set_next_item_width(70)
        speeds = [f"{speed:g}x" for speed in SPEEDS]
        present = SPEEDS.index(clock.speed) if clock.speed in SPEEDS else SPEEDS.index(1.0)
        changed, chosen = imgui.combo("speed", present, speeds)
        if changed:
            clock.speed = SPEEDS[chosen]
        imgui.same_line()
        imgui.set_next_item_width(84)
        changed, chosen = imgui.combo("##loop", LOOPS.index(clock.loop), list(LOOPS))
        if changed:
            clock.loop = LOOPS[chosen]
        imgui.end_disabled()
        self._end()

    # The panel at the left -------------------------------------------------------------------------------------------

    def _view(self) -> None:
        app = self.app
        imgui.set_next_window_pos((_GAP, _GAP))
        imgui.set_next_window_size((_SIDE, 0))
        imgui.begin("View", None, _FIXED)
        modes = app.painter.modes()
        imgui.set_next_item_width(-70)
        changed, chosen = imgui.combo("mode", modes.index(app.mode), list(modes))
        if changed:
            app.mode = modes[chosen]
        _tip(MODES[app.mode])
        if app.frame is not None and app.frame.placed.shows in ("depth", "value"):
            _legend(app.frame.placed.low, app.frame.placed.high)
        names = list(BACKGROUNDS)
        colours = list(BACKGROUNDS.values())
        imgui.set_next_item_width(-70)
        present = colours.index(app.background) if app.background in colours else 0
        changed, chosen = imgui.combo("ground", present, names)
        if changed:
            app.background = colours[chosen]
        _tip("background")
        for text, action, tip in (
            ("Reset", app.reset_camera, "camera back to where it started (R)"),
            ("Open", self._toggle_browsing, "another .ply file; one can also be dropped on the window"),
            ("Help", app.toggle_help, "keys and mouse (?)"),
        ):
            if imgui.button(text, (66, 0)):
                action()
            _tip(tip)
            imgui.same_line()
        imgui.new_line()
        if app.flying:
            imgui.text_colored(_ACCENT, "flying: W A S D Q E, V ends")
        if app.training is not None:
            self._training(app.training)
        if app.capture is not None:
            self._capture()
        draw_path(app)
        if self._browsing:
            self._files()
        self._end()

    def _training(self, training: Training) -> None:
        imgui.separator_text("Training")
        last = training.last
        if last is not None:
            imgui.progress_bar(last.step / last.steps, (-1, 0), f"step {last.step} of {last.steps}")
            imgui.text(f"{last.psnr:.2f} dB   {self.app.opened.playback.count:,} Gaussians")
        if imgui.button("Go on" if training.paused else "Pause", (66, 0)):
            self.app.toggle_pause()
        imgui.same_line()
        if imgui.button("Step", (66, 0)):
            self.app.step_training()
        _tip("one step of the optimiser, then pause")

    def _capture(self) -> None:
        app = self.app
        assert app.capture is not None
        imgui.separator_text("Capture")
        names = [view.name for view in app.capture.views]
        imgui.set_next_item_width(-70)
        changed, chosen = imgui.combo("camera", -1 if app.view is None else app.view, names)
        if changed:
            app.stand_at(chosen)
        imgui.set_next_item_width(-1)
        changed, chosen = imgui.combo("##compare", COMPARES.index(app.compare), list(_COMPARE_NAMES))
        if changed:
            app.compare = COMPARES[chosen]
            if app.view is None:
                app.stand_at(0)
        if app.compare != "off" and app.comparing() == "off":
            imgui.text_wrapped("The capture has no picture of this camera and time; N goes to the next that it has.")

    # Files -----------------------------------------------------------------------------------------------------------

    def _toggle_browsing(self) -> None:
        self._browsing = not self._browsing

    def _files(self) -> None:
        """A small file dialog: it works the same in a window and in a browser."""
        imgui.separator_text("Open")
        imgui.text_wrapped(str(self._folder))
        imgui.begin_child("files", (0, 180), imgui.ChildFlags_.borders)
        if imgui.selectable("../", False)[0]:
            self._folder = self._folder.parent
        try:
            entries = sorted(self._folder.iterdir())
        except OSError as error:
            entries = []
            imgui.text_wrapped(str(error))
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_dir() and imgui.selectable(f"{entry.name}/", False)[0]:
                self._folder = entry
            elif entry.suffix.lower() == ".ply" and imgui.selectable(entry.name, False)[0]:
                self._browsing = False
                self.app.open(entry)
        imgui.end_child()

    # Texts over the picture ------------------------------------------------------------------------------------------

    def _overlay(self) -> None:
        app = self.app
        if app.frame is None:
            return
        width, _ = app.canvas.get_logical_size()
        imgui.set_next_window_pos((width - _GAP, _GAP), imgui.Cond_.always, (1.0, 0.0))
        imgui.set_next_window_bg_alpha(0.6)
        # Not without inputs: its one check box must be reached.
        imgui.begin("overlay", None, _BAR | imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_nav)
        frame, camera = app.frame, app.frame.request.camera
        rate = f"{app.fps:.0f} fps" if app.fps else "at rest"
        imgui.text(f"{rate}   {1000 * frame.seconds:.1f} ms a frame")
        imgui.text(f"{frame.splats:,} of {app.opened.playback.count:,} splats")
        imgui.text(f"{camera.width}x{camera.height}" + (f" ({100 * app.scale:.0f} %)" if app.scale < 1 else ""))
        imgui.text(app.device.info.name[:34])
        _, app.profiling = imgui.checkbox("passes", app.profiling)
        for name, milliseconds in sorted(frame.passes.items(), key=lambda entry: -entry[1]):
            imgui.text(f"{milliseconds:7.2f} ms {name}")
        self._end()

    def _message(self, message: str) -> None:
        app = self.app
        width, _ = app.canvas.get_logical_size()
        imgui.set_next_window_pos((0.5 * width, _GAP), imgui.Cond_.always, (0.5, 0.0))
        imgui.set_next_window_size((min(420.0, width - 2 * _GAP), 0))
        imgui.begin("message", None, _BAR)
        imgui.text_wrapped(message)
        if imgui.button("OK"):
            app.message = None
        self._end()

    def _help(self) -> None:
        width, height = self.app.canvas.get_logical_size()
        imgui.set_next_window_pos((0.5 * width, 0.5 * height), imgui.Cond_.always, (0.5, 0.5))
        _, stays = imgui.begin("Keys and mouse", True, _FIXED | imgui.WindowFlags_.always_auto_resize)
        if imgui.begin_table("keys", 2):
            for shown, text in (*((key.shown, key.help) for key in KEYS), *MOUSE):
                imgui.table_next_row()
                imgui.table_next_column()
                imgui.text_colored(_ACCENT, shown)
                imgui.table_next_column()
                imgui.text(text)
            imgui.end_table()
        self._end()
        self.app.show_help = bool(stays)


def _tip(text: str) -> None:
    if imgui.is_item_hovered():
        imgui.set_tooltip(text)


def _legend(low: float, high: float) -> None:
    """The scale of colours with the values at its ends."""
    x, y = imgui.get_cursor_screen_pos()
    width = imgui.get_content_region_avail().x
    step = width / (len(HEAT) - 1)
    draw = imgui.get_window_draw_list()
    for i in range(len(HEAT) - 1):
        a, b = (imgui.get_color_u32((*colour, 1.0)) for colour in HEAT[i : i + 2])
        draw.add_rect_filled_multi_color((x + i * step, y), (x + (i + 1) * step, y + 10), a, b, b, a)
    imgui.dummy((width, 12))
    imgui.text(f"{low:.3g}")
    imgui.same_line(max(0.0, width - imgui.calc_text_size(f"{high:.3g}").x))
    imgui.text(f"{high:.3g}")


def _style() -> None:
    style = imgui.get_style()
    style.window_rounding, style.frame_rounding, style.grab_rounding = 6.0, 4.0, 4.0
    style.window_border_size = 0.0
    style.grab_min_size = 14.0
    for name, colour in (
        (imgui.Col_.window_bg, (0.08, 0.08, 0.09, 0.85)),
        (imgui.Col_.slider_grab, _ACCENT),
        (imgui.Col_.slider_grab_active, (1.0, 0.75, 0.4, 1.0)),
        (imgui.Col_.check_mark, _ACCENT),
    ):
        style.set_color_(name, colour)
