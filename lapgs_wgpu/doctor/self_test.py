"""The self-test, in a process of its own: where a driver crashes or hangs, the report still gets written.

The child is this module (`python -m lapgs_wgpu.doctor.self_test`), which prints a line of JSON for each result.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

SECONDS = 20.0  # from the import of torch on; later measurements are left out
_HANGING = 120.0  # seconds without a result after which the process is ended

Line = dict[str, Any]


def self_test(device_name: str | None) -> Iterator[Line]:
    """Run the self-test on an adapter, and yield each result as soon as it is there.

    A line has a "kind": "adapter" (name, backend) or "no adapter" (problem); "check" (name, and error, allowed, seconds
    or a problem); "device" (subgroup, shape, exchange); "speed" (name, and value, unit or a problem); "end" (seconds);
    or "broken" (problem), if the child ended early.
    """
    command = [sys.executable, "-m", "lapgs_wgpu.doctor.self_test", json.dumps(device_name)]
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace"
    )
    assert child.stdout is not None
    assert child.stderr is not None
    errors = list[str]()
    reader = threading.Thread(target=lambda: errors.extend(child.stderr or ()), daemon=True)
    reader.start()
    at = "its start"
    try:
        while True:
            watch = threading.Timer(_HANGING, child.kill)
            watch.start()
            text = child.stdout.readline()
            hung = not watch.is_alive()
            watch.cancel()
            if not text:
                break
            if not text.startswith("{"):  # something that a driver prints
                continue
            line = json.loads(text)
            if line["kind"] == "begin":
                at = line["name"]
            else:
                yield line
        code = child.wait()
        reader.join(1)
        if hung:
            yield {"kind": "broken", "problem": f"no result within {_HANGING:.0f} s at: {at}"}
        elif code != 0:
            last = next((text.strip() for text in reversed(errors) if text.strip()), "no message")
            yield {"kind": "broken", "problem": f"the process ended with code {_code(code)} at: {at} ({last})"}
    finally:
        child.kill()
        child.wait()


def _code(code: int) -> str:
    """Windows' codes of crashes as they are known, such as 0xc0000005."""
    return f"{code:#x}" if code > 0xFFFF else str(code)


def _run(device_name: str | None) -> None:
    _say(kind="begin", name="import of torch")
    from lapgs_wgpu.doctor.checks import CHECKS
    from lapgs_wgpu.doctor.speed import SPEEDS, measure
    from lapgs_wgpu.errors import DeviceLostError, NoAdapterError
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.gpu.probe_subgroup import subgroup_size
    from lapgs_wgpu.splat.rasterize import rasterizer_of

    start = time.perf_counter()
    _say(kind="begin", name="opening the device")
    try:
        device = open_device(device_name)
    except NoAdapterError as error:
        _say(kind="no adapter", problem=str(error))
        return
    _say(kind="adapter", name=device.info.name, backend=device.info.backend)
    _say(kind="begin", name="subgroup size")
    lanes = subgroup_size(device)
    broken = None
    for check in CHECKS:
        _say(kind="begin", name=check.name)
        line: Line = {"kind": "check", "name": check.name}
        before = time.perf_counter()
        try:
            if broken:
                raise broken
            largest = min(check.run(device), 1e300)  # JSON has no infinity
            line |= {"error": largest, "allowed": check.allowed, "seconds": time.perf_counter() - before}
        except Exception as error:
            broken = error if isinstance(error, DeviceLostError) else None
            line |= {"problem": f"{type(error).__name__}: {error}"}
        _say(**line)
    config = rasterizer_of(device).config  # after a drawing, which may have turned subgroups off
    _say(
        kind="device",
        subgroup=lanes,
        shape=f"tiles of {config.tile_width}x{config.tile_height} pixels, {config.lanes} lanes, "
        f"{'with' if config.subgroups else 'without'} subgroups"
        + "".join(f", but not in {name}" for name in sorted(config.split_passes)),
        exchange=f"{'mapped buffers' if device.mappable else 'staged copies'}, "
        f"tables in {'textures' if device.textures else 'buffers'}",
    )
    for number, speed in enumerate(SPEEDS):
        _say(kind="begin", name=speed.name)
        left = SECONDS - (time.perf_counter() - start)
        line = {"kind": "speed", "name": speed.name, "unit": speed.unit}
        if left <= 0 or broken:
            reason = "the device is lost" if broken else f"the {SECONDS:.0f} s are over"
            _say(**line, problem=f"not measured: {reason}")
            continue
        try:
            _say(**line, value=measure(speed, device, min(2.0, left / (len(SPEEDS) - number))))
        except Exception as error:
            _say(**line, problem=f"{type(error).__name__}: {error}")
    _say(kind="end", seconds=time.perf_counter() - start)


def _say(**line: Any) -> None:
    print(json.dumps(line), flush=True)


if __name__ == "__main__":
    _run(json.loads(sys.argv[1]))
