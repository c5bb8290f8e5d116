"""Files that a capture names: found also as another system writes their names, and left out where they are absent."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote

from lapgs_wgpu.data.images import SUFFIXES, ImageFile, check_image
from lapgs_wgpu.data.json_fields import Fields, kind
from lapgs_wgpu.errors import InputError

MOST_ABSENT = 0.2  # share of the images of a capture that may be absent: whoever deletes blurred ones deletes fewer
_SMALLER = re.compile(r"(images)_\d+")  # folders of smaller images, as other programs write them beside images/


class CaptureFiles:
    """The files below a folder, each of whose folders is read once. `find` says how far names may differ from theirs.

    absent: a sentence about each named image that does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.absent: list[str] = []
        self._entries: dict[Path, dict[str, str]] = {}

    def find(self, name: str) -> str | None:
        """Return the path of an existing file relative to the folder, with slashes; None if there is none.

        The name may differ from the file's in slashes, number of blanks (also %20), Unicode form, letter case, .jpeg
        for .jpg, and images_4 for images. Of one that leads out of the folder, as it was written elsewhere, or begins
        with the folder's own name, the end that is a file in the folder counts. The file whose name is the same goes
        before others.
        """
        path = os.path.relpath(self.folder / name, self.folder)
        if os.path.isfile(self.folder / name) and not path.startswith(".."):  # Path.is_file raises for long names
            return path.replace(os.sep, "/")
        parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
        ends = [i for i, part in enumerate(parts[:-1], start=1) if _folded(part) == _folded(self.folder.name)][-1:]
        if _leads_out(name):
            ends += range(1, len(parts))
        found = next((found for start in (0, *ends) if (found := self._walk(parts[start:]))), None)
        return self.find(unquote(name)) if found is None and unquote(name) != name else found

    def _walk(self, parts: list[str]) -> str | None:
        at = self.folder
        if ".." in parts:
            return None
        for part in parts:
            if at not in self._entries:
                names = sorted(os.listdir(at), reverse=True) if os.path.isdir(at) else []
                self._entries[at] = {_folded(name): name for name in names}
            entries = self._entries[at]
            found = part if os.path.exists(at / part) else entries.get(_folded(part))
            if found is None and (images := _SMALLER.sub(r"\1", _folded(part))) == "images":
                found = next((entries[key] for key in sorted(entries) if _SMALLER.sub(r"\1", key) == images), None)
            if found is None:
                return None
            at = at / found
        return at.relative_to(self.folder).as_posix() if os.path.isfile(at) else None

    def find_image(self, name: str, named: str) -> str | None:
        """As `find`, of an image, whose name may lack the suffix. If there is none, a sentence goes to `absent`.

        named: what names it, and as what, for errors. Raises InputError for a file that is no image.
        """
        suffixes = ("",) if name.lower().endswith(SUFFIXES) else SUFFIXES
        found = next((found for suffix in suffixes if (found := self.find(name + suffix))), None)
        if found is None:
            if os.path.isfile(self.folder / name):
                check_image(self.folder / name)  # says what it is
            self.absent.append(f"{self.folder / (name + suffixes[0])} does not exist, but {named}")
        return found

    def image(self, entry: Fields, field: str) -> tuple[str, ImageFile] | None:
        """The path in the folder and the checked file of an entry's image; None as `find_image`. Raises InputError."""
        name = self.find_image(self._text(entry, field), f"{entry.where} names it as {field}")
        return None if name is None else (name, check_image(self.folder / name))

    def optional(self, entry: Fields, field: str) -> Path | None:
        """Return the existing file that a field names, None if the field is missing or null. Raises InputError."""
        if entry.values.get(field) is None:
            return None
        name = self._text(entry, field)
        if found := self.find(name):
            return self.folder / found
        what = f"{self.folder / name} does not exist, but {entry.where} names it as {field}"
        raise InputError(f"{what}; put it there, or remove that field.")

    def left_out(self, count: int, where: Path) -> list[str]:
        """Return the warning about absent images; none if all exist.

        count: of all images that the file or folder `where` names. Raises InputError if more than MOST_ABSENT are
        absent.
        """
        if not self.absent:
            return []
        told = f"{len(self.absent)} of {count} images of {where} are absent"
        if len(self.absent) > MOST_ABSENT * count:
            advice = "put them there, or remove what names them"
            raise InputError(f"{self.absent[0]}; {told}, and at most a fifth may be: {advice}.")
        return [f"{told}, and their frames are left out: {self.absent[0]}."]

    def _text(self, entry: Fields, field: str) -> str:
        """A path whose file, if there is one, lies below the folder; symbolic links may lead out. Raises InputError."""
        name = entry.required(field)
        if not isinstance(name, str) or not name:
            raise InputError(f"{entry.where}: {field} must be the path of a file, got {kind(name)}.")
        if _leads_out(name) and self.find(name) is None:
            raise InputError(
                f"{entry.where}: {field} {kind(name)} leads out of the scene's folder, which holds no file of this "
                "name; put the file, or a link to it, into the folder, and name that."
            )
        return name


def _leads_out(name: str) -> bool:
    """Whether a path leads out of any folder, on any system."""
    return any(
        system(name).anchor or ".." in system(os.path.normpath(name)).parts
        for system in (PurePosixPath, PureWindowsPath)
    )


def _folded(name: str) -> str:
    """The form in which names of one file agree."""
    folded = " ".join(unicodedata.normalize("NFC", name).casefold().split())
    return folded.removesuffix(".jpeg") + ".jpg" if folded.endswith(".jpeg") else folded
