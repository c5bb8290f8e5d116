"""The state in which a viewer starts, as the command line gives it."""

from __future__ import annotations

from typing import NamedTuple

from lapgs_wgpu.viewer.clock import Loop
from lapgs_wgpu.viewer.offscreen import check_mode, find_view
from lapgs_wgpu.viewer.render_modes import Mode
from lapgs_wgpu.viewer.view_state import ViewState


class InitialState(NamedTuple):
    """None keeps the scene's own value. view: number or name of a camera of the capture."""

    time: float | None = None
    play: bool = False
    fps: float | None = None
    speed: float | None = None
    loop: Loop | None = None
    mode: Mode | None = None
    background: tuple[float, float, float] | None = None
    view: str | None = None

    def apply(self, state: ViewState) -> None:
        """Raises InputError where the scene or its capture lacks the mode or the view."""
        if self.mode is not None:
            check_mode(state.scene, state.renderer, self.mode)
            state.mode = self.mode
        if self.view is not None:
            name = find_view(state.scene, self.view).name
            assert state.ground_truth is not None
            state.stand_at([view.name for view in state.ground_truth.views].index(name))
        if self.background is not None:
            state.background = self.background
        if self.time is not None:
            state.clock.seek(self.time)
        state.clock.fps = self.fps or state.clock.fps
        state.clock.speed = self.speed or state.clock.speed
        state.clock.loop = self.loop or state.clock.loop
        state.clock.playing = self.play
