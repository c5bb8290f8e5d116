"""Find the image files that a capture names, also as another system writes their names, and leave out absent ones."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from lapgs_wgpu.errors import InputError

MOST_ABSENT = 0.2  # share of the images of a capture that may be absent: whoever deletes blurred ones deletes fewer
_SMALLER = re.compile(r"(images)_\d+")  # folders of smaller images, as other programs write them beside images/


class ImageFinder:
    """Finds images below a folder. It reads each folder inside once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._entries: dict[Path, dict[str, str]] = {}

    def find(self, name: str) -> str | None:
        """Return the path of an existing image relative to the folder, with slashes; None if there is none.

        The name may differ from the file's in slashes, number of blanks, Unicode form, letter case, .jpeg for .jpg, and
        images_4 for images. The file whose name is the same goes before others.
        """
        if os.path.isfile(self.folder / name):  # Path.is_file raises for names that are too long
            return name
        at = self.folder
        for part in name.replace("\\", "/").split("/"):
            if part in ("", "."):
                continue
            entries = self._folded_entries(at)
            found = entries.get(_folded(part)) if not os.path.exists(at / part) else part
            if found is None and (images := _SMALLER.sub(r"\1", _folded(part))) == "images":
                found = next((entries[key] for key in sorted(entries) if _SMALLER.sub(r"\1", key) == images), None)
            if found is None:
                return None
            at = at / found
        return at.relative_to(self.folder).as_posix() if os.path.isfile(at) else None

    def _folded_entries(self, folder: Path) -> dict[str, str]:
        if folder not in self._entries:
            names = sorted(os.listdir(folder), reverse=True) if os.path.isdir(folder) else []
            self._entries[folder] = {_folded(name): name for name in names}
        return self._entries[folder]


def _folded(name: str) -> str:
    """The form in which names of one file agree."""
    folded = " ".join(unicodedata.normalize("NFC", name).casefold().split())
    return folded.removesuffix(".jpeg") + ".jpg" if folded.endswith(".jpeg") else folded


def check_absent(absent: Sequence[str], count: int, where: Path) -> list[str]:
    """Return the warning about images that `where` names and that do not exist; none if all do.

    absent: a sentence about each, that says which file is named where. count: of all named images. Raises InputError if
    more than MOST_ABSENT are absent.
    """
    if not absent:
        return []
    first = absent[0].removesuffix(".")
    if len(absent) > MOST_ABSENT * count:
        raise InputError(f"{first}; {len(absent)} of {count} images are absent, and at most a fifth may be.")
    return [f"{len(absent)} of {count} images of {where} are absent, and their frames are left out: {first}."]
