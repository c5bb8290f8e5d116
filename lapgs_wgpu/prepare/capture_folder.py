"""The folder of a capture that is being made: one writer, and nothing in it before all of it is there."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lapgs_wgpu.data.readers.colmap import IMAGES, SPARSE
from lapgs_wgpu.data.timestamps import TIMES
from lapgs_wgpu.errors import InputError, quoted
from lapgs_wgpu.io.folder_lock import LOCK, locked_folder
from lapgs_wgpu.io.listing import listed

REPORT, MASKS = "report.html", "masks"

UNFINISHED, WORK, REFUSED = ".unfinished", "work", "refused.txt"


class RefusedError(InputError):
    """Too few cameras could be placed. What was found stays."""


@contextmanager
def appearing(out: Path) -> Iterator[Path]:
    """A folder to write to, whose contents move to `out` if the block ends without an exception.

    The folder is made inside `out`, so `out` may be the current folder, a link or a mount. An exception removes the
    folder, and `out` too if it is new. Raises InputError if `out` is not empty, if another process writes to it, or if
    the contents cannot be moved: then they stay, and the error says where. What a refused capture left in `out` is
    replaced, and stays until then.
    """
    partial, refused = out / UNFINISHED, ""
    with locked_folder(out, "lapgs-prepare"):
        if not (out / REFUSED).is_file() and {entry.name for entry in listed(out)} - {UNFINISHED, LOCK}:
            raise InputError(
                f"{out} is not empty; name a new folder with --out, or, if it is a capture, measure it by "
                f"lapgs-prepare --check {quoted(out)}, with --train to train on it."
            )
        shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
        partial.mkdir()
        try:
            yield partial
        except RefusedError as error:
            refused = str(error)
            (partial / REFUSED).write_text(refused, encoding="utf-8")
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        try:
            shutil.rmtree(partial / WORK, ignore_errors=True)
            if (out / REFUSED).is_file():
                for name in (IMAGES, SPARSE, TIMES, MASKS, REPORT, REFUSED):
                    shutil.rmtree(out / name) if (out / name).is_dir() else (out / name).unlink(missing_ok=True)
            for child in sorted(partial.iterdir()):
                child.replace(out / child.name)
            partial.rmdir()
        except OSError as error:
            raise InputError(
                f"{partial} holds the finished capture, which could not be moved to {out} ({error.strerror or error}); "
                "move what is in it to a folder of your choice."
            ) from None
        if refused:
            raise RefusedError(
                f"{refused} Images and what was found stay in {out}: the same command goes on there, with --masks or "
                "--poses for these images if you have any."
            )
