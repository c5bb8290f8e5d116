"""Cameras that stand still and film together: brought into step by their sound, placed by what they see, or by a
calibration, with images of one size."""

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import Pixels, Size, shrunk_size, size_text
from lapgs_wgpu.data.readers.panoptic import FILES, IMAGES
from lapgs_wgpu.data.stamps import natural_key
from lapgs_wgpu.data.timestamps import CAMERAS
from lapgs_wgpu.data.video_frames import import_av
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.calibration import Calibrated, match_names, read_calibration
from lapgs_wgpu.prepare.film import LONGER_SIDE, Film, Frame, Picture, spans, write_image
from lapgs_wgpu.prepare.poses import Floats, Plane, Reconstruction, RefusedError, import_cv2
from lapgs_wgpu.progress import say

LENS = "SIMPLE_RADIAL"  # few images do not determine more parameters
RATE, STEP = 8000, 40  # samples of sound a second; of one value
SURE = 8.0  # standard deviations of the likeness at all shifts, by which that of the best one stands out


class Shape(NamedTuple):
    """How the frames of a camera become images of one size. shrunk: (width, height) of the frames before. cut: rows and
    columns of the shrunk frame. bent: (H, W, 2) places in the shrunk frame of the image's pixels, to undistort it."""

    shrunk: Size
    cut: tuple[slice, slice] = (slice(None), slice(None))
    bent: Plane | None = None

    def apply(self, frame: Frame) -> Pixels:
        image = frame.pixels(max(self.shrunk))
        if self.bent is None:
            return image[self.cut]
        cv2 = import_cv2()
        return cv2.remap(image, self.bent[..., 0], self.bent[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def shapes_of(films: Sequence[Film]) -> list[Shape]:
    """How each camera's frames get the size of all images. Raises InputError where that cuts off more than half."""
    sizes = [shrunk_size(film.size, LONGER_SIDE) for film in films]
    width, height = np.min(sizes, axis=0).tolist()
    shapes = []
    for film, (w, h) in zip(films, sizes, strict=True):
        w, h = shrunk_size(film.size, math.ceil(max(w, h) * max(width / w, height / h) - 1e-9))
        if width * height < 0.5 * w * h:
            raise InputError(
                f"{film.path} is {size_text(film.size)} pixels, of which {width * height / (w * h):.0%} would be left, "
                f"since all films get one size, {size_text((width, height))}; leave out those of other proportions."
            )
        left, top = (w - width) // 2, (h - height) // 2
        shapes.append(Shape((w, h), (slice(top, top + height), slice(left, left + width))))
    if len(set(sizes)) > 1:
        say(f"the films have {len(set(sizes))} sizes: all images become {size_text((width, height))} pixels.")
    return shapes


def extract_in_step(
    films: Sequence[Film], images: Path, fps: float, shapes: Sequence[Shape]
) -> list[dict[int, Picture]]:
    """Write all images of cameras that stand still, below cam00, cam01, ..., as long as the shortest film. Returns for
    each camera its images by the number of their span of time, the same in all cameras."""
    start_together(films)
    cameras = []
    for number, (film, shape) in enumerate(zip(films, shapes, strict=True)):
        firsts = ((span, next(frames)) for span, frames in spans(film, fps))
        prefix = f"cam{number:02d}/"
        pictures = {span: write_image(frame, shape.apply(frame), images, prefix) for span, frame in firsts}
        say(f"{film.path}: cam{number:02d}, {len(pictures)} images, one of each {1 / fps:.2g} s")
        cameras.append(pictures)
    last = min(map(max, cameras))
    longer = [(pictures, span) for pictures in cameras for span in pictures if span > last]
    if longer:
        say(f"the films are not equally long: all are cut to {last / fps:.2f} s.")
    for pictures, span in longer:
        (images / pictures.pop(span).name).unlink()
    return cameras


def place_still(films: Sequence[Film], images: Path, fps: float, work: Path) -> tuple[list[Picture], Any]:
    """Compare all cameras at 8 times. Returns the images and the pycolmap.Reconstruction. Raises InputError."""
    shapes = shapes_of(films)
    cameras = extract_in_step(films, images, fps, shapes)
    times = evenly(common_times(cameras), 8)
    groups = [[pictures[time].name for time in times] for pictures in cameras]
    lenses = "SINGLE" if len({shape.shrunk for shape in shapes}) == 1 else "PER_FOLDER"
    shown = {group[0]: group for group in groups}
    source = Reconstruction(images, list(shown), work, LENS, lenses)
    source.match(list(itertools.combinations(shown, 2)), shown)
    source.verify()
    model = source.solve()
    placed, least = 0 if model is None else model.num_reg_images(), max(2, len(groups) // 2)
    if placed < least:
        most = max(map(len, source.verified().values()), default=0)
        raise RefusedError(
            f"{placed} of {len(groups)} cameras could be placed (at least {least} are needed): two share {most} places "
            f"at {len(times)} times at most; put cameras between them, less than 30 degrees apart, or give where they "
            "stand (--calibration FILE)."
        )
    return [picture for pictures in cameras for picture in pictures.values()], model


def place_calibrated(films: Sequence[Film], folder: Path, fps: float, calibration: Path) -> list[Picture]:
    """Write undistorted images and cameras in Panoptic's layout: no training changes its cameras. Raises InputError."""
    if len(films) < CAMERAS:
        raise InputError(f"{len(films)} films: a calibration needs {CAMERAS} cameras, of which the first is held out.")
    cameras = _assigned(films, calibration)
    shapes = shapes_of(films)
    pinholes = []
    for i, (film, camera, shape) in enumerate(zip(films, cameras, shapes, strict=True)):
        lens = camera.lens_for(shape.shrunk, film.size)
        rows, columns = shape.cut
        width, height = columns.stop - columns.start, rows.stop - rows.start
        K = lens.pinhole(camera.where)
        K[:2, 2] -= columns.start, rows.start
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        bent = lens.project((pixels - K[:2, 2]) / K[[0, 1], [0, 1]]) - 0.5
        shapes[i] = shape._replace(bent=bent.astype(np.float32))
        pinholes.append(K.tolist())
    pictures = extract_in_step(films, folder / IMAGES, fps, shapes)
    times = common_times(pictures)
    for file, own in ((FILES["test"], slice(1)), (FILES["train"], slice(1, None))):
        table = {
            "fn": [[pictures_of[time].name for pictures_of in pictures[own]] for time in times],
            "k": [pinholes[own]] * len(times),
            "w2c": [[camera.T_cam_world.tolist() for camera in cameras[own]]] * len(times),
            "cam_id": [list(range(len(films)))[own]] * len(times),
        }
        (folder / file).write_text(json.dumps({"w": width, "h": height, **table}), encoding="utf-8")
    return [own[time] for own in pictures for time in times]


def common_times(cameras: Sequence[dict[int, Picture]]) -> list[int]:
    """The numbers of the spans of time of which all cameras have a picture, in order. Raises InputError."""
    if shared := sorted(set.intersection(*map(set, cameras))):
        return shared
    raise InputError(f"the {len(cameras)} films have no time in common; cut them to begin together.")


def _assigned(films: Sequence[Film], calibration: Path) -> list[Calibrated]:
    """The camera of each film, by its name, else by the order. Raises InputError."""
    cameras = read_calibration(calibration)
    names = [film.path.name for film in films]
    found = match_names(cameras, names)
    if not found and len(cameras) == len(films):
        found = dict(zip(sorted(names, key=natural_key), sorted(cameras, key=natural_key), strict=True))
    missing = [name for name in names if name not in found]
    if missing or len(set(found.values())) < len(films):
        raise InputError(
            f"{calibration} has {len(cameras)} cameras ({', '.join(list(cameras)[:8])}), and none of its own for "
            f"{missing[0] if missing else names[0]}; name each film as its camera."
        )
    say(f"{calibration}: " + ", ".join(f"{name} is camera {found[name]}" for name in names))
    return [cameras[found[name]] for name in names]


def start_together(films: Sequence[Film]) -> None:
    """Let all films begin at the first moment that all of them heard, else at their first frames; says which."""
    heard = [onsets(film.path) if film.path.is_file() else np.zeros(0) for film in films]
    found = [shift_of(heard[0], sound) for sound in heard]
    for film, sound, (_, likeness) in zip(films, heard, found, strict=True):
        if likeness < SURE:
            lacks = f" in common with {films[0].path.name}" if sound.any() and film is not films[0] else ""
            say(
                f"the first frames of all {len(films)} films are taken to be of one moment: {film.path.name} has no "
                f"sound{lacks}."
            )
            return
    for film, (shift, _) in zip(films, found, strict=True):
        film.start = shift - min(found)[0]
    starts = ", ".join(f"{film.path.name} at {film.start:.2f} s" for film in films)
    say(f"the films are brought into step by their sound: they begin together in {starts}.")


def onsets(path: Path) -> Floats:
    """(n,) how much louder the sound of a film becomes, RATE / STEP values a second from its first frame on; none where
    it has no sound."""
    av = import_av(path)
    wave, late = [np.zeros(STEP)], None
    try:
        with av.open(str(path), metadata_errors="replace") as file:
            picture = file.streams.video[0]
            begin = float((picture.start_time or 0) * picture.time_base)
            resampler = av.AudioResampler(format="flt", layout="mono", rate=RATE)
            for frame in file.decode(audio=0) if file.streams.audio else ():
                late = (frame.time or 0.0) - begin if late is None else late
                wave += [part.to_ndarray()[0] for part in resampler.resample(frame)]
    except (av.error.FFmpegError, OSError):
        return np.zeros(0)
    sound = np.concatenate([np.zeros(max(0, round((late or 0.0) * RATE))), *wave])
    power = np.log(np.square(sound[: len(sound) // STEP * STEP].reshape(-1, STEP)).mean(axis=1) + 1e-8)
    return np.maximum(np.diff(power), 0)


def shift_of(one: Floats, other: Floats) -> tuple[float, float]:
    """By how many seconds what is heard comes later in the other film, and by how many standard deviations the likeness
    there stands out, 0 where one has no sound."""
    from scipy.signal import correlate  # slow to import

    if not (len(one) and len(other)):
        return 0.0, 0.0
    likeness = correlate(other - other.mean(), one - one.mean())
    best = int(likeness.argmax())
    return (best - len(one) + 1) * STEP / RATE, float(likeness[best] / max(likeness.std(), 1e-12))
