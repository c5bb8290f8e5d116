"""The whole way from films to a capture: images, poses, masks of what moves, and the folder in which all appears."""

import itertools
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.images import Size, check_image
from lapgs_wgpu.data.lens import Array, Lens
from lapgs_wgpu.data.readers.colmap import IMAGES, SPARSE
from lapgs_wgpu.data.timestamps import TIMES
from lapgs_wgpu.errors import InputError, quoted
from lapgs_wgpu.io.folder_lock import LOCK, locked_folder
from lapgs_wgpu.io.listing import listed
from lapgs_wgpu.prepare.calibration import match_names, read_calibration
from lapgs_wgpu.prepare.diagnosis import MASKS
from lapgs_wgpu.prepare.film import Film, Picture, extract, images_per_second
from lapgs_wgpu.prepare.inputs import open_inputs
from lapgs_wgpu.prepare.movers import RIM, Motion, cut_out, judge, read_masks, write_masks
from lapgs_wgpu.prepare.poses import Reconstruction, RefusedError, import_cv2, import_pycolmap, neighbouring_pairs
from lapgs_wgpu.prepare.report import REPORT
from lapgs_wgpu.prepare.rig import place_calibrated, place_still
from lapgs_wgpu.prepare.search import Found, again, described, longest_part, search
from lapgs_wgpu.progress import say

# Square pixels: a lens with more freedom bends until things that move seem to stand still.
LENS = "RADIAL"
FEWEST = 0.3  # of the images need a pose
LITTLE, MUCH = 0.002, 0.15  # share of the images: less motion needs no masks; more may have led the cameras astray
FEATURES, SHARED = 200, 60  # of an image; in common with the next one: wanted at least
UNFINISHED, WORK, REFUSED = ".unfinished", "work", "refused.txt"


def prepare(
    inputs: Sequence[Path],
    out: Path,
    *,
    fps: float | None = None,
    masks: Path | None = None,
    poses: Path | None = None,
    calibration: Path | None = None,
) -> None:
    """Make a capture of what one moving camera recorded, or several cameras that stand still, and say how large it is.

    inputs: films, images, folders, patterns or zip files (`open_inputs`).
    out: a new or empty folder, or one whose capture was refused; it gets the capture when all of it is there.
    fps: images a second, at most; None lets the length of the films decide.
    masks: folder with a mask of what moves for each image of a moving camera; None to find them in the film.
    poses: cameras of the images of a moving camera, by their names (`read_calibration`); None to find them.
    calibration: the same of cameras that stand still.
    Raises InputError. Where images were taken already, these, and what was found, stay in `out`.
    """
    if fps is not None and not 0 < fps <= 1000:
        raise InputError(f"--fps must be above 0 and at most 1000, got {fps:g}.")
    import_pycolmap()
    import_cv2()
    with appearing(out) as folder:
        films = open_inputs(inputs, folder / WORK)
        if len(films) > 1 and (masks or poses):
            raise InputError(f"--masks and --poses go with one moving camera, and there are {len(films)} films.")
        if len(films) == 1 and calibration:
            raise InputError("--calibration goes with several cameras; --poses gives those of one that moves.")
        rate = images_per_second(films, fps)
        if calibration is not None:
            pictures, placed = place_calibrated(films, folder, rate, calibration), len(films)
        elif len(films) > 1:
            pictures, model = place_still(films, folder / IMAGES, rate, folder / WORK)
            placed = write_model(folder, model, pictures)
        else:
            pictures = extract(films[0], folder / IMAGES, rate)
            placed = write_model(folder, _moving_camera(films[0], folder, pictures, masks, poses), pictures)
    cameras = len(films) if len(films) > 1 else len(pictures)
    say(f"{out}: {len(pictures)} images, {placed} of {cameras} cameras placed")


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


def write_model(folder: Path, model: Any, pictures: Sequence[Picture]) -> int:
    """Write times.json and a pycolmap.Reconstruction, and return the number of its images."""
    times = {picture.name: picture.seconds for picture in pictures}
    (folder / TIMES).write_text(json.dumps(times, indent=0) + "\n", encoding="utf-8")
    (folder / SPARSE / "0").mkdir(parents=True)
    model.write_binary(str(folder / SPARSE / "0"))
    return int(model.num_reg_images())


def _moving_camera(
    film: Film, folder: Path, pictures: Sequence[Picture], masks: Path | None, poses: Path | None
) -> Any:
    """The pycolmap.Reconstruction; writes masks of what moves. masks, poses: the user's; None to find them."""
    names = [picture.name for picture in pictures]
    size = check_image(folder / IMAGES / names[0], whole=False).size
    moving = None if masks is None else read_masks(masks, names, size)
    known = {} if poses is None else _known(names, poses, size)
    lenses = "SINGLE" if len({lens for lens, _ in known.values()}) < 2 else "PER_IMAGE"
    source = Reconstruction(folder / IMAGES, names, folder / WORK, "OPENCV" if known else LENS, lenses)
    source.match(neighbouring_pairs(names))
    source.verify(moving)
    found = described(source, source.given(known)) if known else search(source)
    if found is None or len(found.placed) < (0 if known else round(FEWEST * len(names))):
        raise _refusal(source, found, folder, pictures)
    if known:
        say(f"{poses}: {len(found.placed)} of {len(names)} images have cameras, {found.error:.2f} pixels off (mean).")
    if moving is None:
        motion = Motion.of_film(film, pictures)
        found = found if known else _without_movers(source, found, motion)
        moving = cut_out(motion, judge(motion, found.model, even=True))
    write_masks(folder / MASKS, moving)
    if found.pan is not None:
        turns = "stands still" if found.pan.travel < 4e-3 * max(size) else "turns on the spot"
        say(
            f"the camera {turns}: turning alone explains {found.pan.explained:.0%} of what several images show, over "
            f"{found.pan.travel:.0f} pixels. It is placed as a pan, a panorama at one depth with what moves in front; "
            "walk while you film if views from other places are wanted."
        )
    if found.held:
        say(f"the film does not tell the focal length: {found.focal / size[0]:.1f} of the width are taken.")
    if len(found.placed) < 0.9 * len(names):
        part = longest_part(names, found.placed)
        say(
            f"only a part of the film fits together: {len(found.placed)} of {len(names)} images, {len(part)} of them "
            f"in a row from {part[0]} to {part[-1]}; the training leaves out the others."
        )
    return found.model


def _known(names: Sequence[str], poses: Path, size: Size) -> dict[str, tuple[Lens, Array]]:
    """Lens and pose of the images that have a camera of their name. Raises InputError."""
    cameras = read_calibration(poses)
    found = match_names(cameras, names)
    if len(found) < 2:
        raise InputError(
            f"{poses} has {len(cameras)} cameras, such as {next(iter(cameras))[:80]}, and {len(found)} of {len(names)} "
            f"images, such as {names[0]}, have one of their name; give the images for which it was made."
        )
    return {name: (cameras[camera].lens_for(size), cameras[camera].T_cam_world) for name, camera in found.items()}


def _without_movers(source: Reconstruction, found: Found, motion: Motion) -> Found:
    """Find what moves, and place the cameras again without it.

    A reconstruction follows whatever its features agree on most, which may be what moves, in all images or in some.
    Where much of the images disagrees, one is made of their rims, and one of what disagrees; the one that explains most
    of the images' area is right.
    """
    seen = judge(motion, found.model)
    for rims in (True, False):
        if seen.moving <= MUCH or found.pan is not None:
            break
        of = "the images' rims" if rims else "what disagrees"
        say(f"{seen.moving:.0%} of the image area disagrees with these cameras: trying {of} alone.")
        source.verify(dict.fromkeys(source.names, RIM) if rims else seen.rough(turned_over=True))
        other = search(source, rival=True)
        if other is not None and len(other.placed) >= FEWEST * len(source.names):
            judged = judge(motion, other.model)
            if judged.explained(seen) > 1:
                found, seen = other, judged
    if seen.followed < 0.8:
        say(
            f"what moves could not be looked for in {1 - seen.followed:.0%} of the image area, where nothing could be "
            "followed from image to image: no mask covers that; film slower or with more light."
        )
    if seen.moving > LITTLE:
        say(f"{seen.moving:.1%} of the image area moves: masked, and the cameras are placed again.")
        other = again(source, found, seen.rough())
        if other is not None and len(other.placed) >= len(found.placed) and other.faults <= found.faults:
            judged = judge(motion, other.model)
            if judged.explained(seen) > 0.98:  # else the masks took too much
                found, seen = other, judged
    if found.pan is None and (wrong := seen.contradicted()):
        say(
            f"more than half of what {len(wrong)} of {len(source.names)} images show, from {wrong[0]} to {wrong[-1]}, "
            "does not fit their cameras, which may follow what moves: leave out that part of the film, or mask what "
            "moves (--masks)."
        )
    return found


def _refusal(source: Reconstruction, found: Found | None, folder: Path, pictures: Sequence[Picture]) -> RefusedError:
    """Why too few images have a camera; the cameras that were found are written."""
    placed = 0 if found is None else write_model(folder, found.model, pictures)
    features = np.median([len(places) for places in source.places.values()])
    verified = source.verified()
    shared = np.median([len(verified.get(pair, ())) for pair in itertools.pairwise(source.names)])
    advice = "film more of what stands still, mask what moves (--masks), or give the cameras of these images (--poses)"
    if features < FEATURES:
        advice = "film something with more texture, in focus and with more light"
    elif shared < SHARED:
        advice = "film slower, so that an image shows most of what the one before it shows"
    return RefusedError(
        f"{placed} of {len(source.names)} images could be placed (at least {FEWEST:.0%} are needed): an image has "
        f"{features:.0f} features (at least {FEATURES}), of which {shared:.0f} (at least {SHARED}) fit the next image; "
        f"{advice}."
    )
