"""Files that a capture names: found also as another system writes their names, and left out where they are absent."""

import os
import re
import unicodedata
from functools import cached_property
from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from lapgs_wgpu.data.images import SUFFIXES, ImageFile, check_image
from lapgs_wgpu.data.json_fields import Fields
from lapgs_wgpu.data.stamps import natural_key
from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.listing import is_desktop_file

MOST_ABSENT = 0.2  # share of the images of a capture that may be absent: whoever deletes blurred ones deletes fewer
_SMALLER = re.compile(r"(.*/)?images(_\d+)?/")  # folders of smaller images, as other programs write them


def files_below(folder: Path) -> list[str]:
    """The files below a folder but the desktop's, in natural order: relative paths with slashes. Links are followed."""
    found: list[str] = []
    entered: set[str] = set()
    for parent, folders, names in os.walk(folder, followlinks=True):
        entered.add(os.path.realpath(parent))
        folders[:] = [name for name in folders if os.path.realpath(os.path.join(parent, name)) not in entered]
        found += [Path(parent, name).relative_to(folder).as_posix() for name in names if not is_desktop_file(name)]
    return sorted(found, key=natural_key)


class CaptureFiles:
    """The files below a folder. absent: a sentence about each named image that does not exist."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.absent: list[str] = []

    def find(self, name: str) -> str | None:
        """Return the path of an existing file relative to the folder, with slashes; None if there is none.

        The name may differ from the file's in slashes, number of blanks (also %20), Unicode form, letter case, .jpeg
        for .jpg, and, where its folder does not exist, images_4 for images. Of one that leads out of the folder, as it
        was written elsewhere, or begins with the folder's own name, the end that is a file in the folder counts. The
        file whose name is the same goes before others.
        """
        path = os.path.relpath(self.folder / name, self.folder)
        if os.path.isfile(self.folder / name) and not path.startswith(".."):  # Path.is_file raises for long names
            return path.replace(os.sep, "/")
        parts = [part for part in _folded(name).split("/") if part not in ("", ".")]
        starts = [0, *[i for i, part in enumerate(parts[:-1], start=1) if part == _folded(self.folder.name)][-1:]]
        if _leads_out(name):
            starts += range(1, len(parts))
        for key in ("/".join(parts[start:]) for start in starts):
            images = _SMALLER.match(key)
            gone = images is not None and not os.path.isdir(self.folder / images[0])
            if found := self._by_name.get(key) or (self._by_name.get(_of_any_size(key)) if gone else None):
                return found
        return self.find(unquote(name)) if unquote(name) != name else None

    @cached_property
    def _by_name(self) -> dict[str, str]:
        """The files by their folded names, and by those for images of any size."""
        names = {_folded(path): path for path in reversed(files_below(self.folder))}
        return {_of_any_size(name): path for name, path in names.items()} | names

    def find_image(self, name: str, named: str) -> str | None:
        """As `find`, of an image, whose name may lack the suffix. If there is none, a sentence goes to `absent`. named:
        what names it, and as what, for errors. Raises InputError for a file that is no image."""
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
        """Return the warning about absent ones of `count` images that a file or folder names; none if all exist. Raises
        InputError if more than MOST_ABSENT are absent."""
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
            raise InputError(f"{entry.where}: {field} must be the path of a file, got {shown(name)}.")
        if _leads_out(name) and self.find(name) is None:
            raise InputError(
                f"{entry.where}: {field} {shown(name)} leads out of the scene's folder, which holds no file of this "
                "name; put the file, or a link to it, into the folder, and name that."
            )
        return name


def _leads_out(name: str) -> bool:
    """Whether a path leads out of any folder, on any system."""
    path = PureWindowsPath(name)  # which takes both slashes
    return bool(path.anchor) or ".." in PureWindowsPath(os.path.normpath(name)).parts


def _of_any_size(name: str) -> str:
    """The same name for images/x and images_4/x: /x, or a//x for those in a, which no file has."""
    return _SMALLER.sub(r"\1/", name)


def _folded(name: str) -> str:
    """The form in which names of one file agree, with slashes."""
    name = unicodedata.normalize("NFC", name).casefold().replace("\\", "/")
    folded = "/".join(" ".join(part.split()) for part in name.split("/"))
    return folded.removesuffix(".jpeg") + ".jpg" if folded.endswith(".jpeg") else folded
