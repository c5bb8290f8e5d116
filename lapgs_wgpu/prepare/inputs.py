"""What is prepared: films, and images that a camera took one after the other; folders, patterns, zip files of both."""

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from glob import glob
from importlib import import_module
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from lapgs_wgpu.data.images import SUFFIXES, THUMBNAIL, Pixels, shrink, shrunk_size, size_text
from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.data.timestamps import TIMES, read_times
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import is_desktop_file, listed
from lapgs_wgpu.prepare.film import Film, Frame
from lapgs_wgpu.progress import say

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
IMAGE_SUFFIXES = (*SUFFIXES, *HEIC_SUFFIXES, ".avif", ".webp", ".tif", ".tiff", ".bmp")
FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp")
HEIC = "pillow_heif"  # the module that reads it
NUMBERED = 30.0  # images a second, where their names are numbers
_IFD, _FOCAL = 0x8769, 0xA405  # EXIF: the camera's tags; the focal length of a film of 35 mm


class Stills(Film):
    """Images in the order of time, as a film whose frames keep their names."""

    keeps_all = True

    def __init__(self, files: Sequence[Path]) -> None:
        """Read times and the first header. Raises InputError."""
        self.path = files[0].parent
        if len(files) < 2:
            raise InputError(f"{files[0]} is one image; give all images of the camera, or the folder that holds them.")
        files = sorted(files, key=lambda file: natural_key(file.name))
        folder = self.path if (self.path / TIMES).is_file() else self.path.parent
        times, source = read_times([ImageName(file.name) for file in files], folder)
        unit = 1.0
        if source.startswith("the frame numbers"):
            unit = 1 / NUMBERED
            say(f"{self.path}: numbers in the names count images of {NUMBERED:g} a second.")
        order = np.argsort(times, kind="stable")
        seconds = unit * (np.array(times)[order] - min(times))
        self._files = [(files[i], time) for i, time in zip(order, seconds.tolist(), strict=True)]
        steps = np.diff(seconds)
        self.seconds, self.rate = float(seconds[-1]), 1 / float(min(steps[steps > 0], default=1.0))
        self.size = _opened_image(self._files[0][0]).size

    def frames(self) -> Iterator[Frame]:
        """Decode the images. Raises InputError for one that cannot be read, or has another size than the first."""
        for file, seconds in self._files:
            image = _opened_image(file)
            if image.size != self.size:
                raise InputError(
                    f"{file} is {size_text(image.size)} pixels and {self._files[0][0]} is {size_text(self.size)}; put "
                    "the images of each camera into a folder of their own, or leave out those that differ."
                )
            gray = image.convert("L")
            gray.thumbnail((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
            yield Frame(seconds, np.asarray(gray, np.float32), partial(_pixels, image), file.stem, image.info["exif"])


def _pixels(image: Image.Image, longer_side: int) -> Pixels:
    return shrink(np.asarray(image.convert("RGB")), shrunk_size(image.size, longer_side))


def _opened_image(file: Path) -> Image.Image:
    """An image of any kind that has a reader, upright; info["exif"] keeps the focal length alone. Raises InputError."""
    with suppress(ImportError):
        import_module(HEIC).register_heif_opener()
    try:
        with Image.open(file) as image:
            focal, exif = image.getexif().get_ifd(_IFD).get(_FOCAL), Image.Exif()
            upright = ImageOps.exif_transpose(image)
            exif.get_ifd(_IFD).update({} if focal is None else {_FOCAL: focal})
            upright.info["exif"] = exif.tobytes()
            return upright
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        need = "; HEIC needs pip install pillow-heif" if file.suffix.lower() in HEIC_SUFFIXES else ""
        raise InputError(f"{file} is not a readable image ({error}); copy it again{need}.") from None


def open_inputs(paths: Sequence[Path], work: Path) -> list[Film]:
    """The cameras of films, images, folders, patterns (*.jpg) and zip files, unpacked in `work`. Raises InputError."""
    named: list[Path] = []
    for path in paths:
        found = sorted(glob(str(path)), key=natural_key) if not path.exists() else []
        named += [Path(name) for name in found] or [path]
    if named and all(_is(path, IMAGE_SUFFIXES) and path.is_file() for path in named):
        return [Stills(named)]
    return [camera for path in named for camera in _cameras(path, work)]


def _cameras(path: Path, work: Path) -> list[Film]:
    """Of one film, folder or zip file. A folder's own images go before its films, and these before its folders."""
    folder = _unpacked(path, work / path.stem) if _is(path, (".zip",)) and path.is_file() else path
    if not folder.is_dir():
        return [Film(path)]
    entries = listed(folder)
    if images := [entry for entry in entries if _is(entry, IMAGE_SUFFIXES)]:
        return [Stills(images)]
    if films := [entry for entry in entries if _is(entry, FILM_SUFFIXES)]:
        return [Film(film) for film in films]
    folders = [entry for entry in entries if entry.is_dir()]
    inside = [entry for entry in folders if entry.name == "images"] or folders
    if not inside:
        raise InputError(f"{path} holds {len(entries)} files, none of them a film or an image; name what was recorded.")
    return [camera for one in sorted(inside, key=lambda each: natural_key(each.name)) for camera in _cameras(one, work)]


def _unpacked(path: Path, folder: Path) -> Path:
    """The films and images of a zip file in a new folder. Raises InputError."""
    folder.mkdir(parents=True)
    try:
        with zipfile.ZipFile(path) as file:
            names = [name for name in file.namelist() if _is(Path(name), IMAGE_SUFFIXES + FILM_SUFFIXES)]
            file.extractall(folder, names)
    except (zipfile.BadZipFile, RuntimeError, OSError) as error:
        raise InputError(f"{path} cannot be unpacked ({error}); copy it again, or unpack it yourself.") from None
    return folder


def _is(path: Path, suffixes: Sequence[str]) -> bool:
    hidden = is_desktop_file(path.name) or "__MACOSX" in path.parts
    return path.suffix.lower() in suffixes and not hidden
