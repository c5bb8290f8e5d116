"""Wall-clock times, and what a call does to the device: dispatches, bytes moved, read-backs."""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from lapgs_wgpu.gpu import array, native
from lapgs_wgpu.gpu.array import Buffer
from lapgs_wgpu.gpu.kernel import Commands


class Event(NamedTuple):
    """kind: dispatch, submit, write or read. name: of the shader, or of the buffer. nbytes: that cross over."""

    kind: str
    name: str = ""
    nbytes: int = 0


@dataclass(frozen=True)
class Timing:
    """Milliseconds of several runs. low, high: the quartiles."""

    median: float
    minimum: float
    low: float
    high: float
    runs: int


def summary(milliseconds: list[float]) -> Timing:
    low, high = np.percentile(milliseconds, (25, 75)).tolist()
    return Timing(statistics.median(milliseconds), min(milliseconds), low, high, len(milliseconds))


def timed(function: Callable[[], object], repeat: int, *, warm_up: int = 2) -> Timing:
    """The time of `function`, which has to wait for the device itself."""
    milliseconds = []
    for run in range(warm_up + repeat):
        start = time.perf_counter()
        function()
        if run >= warm_up:
            milliseconds.append(1e3 * (time.perf_counter() - start))
    return summary(milliseconds)


@dataclass(frozen=True)
class Traffic:
    """Between host and device. A read-back is one wait, however many buffers are then read.

    read_backs_before_sort: those that come before the work up to the last pass of a radix sort was submitted.
    """

    dispatches: int
    submissions: int
    uploaded_bytes: int
    downloaded_bytes: int
    read_backs: int
    read_backs_before_sort: int


def traffic(function: Callable[[], object]) -> Traffic:
    """What one call of `function` does. Nothing else may use the device meanwhile."""
    with recording() as events:
        function()
    return count(events)


def count(events: list[Event]) -> Traffic:
    """Add up what `recording` saw."""
    kinds = [event.kind for event in events]
    sorts = [i for i, event in enumerate(events) if event.name == "sort_scatter"]
    sorted_at = kinds.index("submit", sorts[-1]) if sorts else 0
    read_backs = [i for i, kind in enumerate(kinds) if kind == "read" and kinds[i - 1 : i] != ["read"]]
    return Traffic(
        dispatches=kinds.count("dispatch"),
        submissions=kinds.count("submit"),
        uploaded_bytes=sum(event.nbytes for event in events if event.kind == "write"),
        downloaded_bytes=sum(event.nbytes for event in events if event.kind == "read"),
        read_backs=len(read_backs),
        read_backs_before_sort=sum(i < sorted_at for i in read_backs),
    )


@contextmanager
def recording() -> Iterator[list[Event]]:
    """A list of all that happens, in order."""
    events: list[Event] = []
    dispatch_grid, submit, write = Commands.dispatch_grid, Commands._submit, Buffer.write

    def counted_dispatch(self: Commands, kernel: Any, groups: Any, **buffers: Any) -> None:
        if not isinstance(groups, tuple) or min(groups) > 0:
            events.append(Event("dispatch", kernel.name))
        dispatch_grid(self, kernel, groups, **buffers)

    def counted_submit(self: Commands) -> None:
        events.append(Event("submit"))
        submit(self)

    def counted_write(self: Buffer, values: Any, offset: int = 0) -> None:
        events.append(Event("write", self.label, values.nbytes))
        write(self, values, offset)

    def counted_mapping(device: Any, buffer: Any, offset: int, nbytes: int) -> Any:
        events.append(Event("read", buffer.label, nbytes))  # `array` maps for nothing else
        return native.Mapping(device, buffer, offset, nbytes)

    with (
        mock.patch.object(Commands, "dispatch_grid", counted_dispatch),
        mock.patch.object(Commands, "_submit", counted_submit),
        mock.patch.object(Buffer, "write", counted_write),
        mock.patch.object(array, "Mapping", counted_mapping),
    ):
        yield events
