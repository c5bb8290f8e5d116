"""A disk that fails: from the n-th operation on that changes a folder, every further one ends in the same error."""

import builtins
import errno
import io
import os
from pathlib import Path
from typing import Any

import pytest

# What fails on a disk that is full, one that is broken, and one (or a folder) that may not be written to.
_WRITES = {"write", "fsync", "create", "mkdir"}
FAILING = {
    errno.ENOSPC: _WRITES,
    errno.EIO: _WRITES | {"replace"},
    errno.EROFS: _WRITES | {"replace", "unlink"},
    errno.EACCES: {"create", "mkdir", "replace", "unlink"},
}


class Disk:
    """Counts the operations on a folder that change it; from operation number `first` on (counted from 0; None: never)
    those that `code` keeps from working raise it."""

    def __init__(self, folder: Path, code: int = errno.ENOSPC, first: int | None = None) -> None:
        self.folder = str(folder.resolve())
        self.code, self.first = code, first
        self.operations: list[tuple[str, str]] = []
        self.failed = False

    def change(self, kind: str, path: Any, *, named: bool = True) -> None:
        name = os.path.abspath(os.fspath(path))
        if name != self.folder and not name.startswith(self.folder + os.sep):
            return
        number = len(self.operations)
        self.operations.append((kind, name))
        if self.first is not None and number >= self.first and kind in FAILING[self.code]:
            self.failed = True
            raise OSError(self.code, os.strerror(self.code), *([name] if named else []))

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Until `patch` is undone."""
        real_open, fsync = builtins.open, os.fsync

        def open_file(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
            if isinstance(file, int) or not set(mode) & set("wxa+"):
                return real_open(file, mode, *arguments, **options)
            self.change("create", file)
            return _File(real_open(file, mode, *arguments, **options), self, file)

        def force(descriptor: int) -> None:
            self.change("fsync", os.readlink(f"/proc/self/fd/{descriptor}"), named=False)
            fsync(descriptor)

        patch.setattr(builtins, "open", open_file)
        patch.setattr(io, "open", open_file)
        patch.setattr(os, "fsync", force)
        for name, kind in (("replace", "replace"), ("unlink", "unlink"), ("mkdir", "mkdir")):
            patch.setattr(os, name, self._checked(kind, getattr(os, name)))

    def _checked(self, kind: str, function: Any) -> Any:
        def call(path: Any, *arguments: Any, **options: Any) -> Any:
            if options.get("dir_fd") is None:
                self.change(kind, path)
            return function(path, *arguments, **options)

        return call


class _File:
    """An open file whose writes count."""

    def __init__(self, file: Any, disk: Disk, path: Any) -> None:
        self._file, self._disk, self._path = file, disk, path

    def write(self, data: Any) -> Any:
        self._disk.change("write", self._path, named=False)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "_File":
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.close()
