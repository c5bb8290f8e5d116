"""Two results of `make bench`, set against each other."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple


class Row(NamedTuple):
    """name: the place in the results. ratio: of the new median to the old one. beyond: the spreads, from one quartile
    of the runs to the other, do not touch."""

    name: str
    old: float
    new: float
    ratio: float
    beyond: bool


def compare(old: Path, new: Path) -> str:
    """A table of what both have, worst first, below what differs between the machines."""
    before, after = (json.loads(file.read_text(encoding="utf-8")) for file in (old, new))
    lines = []
    for key in before["machine"].keys() | after["machine"].keys():
        values = [str(results["machine"].get(key, "-")) for results in (before, after)]
        if values[0] != values[1]:
            lines.append(f"{key}: {values[0]} -> {values[1]}")
    lines.sort()
    found = rows(before, after)
    width = max((len(row.name) for row in found), default=0)
    lines.append(f"{'':{width}}{'old':>10}{'new':>10}{'new / old':>11}   milliseconds; * beyond the spread of the runs")
    lines += [f"{r.name:{width}}{r.old:10.2f}{r.new:10.2f}{r.ratio:11.2f}{' *' if r.beyond else ''}" for r in found]
    paths = [dict(timings(results)).keys() for results in (before, after)]
    lines += [f"only in {file}: {name}" for file, name in _alone(old, new, *paths)]
    return "\n".join(lines)


def rows(before: dict[str, Any], after: dict[str, Any]) -> list[Row]:
    """What both have, worst first."""
    old, new = dict(timings(before)), dict(timings(after))
    found = []
    for name in old.keys() & new.keys():
        a, b = old[name], new[name]
        beyond = a["high"] < b["low"] or b["high"] < a["low"]
        found.append(Row(name, a["median"], b["median"], b["median"] / a["median"], beyond))
    return sorted(found, key=lambda row: (-row.ratio, row.name))


def timings(results: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, dict[str, float]]]:
    """Each time in the results, by the names on the way to it."""
    if isinstance(results, dict):
        if {"median", "low", "high"} <= results.keys():
            yield " / ".join(part for part in place if part not in ("passes", "milliseconds")), results
        else:
            for name, value in results.items():
                yield from timings(value, (*place, name))


def _alone(old: Path, new: Path, in_old: Any, in_new: Any) -> Iterator[tuple[Path, str]]:
    yield from ((old, name) for name in sorted(in_old - in_new))
    yield from ((new, name) for name in sorted(in_new - in_old))
