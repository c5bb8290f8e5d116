"""Interrupts a training, and handles signals for a while."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.step_result import StepResult


def after_step(at: int, what: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a run do this when it has logged a step."""
    original = Log.step

    def step(self: Log, result: StepResult, *rest: Any) -> None:
        original(self, result, *rest)
        if result.step == at:
            what()

    monkeypatch.setattr(Log, "step", step)


def interrupt_at(at: int, monkeypatch: pytest.MonkeyPatch, number: signal.Signals = signal.SIGINT) -> None:
    after_step(at, lambda: signal.raise_signal(number), monkeypatch)


@contextmanager
def handled(number: int, handler: signal.Handlers) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)
