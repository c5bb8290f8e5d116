"""What the viewer shows: scene, camera, time, mode. Its methods are actions of keys and panels."""

from dataclasses import dataclass
from typing import Any

from lapgs_wgpu.viewer.frame import FrameRenderer
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS, Mode


@dataclass
class TrainingControl:
    """Pauses a training. last: its last StepResult. single: number of steps that still run although it is paused."""

    last: Any = None
    paused: bool = False
    single: int = 0


class ViewState:
    """Panels read and set the attributes; keys call the methods and turn the flags (viewer/controls).

    view: number of the capture's camera that was chosen last, -1 before. training: None where a file is shown.
    """

    def __init__(self, scene: LoadedScene) -> None:
        self.mode: Mode = "rgb"
        self.show_panels = self.show_overlay = True
        self.show_help = False
        self.training: TrainingControl | None = None
        self.scene, self.renderer = scene, FrameRenderer(scene.playback)
        self.camera, self.clock = scene.camera(), scene.clock()
        self.background = scene.background
        self.antialiased = bool(scene.playback.at(0.0).antialiased)
        self.show_transport = scene.playback.moves
        self.view = -1

    def begin(self, given: Any) -> None:
        """Begin as the options of lapgs-view say. Raises InputError where the capture lacks the view."""
        self.mode = given.mode or self.mode
        if given.view is not None:
            self.stand_at(self.scene.view_number(given.view))
        self.background = BACKGROUNDS.get(given.background, self.background)
        self.show_transport = bool(given.time_slider or self.show_transport)
        clock = self.clock
        if given.time is not None:
            clock.seek(given.time)
        clock.fps, clock.speed = given.fps or clock.fps, given.speed or clock.speed
        clock.loop = given.loop or clock.loop
        if given.play:
            clock.toggle()

    def stand_at(self, view: int) -> None:
        """Go to a camera of the capture and to its time."""
        self.view = view
        self.camera.stand_at(self.scene.views[view].camera)
        self.clock.playing = False
        self.clock.seek(self.scene.views[view].time)

    def next_mode(self) -> None:
        self.mode = _next(self.renderer.modes(), self.mode)

    def next_background(self) -> None:
        self.background = _next(list(BACKGROUNDS.values()), self.background)

    def next_view(self) -> None:
        if self.scene.views:
            self.stand_at((self.view + 1) % len(self.scene.views))

    def toggle_pause(self) -> None:
        if self.training is not None:
            self.training.paused = not self.training.paused

    def step_training(self) -> None:
        if self.training is not None:
            self.training.paused = True
            self.training.single += 1


def _next(choices: Any, present: Any) -> Any:
    return choices[(choices.index(present) + 1) % len(choices)]
