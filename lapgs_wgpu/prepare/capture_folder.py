"""The folder of a capture that is being made: one writer, and nothing in it before all of it is there."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lapgs_wgpu.data.load import READERS
from lapgs_wgpu.errors import InputError, quoted
from lapgs_wgpu.io.atomic import move
from lapgs_wgpu.io.listing import listed

UNFINISHED, FINISHED, LOCK = ".unfinished", ".finished", ".lock"


@contextmanager
def appearing(out: Path) -> Iterator[Path]:
    """A folder to write to, whose contents move to `out` if the block ends without an exception.

    The folder is made inside `out`, so `out` may be the current folder, a link or a mount. An exception removes the
    folder, and `out` too if it is new. A finished capture is never removed. Raises InputError if `out` is not empty, or
    if another process writes to it.
    """
    new = not out.exists()
    _check_empty(out)
    out.mkdir(parents=True, exist_ok=True)
    partial = out / UNFINISHED
    try:
        with _locked(out):
            _check_empty(out)
            shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
            partial.mkdir()
            try:
                yield partial
            except BaseException as error:
                shutil.rmtree(partial, ignore_errors=True)
                if isinstance(error, InputError):
                    raise InputError(str(error).replace(str(partial), str(out))) from None
                raise
            _move_up(partial, out)
    finally:
        if new:
            with suppress(OSError):  # it is not empty, unless something went wrong
                out.rmdir()


def _check_empty(out: Path) -> None:
    if out.exists() and (not out.is_dir() or {entry.name for entry in listed(out)} - {UNFINISHED, LOCK}):
        if any(reader.matches(out) for reader in READERS if out.is_dir()):
            raise InputError(
                f"{out} is a capture already; lapgs-prepare --check {quoted(out)} --train measures it and "
                "trains on it; or name a new folder with --out."
            )
        raise InputError(f"{out} is not an empty folder; name a new one with --out.")


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    from filelock import FileLock, Timeout

    lock = FileLock(out / LOCK, blocking=False)  # follows no symbolic link
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            f"{out} is being written by another lapgs-prepare; wait for it, or name another folder."
        ) from None
    try:
        yield
    finally:
        with suppress(OSError):
            (out / LOCK).unlink(missing_ok=True)
        lock.release()


def _move_up(partial: Path, out: Path) -> None:
    """Move what is finished to `out`; where that fails it stays, and the error says where."""
    held = partial
    try:
        move(partial, out / FINISHED)
        held = out / FINISHED
        for child in sorted(held.iterdir()):
            if os.path.lexists(out / child.name):
                raise FileExistsError(errno.EEXIST, f"{child.name} is there already")
            move(child, out / child.name)
        held.rmdir()
    except OSError as error:
        raise InputError(
            f"{held} holds the finished capture, which could not be moved to {out} ({error.strerror or error}); move "
            "what is in it to a folder of your choice."
        ) from None
