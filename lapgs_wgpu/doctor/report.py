"""The report of lapgs-doctor as Markdown whose columns also line up in a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from lapgs_wgpu.doctor.self_test import Line, self_test
from lapgs_wgpu.doctor.system import system_facts
from lapgs_wgpu.errors import NoAdapterError
from lapgs_wgpu.gpu.device import AdapterDetails, adapter_details

_CHECK_WIDTHS = (30, 6, 9, 9, 7)
_SPEED_WIDTHS = (66, 14)
_MIB = 1 << 20


class Report:
    """Yields the report line by line, so that what is known stays on the screen where a driver crashes.

    device_name: of the adapter to test, as `open_device` takes it; None for the default one.
    passed: whether all checks have passed, once the report is complete.
    """

    def __init__(self, device_name: str | None) -> None:
        self._device_name = device_name
        self.passed = False

    def lines(self) -> Iterator[str]:
        """The whole report. Raises NoAdapterError where `device_name` cannot be opened."""
        yield "## lapgs-doctor"
        yield ""
        facts = system_facts()
        widths = (max(map(len, facts)), 3)
        yield from _head(("", ""), widths)
        for name, text in facts.items():
            yield _row((name, text), widths)
        yield ""
        details = adapter_details()
        yield f"### Adapters ({len(details)})"
        yield ""
        for each in details:
            yield from _adapter(each)
        yield from self._self_test()

    def _self_test(self) -> Iterator[str]:
        failed, checks, broken, section = 0, 0, False, ""
        for line in self_test(self._device_name):
            kind = line["kind"]
            if kind in ("check", "speed") and kind != section:
                section = kind
                yield from _heading_of(kind)
            if kind == "check":
                checks += 1
                failed += not _passes(line)
                yield from _check(line)
            elif kind == "no adapter":
                raise NoAdapterError(line["problem"])
            elif kind == "adapter":
                yield f"### Self-test on {line['name']} ({line['backend']})"
                yield ""
            elif kind == "device":
                yield ""
                yield f"Subgroups of {line['subgroup']} lanes; {line['shape']}; {line['exchange']}."
                yield ""
            elif kind == "speed":
                value = f"{line['value']:.4g} {line['unit']}" if "value" in line else line["problem"]
                yield _row((line["name"], value), _SPEED_WIDTHS)
            elif kind == "broken":
                broken = True
                yield ""
                yield f"**The self-test did not end: {line['problem']}.**"
            elif kind == "end":
                yield ""
                yield f"{checks - failed} of {checks} checks passed, in {line['seconds']:.0f} s."
        self.passed = checks > 0 and not failed and not broken


def _adapter(details: AdapterDetails) -> Iterator[str]:
    info = details.info
    yield f"- **{info.name}**: {info.kind}, {info.backend}, {info.driver or 'driver unknown'}"
    yield f"  - features: {', '.join(details.features) or 'none of the optional ones'}"
    limits = [f"{name} {_amount(value)}" for name, value in details.limits.items()]
    yield f"  - limits: {', '.join(limits)}"
    for name, (offered, needed) in details.too_small.items():
        yield f"  - **cannot be used**: {name} is {offered}, {needed} is needed"
    yield ""


def _amount(value: int) -> str:
    return f"{value // _MIB} MiB" if value >= _MIB and value % _MIB == 0 else f"{value:,}"


def _passes(line: Line) -> bool:
    return "error" in line and line["error"] <= line["allowed"]


def _heading_of(kind: str) -> Iterator[str]:
    if kind == "check":
        yield from _head(("check", "", "error", "allowed", "s"), _CHECK_WIDTHS)
    else:
        yield from _head(("speed, median", ""), _SPEED_WIDTHS)


def _check(line: Line) -> Iterator[str]:
    """Seconds include the compilation of the kernels."""
    result = "ok" if _passes(line) else "FAILED"
    if "problem" in line:
        problem = " ".join(str(line["problem"]).split()).replace("|", "/")
        yield _row((line["name"], result, problem[:300], "", ""), _CHECK_WIDTHS)
        return
    error = f"{line['error']:.2g}" if math.isfinite(line["error"]) and line["error"] < 1e300 else "not finite"
    yield _row((line["name"], result, error, f"{line['allowed']:g}", f"{line['seconds']:.1f}"), _CHECK_WIDTHS)


def _head(cells: Sequence[str], widths: Sequence[int]) -> Iterator[str]:
    yield _row(cells, widths)
    yield _row(["-" * width for width in widths], widths)


def _row(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
