"""What the command line says of a window's beginning."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from .choices import Mode
from .clock import Loop
from .shoot import check_mode, find_view

if TYPE_CHECKING:
    from .app import App


class Start(NamedTuple):
    """Each is None where nothing was said. view: number or name of a camera of the capture."""

    time: float | None = None
    play: bool = False
    fps: float | None = None
    speed: float | None = None
    loop: Loop | None = None
    mode: Mode | None = None
    background: tuple[float, float, float] | None = None
    view: str | None = None

    def apply(self, app: App) -> None:
        """Raises InputError where the scene, or its capture, has no such thing."""
        if self.mode is not None:
            check_mode(app.opened, app.painter, self.mode)
            app.mode = self.mode
        if self.view is not None:
            name = find_view(app.opened, self.view).name
            assert app.capture is not None
            app.stand_at([view.name for view in app.capture.views].index(name))
        if self.background is not None:
            app.background = self.background
        if self.time is not None:
            app.clock.seek(self.time)
        app.clock.fps = self.fps or app.clock.fps
        app.clock.speed = self.speed or app.clock.speed
        app.clock.loop = self.loop or app.clock.loop
        app.clock.playing = self.play
