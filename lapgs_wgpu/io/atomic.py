"""Write files atomically: a failed write leaves the previous file unchanged."""

import os
import secrets
import shutil
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
        raise InputError(
            f"{path}: not written ({error.strerror or error}), and what was there before is unchanged; "
            "free some space or choose a folder that can be written to"
        ) from error
    finally:
        with suppress(OSError):  # it has the file's name by now, or the folder may be missing or read-only
            temporary.unlink()
    with suppress(OSError):  # some file systems force no folder, and Windows opens none
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextmanager
def new_folder(folder: Path, advice: str = "make room there, or name another") -> Iterator[Path]:
    """A folder to fill, which takes the name `folder` when the block ends without an exception.

    `folder` must not exist, or be empty; where another process made it meanwhile, that one stays. Raises InputError,
    which ends with the advice, on errors of the file system.
    """
    unfinished = folder.with_name(f"{folder.name}.{secrets.token_hex(4)}.partial")
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        with suppress(OSError):
            folder.rmdir()  # it is empty
        if not folder.exists():
            os.replace(unfinished, folder)
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror or error}); {advice}.") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
