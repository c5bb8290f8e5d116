"""Duration of each pass, from timestamps that the device writes."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import wgpu

from lapgs_wgpu.gpu import native
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device


class Profile:
    """Measures each dispatch that is submitted while it is `running`; each then gets a compute pass of its own.

    capacity: maximum number of dispatches between two calls of `read`. Raises RuntimeError if the device has no
    timestamps.
    """

    def __init__(self, device: Device, capacity: int = 1024) -> None:
        if "timestamp-query" not in device.features:
            raise RuntimeError(
                f"{device.info.name} has no timestamps (feature timestamp-query): passes cannot be timed"
            )
        self.capacity = capacity
        self._names: list[str] = []
        self._queries = device.wgpu_device.create_query_set(type="timestamp", count=2 * capacity)
        resolve = wgpu.BufferUsage.QUERY_RESOLVE | wgpu.BufferUsage.COPY_SRC
        self._resolved = device.wgpu_device.create_buffer(label="timestamps", size=16 * capacity, usage=resolve)
        self._ticks = DeviceArray.empty(device, "timestamps to read", (capacity, 2), "uint64")
        self._tick_nanoseconds = _timestamp_period(device)

    @contextmanager
    def running(self) -> Iterator[None]:
        """What is submitted within is measured."""
        with mock.patch.object(native, "play", self._play):
            yield

    def _play(self, encoder: Any, commands: list[native.Command], play: Any = native.play) -> None:
        for command in commands:
            if command[0] != "dispatch":
                play(encoder, [command])
                continue
            kernel, group, columns, rows = command[1:]
            first = 2 * len(self._names)
            if len(self._names) == self.capacity:
                raise RuntimeError(f"a Profile of {self.capacity} dispatches is full: read() it earlier, or enlarge it")
            self._names.append(kernel.name)
            writes = {"beginning_of_pass_write_index": first, "end_of_pass_write_index": first + 1}
            timed = encoder.begin_compute_pass(timestamp_writes={"query_set": self._queries, **writes})
            timed.set_pipeline(kernel.pipeline)
            timed.set_bind_group(0, group)
            timed.dispatch_workgroups(columns, rows)
            timed.end()
        count = 2 * len(self._names)
        if count:
            encoder.resolve_query_set(self._queries, 0, count, self._resolved, 0)
            encoder.copy_buffer_to_buffer(self._resolved, 0, self._ticks.buffer.wgpu_buffer, 0, 8 * count)

    def read(self) -> list[tuple[str, float]]:
        """Name and milliseconds of each dispatch, in order. Waits for the device, and empties the profile."""
        if not self._names:
            return []
        ticks = self._ticks.rows(0, len(self._names)).read()
        # Subtract first: a timestamp has more digits than a float. WebGPU lets clocks go back.
        elapsed = np.maximum((ticks[:, 1] - ticks[:, 0]).view(np.int64), 0)
        milliseconds = elapsed.astype(np.float64) * self._tick_nanoseconds * 1e-6
        names, self._names = self._names, []
        return list(zip(names, milliseconds.tolist(), strict=True))


def _timestamp_period(device: Device) -> float:
    """Return the nanoseconds per tick of a timestamp, which is 1 on most devices. wgpu-py does not expose it."""
    from wgpu.backends.wgpu_native import lib

    return float(lib.wgpuQueueGetTimestampPeriod(device.queue._internal))
