"""The signals that ask a process to end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # Ctrl-C, kill, a terminal that closes, Windows' Ctrl-Break


@contextmanager
def on_stop_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call `handler` for them until the block ends; the signals' own handlers then come back.

    SIGHUP stays ignored where it is (as by nohup), and counts once: a shell repeats what the system has sent. Outside
    the main thread, which alone may listen to signals, nothing happens.
    """
    hangup = getattr(signal, "SIGHUP", None)

    def take(number: int, frame: FrameType | None) -> None:
        if number == hangup:
            signal.signal(number, signal.SIG_IGN)
        handler(number, frame)

    before = {}
    with suppress(ValueError):
        for number in (getattr(signal, name) for name in _NAMES if hasattr(signal, name)):
            if number != hangup or signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, take)
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)
