"""Signals that ask a process to end."""

from __future__ import annotations

import signal
import threading

import pytest
from helpers.interrupts import handled

from lapgs_wgpu.run import _interruptible
from lapgs_wgpu.stop_signals import on_stop_signals

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.mark.parametrize("number", SIGNALS)
def test_the_handler_is_called_until_the_block_ends(number: signal.Signals) -> None:
    taken = []
    with handled(number, signal.SIG_DFL):
        with on_stop_signals(lambda number, frame: taken.append(number)):
            signal.raise_signal(number)
        assert signal.getsignal(number) == signal.SIG_DFL
    assert taken == [number]


def test_a_terminal_that_closes_counts_once() -> None:
    """The system sends SIGHUP, and then the shell does."""
    taken = []
    with handled(signal.SIGHUP, signal.SIG_DFL):
        with on_stop_signals(lambda number, frame: taken.append(number)):
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL
    assert taken == [signal.SIGHUP, signal.SIGTERM]


def test_nohup_keeps_its_signal_away() -> None:
    taken = []
    with handled(signal.SIGHUP, signal.SIG_IGN), on_stop_signals(lambda number, frame: taken.append(number)):
        signal.raise_signal(signal.SIGHUP)
    assert not taken


def test_the_second_one_of_a_kind_does_not_wait_for_the_step() -> None:
    with handled(signal.SIGHUP, signal.SIG_DFL), _interruptible() as interrupted:
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
        assert interrupted.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_other_threads_are_left_alone() -> None:
    entered = []

    def work() -> None:
        with on_stop_signals(lambda number, frame: None):
            entered.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert entered == [before]
