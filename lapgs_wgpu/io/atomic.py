"""Write files atomically: a failed write leaves the previous file unchanged."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from lapgs_wgpu.errors import InputError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a binary file for writing that replaces `path` when the block ends without an exception.

    The bytes go to `.NAME.XXXXXXXX.tmp` in the same folder, which is synced to disk and renamed; then the folder is
    synced. On any exception the temporary file is removed and the old file is unchanged; only a killed process leaves
    its temporary file behind. Raises InputError on errors of the file system (disk full, read-only or missing folder).
    """
    path = Path(path)
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"
    try:
        with open(temporary, "xb") as file:  # x: do not follow a symbolic link that another user created
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        _remove(temporary)
        if not path.parent.exists():
            raise InputError(f"{path}: not written, since the folder {path.parent} does not exist; make it.") from error
        raise InputError(
            f"{path}: not written ({error.strerror or error}), and what was there before is unchanged; "
            "free some space or choose a folder that can be written to"
        ) from error
    except BaseException:
        _remove(temporary)
        raise
    _sync_folder(path)


def _remove(path: Path) -> None:
    with suppress(OSError):  # the folder may be missing or read-only; report the first error
        path.unlink()


def _sync_folder(path: Path) -> None:
    """Sync the folder to disk, so that the new name survives a power cut."""
    if os.name != "posix":  # other systems cannot open a folder
        return
    try:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise InputError(
            f"{path}: written, but its folder could not be forced to the disk ({error.strerror or error}), "
            "so a power cut may bring the old file back; check the disk"
        ) from error
