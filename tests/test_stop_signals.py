"""Signals that ask a process to end."""

import signal
import threading

import pytest
from helpers.interrupts import handled

from lapgs_wgpu.run import stop_requests

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_is_a_request_until_the_block_ends(number: signal.Signals) -> None:
    with handled(number, signal.SIG_DFL):
        with stop_requests() as requested:
            assert not requested.is_set()
            signal.raise_signal(number)
            assert requested.is_set()
        assert signal.getsignal(number) == signal.SIG_DFL


def test_nohup_keeps_its_signal_away() -> None:
    with handled(signal.SIGHUP, signal.SIG_IGN), stop_requests() as requested:
        signal.raise_signal(signal.SIGHUP)
    assert not requested.is_set()


def test_the_second_one_of_a_kind_does_not_wait_for_the_step() -> None:
    """But for a terminal that closes: the system sends SIGHUP, and then the shell does."""
    with handled(signal.SIGHUP, signal.SIG_DFL), stop_requests() as requested:
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
        assert requested.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_other_threads_are_left_alone() -> None:
    entered = []

    def work() -> None:
        with stop_requests():
            entered.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert entered == [before]
