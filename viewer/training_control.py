"""A training under way, as the viewer shows and pauses it."""

from __future__ import annotations

from typing import Protocol


class TrainingStep(Protocol):
    """A finished step: its number, the total number of steps, and the PSNR in dB of its view."""

    @property
    def step(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def psnr(self) -> float: ...


class TrainingControl:
    """Pauses a training. last: the last finished step. single: steps that still run although the training is paused."""

    def __init__(self) -> None:
        self.last: TrainingStep | None = None
        self.paused = False
        self.single = 0

    def toggle_pause(self) -> None:
        """Pause or continue."""
        self.paused = not self.paused

    def step(self) -> None:
        """Run one step, then pause."""
        self.paused = True
        self.single += 1
