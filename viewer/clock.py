"""Time in the clip while it plays."""

from dataclasses import dataclass
from typing import Literal

Loop = Literal["loop", "bounce", "once"]
LOOPS: tuple[Loop, ...] = ("loop", "bounce", "once")
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)


@dataclass
class Clock:
    """The present time in the clip, and how it advances.

    time: in [0, 1]. frames: of the clip, the first at time 0, the last at 1. fps: frames shown a second at speed 1.
    forward: the direction, which turns at the ends where `loop` is bounce.
    """

    frames: int
    time: float = 0.0
    playing: bool = False
    fps: float = 30.0
    speed: float = 1.0
    loop: Loop = "loop"
    forward: bool = True

    @property
    def frame(self) -> int:
        """Number of the frame nearest to the time, from 0."""
        return round(self.time * (self.frames - 1))

    @property
    def seconds(self) -> float:
        """Length of the clip at speed 1."""
        return max(1, self.frames - 1) / self.fps

    def seek(self, time: float) -> None:
        """Go to a time; beyond the ends to the end."""
        self.time = min(max(time, 0.0), 1.0)

    def toggle(self) -> None:
        """Play or pause; at the end of a clip that plays once, from the start. What has one frame does not play."""
        self.playing = not self.playing and self.frames > 1
        if self.playing and self.loop == "once" and self.time >= 1.0:
            self.time = 0.0

    def step(self, frames: int) -> None:
        """Pause, and go some frames on or back."""
        self.playing = False
        self.seek((self.frame + frames) / max(1, self.frames - 1))

    def slower(self) -> None:
        self.speed = max((speed for speed in SPEEDS if speed < self.speed), default=SPEEDS[0])

    def faster(self) -> None:
        self.speed = min((speed for speed in SPEEDS if speed > self.speed), default=SPEEDS[-1])

    def next_loop(self) -> None:
        self.loop = LOOPS[(LOOPS.index(self.loop) + 1) % len(LOOPS)]

    def advance(self, seconds: float) -> None:
        """Let that much of the viewer's time pass."""
        if not self.playing:
            return
        way = seconds * self.speed / self.seconds
        if self.loop == "loop":
            self.time = (self.time + way) % 1.0
        elif self.loop == "once":
            self.time = min(self.time + way, 1.0)
            self.playing = self.time < 1.0
        else:
            # Folded back at both ends: a place on a circle of twice the clip's length.
            place = ((self.time if self.forward else 2.0 - self.time) + way) % 2.0
            self.forward = place < 1.0
            self.time = place if self.forward else 2.0 - place
