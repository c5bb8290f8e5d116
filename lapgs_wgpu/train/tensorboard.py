"""TensorBoard: the lines of log.jsonl as scalars, by its own package (the extra `tensorboard`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lapgs_wgpu.errors import InputError, pip_install


def check_tensorboard() -> None:
    """Raises InputError where the package is missing."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError:
        raise InputError(
            f"eval.tensorboard needs the package tensorboard: {pip_install('tensorboard')}, or leave it out; "
            "log.jsonl has the same figures."
        ) from None


class TensorBoard:
    """A listener of `Log`. folder: of the event files; those of steps after `done` are hidden. Raises InputError."""

    def __init__(self, folder: Path, *, done: int) -> None:
        check_tensorboard()
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=done + 1 if done else None)

    def __call__(self, line: Mapping[str, Any]) -> None:
        """Take in a line of log.jsonl."""
        for name, value in scalars(line):
            self._writer.add_scalar(name, value, line["step"])
        self._writer.flush()


def scalars(line: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Name and value of each number of a line of log.jsonl but the step; those of tables as table/name, of lists as
    list/00."""
    for name, value in line.items():
        if isinstance(value, Mapping):
            yield from scalars(value, f"{prefix}{name}/")
        elif isinstance(value, list):
            yield from ((f"{prefix}{name}/{i:02d}", float(each)) for i, each in enumerate(value))
        elif isinstance(value, int | float) and (prefix or name != "step"):
            yield prefix + name, float(value)
