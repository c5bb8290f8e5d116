"""Shows a training while it runs: `lapgs-train --view`.

Training and window share one thread: the window's loop takes a step of the training at a time and looks after mouse
and keys in between. A picture of the new state is drawn seldom enough to cost the training little, unless the camera
or the time moves, when the pictures come first.
"""

import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rendercanvas.utils.asyncs import sleep

from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.playback.torch_playback import TorchPlayback
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.viewer import window
from lapgs_wgpu.viewer.app import App
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.view_state import TrainingControl

SHARE = 0.02  # of the time may go into pictures while nobody moves anything


def watch(path: Path, scene: Scene4D, initial_view: InitialView, steps: Iterator[Any]) -> None:
    """Show the scene in a window and take the training's steps, until the window is closed.

    path: of the checkpoint, once there is one. steps: each takes one and returns its StepResult.
    An error of a step closes the window and goes on to the caller.
    """
    canvas, loop = window.make_canvas("training - lapgs-train", (1280, 720))
    app = App(canvas, loop, LoadedScene(path, TorchPlayback(scene), initial_view))
    state, viewport = app.state, app.viewport
    state.training = training = TrainingControl()
    interrupt = signal.getsignal(signal.SIGINT)
    failed: list[Exception] = []

    def on_interrupt(*what: Any) -> None:
        training.paused = False  # the training notices after its next step
        if callable(interrupt):
            interrupt(*what)

    async def drive() -> None:
        signal.signal(signal.SIGINT, on_interrupt)  # in place of the one of the window's loop
        pictured = 0.0  # when the last picture was asked for
        while True:
            # For half a second after a move the pictures come first.
            moving = not state.clock.playing and time.perf_counter() - viewport.moved_at < 0.5
            if moving or (training.paused and not training.single):
                await sleep(0.02)
                continue
            try:
                training.last = next(steps)
            except StopIteration:  # done, or interrupted: what follows must not wait for somebody to close the window
                break
            except Exception as error:  # the window's loop would log it and go on
                failed.append(error)
                break
            training.single = max(0, training.single - 1)
            now = time.perf_counter()
            if training.paused or (not viewport.stale and now - pictured > app.drawing_seconds / SHARE):
                viewport.stale, pictured = True, now
                canvas.request_draw()
            await sleep(0.0)
        canvas.close()

    loop.add_task(drive)
    loop.run()
    if failed:
        raise failed[0]
    if app.failed is not None:
        print(f"the window was closed: {app.failed}", file=sys.stderr)
