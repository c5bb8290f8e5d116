"""Files that are either whole or not there: what stood under the name before survives every failure."""

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
    """A binary file to write, which takes the name `path` only when the block ends without an exception.

    The bytes go to `.NAME.XXXXXXXX.tmp` in the same folder, are forced to the disk and renamed; then the folder is
    forced too. On any exception the temporary file is removed and the old file stays as it was; only a killed process
    leaves its temporary file behind. Errors of the file system (disk full, read-only or missing folder) are raised as
    InputError.
    """
    path = Path(path)
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"
    try:
        with open(temporary, "xb") as file:  # x: never through a link that somebody else put there
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        _remove(temporary)
        raise InputError(
            f"{path}: not written ({error.strerror or error}), and what was there before is unchanged; "
            "free some space or choose a folder that can be written to"
        ) from error
    except BaseException:
        _remove(temporary)
        raise
    _sync_folder(path)


def _remove(path: Path) -> None:
    with suppress(OSError):  # the folder may be missing or read-only: the first error is the one to tell
        path.unlink()


def _sync_folder(path: Path) -> None:
    """Force the new name itself to the disk, so that it survives a power cut."""
    if os.name != "posix":  # elsewhere a folder cannot be opened
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
