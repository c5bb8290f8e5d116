"""The signals that ask a process to end."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # Ctrl-C, kill, a terminal that closes, Windows' Ctrl-Break


@contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """An event that these signals set until the block ends, instead of an exception in the middle of a step.

    The second one of a kind raises KeyboardInterrupt, but for SIGHUP: a shell repeats what the system has sent. Where
    SIGHUP is ignored (as by nohup) it stays so. Outside the main thread, which alone may listen to signals, nothing
    happens.
    """
    hangup = getattr(signal, "SIGHUP", None)
    requested, seen = threading.Event(), set[int]()

    def take(number: int, frame: FrameType | None) -> None:
        if number in seen and number != hangup:
            raise KeyboardInterrupt
        seen.add(number)
        requested.set()

    before = {}
    with suppress(ValueError):
        for number in (getattr(signal, name) for name in _NAMES if hasattr(signal, name)):
            if number != hangup or signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, take)
    try:
        yield requested
    finally:
        for number, own in before.items():
            signal.signal(number, own)
