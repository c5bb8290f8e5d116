"""A lock on a folder, so that one process writes to it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lapgs_wgpu.errors import InputError

LOCK = ".lock"  # file in a locked folder


@contextmanager
def locked_folder(out: Path, writer: str = "lapgs-train") -> Iterator[None]:
    """Create the folder if needed and lock it for one writer, a command; a folder that stays empty is removed again.
    Raises InputError if another process holds the lock."""
    from filelock import FileLock, Timeout

    new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    path, lock = out / LOCK, FileLock(out / LOCK, blocking=False)  # follows no symbolic link
    try:
        lock.acquire()
    except Timeout:
        who = ""
        with suppress(OSError):
            who = path.read_text(encoding="ascii", errors="replace")[:20].strip()
        raise InputError(
            f"{out} is being written by another {writer} (process {who if who.isdecimal() else 'unknown'}); wait "
            "for it, or name another folder."
        ) from None
    try:
        with suppress(OSError), open(path, "w", opener=_open_no_follow) as file:  # the disk may be full
            file.write(str(os.getpid()))
        yield
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        lock.release()
        if new:
            with suppress(OSError):  # it is not empty, unless something went wrong
                out.rmdir()


def _open_no_follow(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)
