"""What the viewer shows: scene, camera, time, mode, comparison. Its methods are the actions of keys and panels."""

from __future__ import annotations

from typing import Any

from lapgs_wgpu.viewer.clock import LOOPS, SPEEDS
from lapgs_wgpu.viewer.frame import FrameRenderer
from lapgs_wgpu.viewer.ground_truth import GroundTruth, open_ground_truth
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.path import Pose
from lapgs_wgpu.viewer.path_editor import PathEditor
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS, COMPARES, Compare, Mode
from lapgs_wgpu.viewer.training_control import TrainingControl


class ViewState:
    """Panels read and set the attributes; keys call the methods and turn the flags (viewer/key_bindings). Knows no
    window and no GUI.

    split: divider of the comparison, share of the width. view: number of the capture's camera that was chosen last, or
    None. message: one sentence for the user, or None. training: the training under way; None where a file is shown.
    """

    def __init__(self, scene: LoadedScene) -> None:
        self.mode: Mode = "rgb"
        self.compare: Compare = "off"
        self.split = 0.5
        self.show_panels = self.show_overlay = True
        self.show_help = False
        self.show_path = False  # opens the panel's section at the next draw
        self.flying = False
        self.training: TrainingControl | None = None
        self.show(scene, FrameRenderer(scene.playback))

    def show(self, scene: LoadedScene, renderer: FrameRenderer) -> None:
        """Show another scene, from its initial camera and time. renderer: of the scene."""
        self.scene, self.renderer = scene, renderer
        self.camera, self.clock = scene.camera(), scene.clock()
        self.path = PathEditor()
        self.background = scene.background
        self.antialiased = scene.playback.at(0.0).antialiased
        self.show_transport = scene.playback.moves
        self._ground_truth: GroundTruth | None = None
        self._ground_truth_sought = False
        self.view: int | None = None
        if self.mode not in self.renderer.modes():
            self.mode = "rgb"
        self.message: str | None = None if scene.playback.moves else "no motion data in this file"

    @property
    def ground_truth(self) -> GroundTruth | None:
        """The capture that the scene was trained on, where it is available. Opened at first use: the first frame does
        not wait for it."""
        if not self._ground_truth_sought:
            scene = self.scene
            self._ground_truth = open_ground_truth(scene.path, scene.playback.metadata) if scene.path else None
            self._ground_truth_sought = True
        return self._ground_truth

    def comparing(self) -> Compare:
        """The comparison in effect: off where the capture has no image of the present camera and time."""
        if self.view is None or self.camera.exact is None or self.mode != "rgb" or self.ground_truth is None:
            return "off"
        return self.compare if abs(self.clock.time - self.ground_truth.views[self.view].time) < 1e-6 else "off"

    def stand_at(self, view: int) -> None:
        """Go to a camera of the capture and to its time."""
        assert self.ground_truth is not None
        self.view = view
        self.camera.snap(self.ground_truth.views[view].camera)
        self.clock.playing = False
        self.clock.seek(self.ground_truth.views[view].time)

    def stand_on(self, pose: Pose, time: float) -> None:
        """Go to a pose of a camera path and to a time."""
        self.camera.stand(pose)
        self.clock.playing = False
        self.clock.seek(time)

    # Actions of keys (viewer/key_bindings), which also turn the flags ------------------------------------------------

    def toggle_playing(self) -> None:
        if self.scene.playback.moves:
            self.clock.toggle()

    def previous_frame(self) -> None:
        self.clock.step(-1)

    def next_frame(self) -> None:
        self.clock.step(1)

    def first_frame(self) -> None:
        self.clock.seek(0.0)

    def last_frame(self) -> None:
        self.clock.seek(1.0)

    def slower(self) -> None:
        self.clock.speed = max((s for s in SPEEDS if s < self.clock.speed), default=SPEEDS[0])

    def faster(self) -> None:
        self.clock.speed = min((s for s in SPEEDS if s > self.clock.speed), default=SPEEDS[-1])

    def next_loop(self) -> None:
        self.clock.loop = _next(LOOPS, self.clock.loop)

    def next_mode(self) -> None:
        self.mode = _next(self.renderer.modes(), self.mode)

    def next_background(self) -> None:
        self.background = _next(list(BACKGROUNDS.values()), self.background)

    def reset_camera(self) -> None:
        self.camera.reset()

    def next_view(self) -> None:
        if self.ground_truth is not None:
            self.stand_at((self.view + 1 if self.view is not None else 0) % len(self.ground_truth.views))

    def next_compare(self) -> None:
        if self.ground_truth is None:
            self.message = "nothing to compare with: the run folder beside this file names no capture that is here"
            return
        if self.view is None or self.camera.exact is None:
            self.stand_at(self.view or 0)
        self.compare = _next(COMPARES, self.compare)

    def toggle_pause(self) -> None:
        if self.training is not None:
            self.training.toggle_pause()

    def step_training(self) -> None:
        if self.training is not None:
            self.training.step()

    def add_key_frame(self) -> None:
        self.path.add(self.camera.pose, self.clock.time)
        self.show_path = True


def _next(choices: Any, present: Any) -> Any:
    return choices[(choices.index(present) + 1) % len(choices)] if present in choices else choices[0]
