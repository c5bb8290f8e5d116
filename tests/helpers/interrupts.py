"""Interrupts a training, and handles signals for a while."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.step_result import StepResult


def interrupt_at(at: int, monkeypatch: pytest.MonkeyPatch, number: signal.Signals = signal.SIGINT) -> None:
    original = Log.step

    def interrupt(self: Log, result: StepResult, *rest: Any) -> None:
        original(self, result, *rest)
        if result.step == at:
            signal.raise_signal(number)

    monkeypatch.setattr(Log, "step", interrupt)


@contextmanager
def handled(number: int, handler: signal.Handlers) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)
