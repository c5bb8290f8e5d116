"""Interrupts a training."""

from __future__ import annotations

import signal
from typing import Any

import pytest

from lapgs_wgpu.train.log import Log


def interrupt_at(at: int, monkeypatch: pytest.MonkeyPatch, number: signal.Signals = signal.SIGINT) -> None:
    original = Log.step

    def interrupt(self: Log, step: int, *rest: Any) -> None:
        original(self, step, *rest)
        if step == at:
            signal.raise_signal(number)

    monkeypatch.setattr(Log, "step", interrupt)
