"""The viewer's clock: where the clip goes on at its ends, whole frames, speeds."""

import pytest

from lapgs_wgpu.viewer.clock import Clock


def playing(**changes: object) -> Clock:
    """A clip of 11 frames at 10 a second: a second long."""
    return Clock(11, playing=True, fps=10.0, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("loop", "start", "seconds", "time", "goes_on"),
    [
        ("loop", 0.2, 0.5, 0.7, True),
        ("loop", 0.8, 0.5, 0.3, True),
        ("loop", 0.8, 3.5, 0.3, True),
        ("once", 0.2, 0.5, 0.7, True),
        ("once", 0.8, 0.5, 1.0, False),
        ("bounce", 0.2, 0.5, 0.7, True),
        ("bounce", 0.8, 0.5, 0.7, True),
        ("bounce", 0.8, 1.5, 0.3, True),
        ("bounce", 0.8, 2.0, 0.8, True),
    ],
)
def test_the_ends(loop: str, start: float, seconds: float, time: float, goes_on: bool) -> None:
    clock = playing(time=start, loop=loop)
    clock.advance(seconds)
    assert clock.time == pytest.approx(time)
    assert clock.playing is goes_on


def test_steps_pause_and_stop_at_the_ends() -> None:
    clock = playing(time=0.52)
    clock.step(1)
    assert (clock.time, clock.frame, clock.playing) == (pytest.approx(0.6), 6, False)
    clock.step(-1)
    assert clock.time == pytest.approx(0.5)
    clock.step(100)
    assert clock.time == 1.0
    clock.step(-100)
    assert clock.time == 0.0


def test_a_clip_that_ended_starts_anew() -> None:
    clock = Clock(11, time=1.0, loop="once")
    clock.toggle()
    assert (clock.time, clock.playing) == (0.0, True)
    clock.toggle()
    assert not clock.playing
