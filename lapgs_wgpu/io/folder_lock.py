"""A lock on a folder, so that one process writes to it."""

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
    lock = FileLock(out / LOCK, blocking=False)  # follows no symbolic link
    try:
        lock.acquire()
    except Timeout:
        raise InputError(f"{out} is being written by another {writer}; wait for it, or name another folder.") from None
    try:
        yield
    finally:
        with suppress(OSError):
            (out / LOCK).unlink(missing_ok=True)
        lock.release()
        if new:
            with suppress(OSError):  # it is not empty, unless something went wrong
                out.rmdir()
