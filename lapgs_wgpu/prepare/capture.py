"""The whole way from films to a capture: images, poses, masks of what moves."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lapgs_wgpu.data.images import Size, check_image
from lapgs_wgpu.data.masks import Mask, check_mask_folder
from lapgs_wgpu.data.readers.colmap import IMAGES, SPARSE
from lapgs_wgpu.data.timestamps import write_times
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture_folder import appearing
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.flow import Motion, film_frames
from lapgs_wgpu.prepare.images import Picture, common_times, extract, extract_in_step, images_per_second
from lapgs_wgpu.prepare.masks import MASKS, read_masks, write_masks
from lapgs_wgpu.prepare.movers import cut_out, judge, rim, without
from lapgs_wgpu.prepare.poses import (
    Match,
    Reconstruction,
    import_cv2,
    import_pycolmap,
    merged,
    neighbouring_pairs,
)
from lapgs_wgpu.prepare.search import Found, again, longest_part, search
from lapgs_wgpu.progress import say

TIMES = 8  # at which still cameras are compared
# Square pixels: a lens with more freedom bends until things that move seem to stand still.
LENS, FEW_CAMERAS_LENS = "RADIAL", "SIMPLE_RADIAL"  # few images do not determine more parameters
FEWEST, WHOLE = 0.3, 0.9  # of the images need a pose; of fewer than this only a part of the film fits
LITTLE, MUCH = 0.002, 0.1  # share of the images: less motion needs no masks; more may have led the cameras astray
FOLLOWED, UNKNOWN = 0.8, 0.2  # share of the image area where flow must tell whether it moves; less makes no masks
STANDING = 4e-3  # of the longer side: the image of a camera that stands still moves less over the film
FEATURES, SHARED = 200, 60  # of an image; in common with the next one: fewer say why cameras are not found


class Prepared(NamedTuple):
    """A finished capture: the number of its images; of its cameras that have a pose; and of all its cameras."""

    images: int
    placed: int
    cameras: int


def prepare(videos: Sequence[Path], out: Path, *, fps: float | None = None, masks: Path | None = None) -> Prepared:
    """Make a capture of one film of a moving camera, or of the films of several cameras that stand still.

    out: a new or empty folder for images/, times.json, sparse/0 and masks/; it appears when all of it is there.
    fps: images a second, at most; None lets the length of the films decide.
    masks: folder with a mask of what moves for each image of a moving camera; None to find them in the film.
    Raises InputError.
    """
    if fps is not None and not 0 < fps <= 1000:
        raise InputError(f"--fps must be above 0 and at most 1000, got {fps:g}.")
    if masks is not None and len(videos) > 1:
        raise InputError("--masks goes with one moving camera; cameras that stand still need no masks.")
    if masks is not None:
        check_mask_folder(masks, "each image")
    import_pycolmap()
    import_cv2()
    films = [Film(video) for video in videos]
    rate = images_per_second(films, fps)
    with appearing(out) as folder:
        work = folder / "colmap"
        if len(films) > 1:
            cameras = extract_in_step(films, folder / IMAGES, rate)
            pictures = [picture for camera in cameras for picture in camera]
            wanted, model = len(films), _still_cameras(folder / IMAGES, cameras, rate, work)
        else:
            pictures = extract(films[0], folder / IMAGES, rate)
            wanted, model = len(pictures), _moving_camera(films[0], folder, pictures, masks, work)
        placed = model.num_reg_images()
        write_times(folder, {picture.name: picture.seconds for picture in pictures})
        (folder / SPARSE / "0").mkdir(parents=True)
        model.write_binary(str(folder / SPARSE / "0"))
        shutil.rmtree(work)
    return Prepared(len(pictures), placed, wanted)


def _moving_camera(film: Film, folder: Path, pictures: Sequence[Picture], masks: Path | None, work: Path) -> Any:
    """The pycolmap.Reconstruction; writes masks of what moves. masks: the user's; None to find them."""
    names = [picture.name for picture in pictures]
    size = check_image(folder / IMAGES / names[0], whole=False).size
    given = None if masks is None else read_masks(masks, names, size)
    source = Reconstruction(folder / IMAGES, names, work, LENS)
    matches = source.match(neighbouring_pairs(names), source.find_features())
    if given is not None:
        rest = without(matches, source.places, given, size)
        before, after = (sum(map(len, each.values())) for each in (matches, rest))
        say(f"{masks}: {1 - after / max(before, 1):.0%} of the matches are masked.")
        source.use(rest)
    found = search(source, size)
    found = _checked(source, found, size)
    if given is None:
        motion = Motion(film_frames(film, pictures), len(pictures))
        found, given = _without_movers(source, found, motion, matches, size)
    write_masks(folder / MASKS, given)
    if found.pan is not None:
        say(
            f"the camera turns on the spot: turning alone explains {found.pan.explained:.0%} of what several images "
            f"show, over {found.pan.travel:.0f} pixels. It is placed as a pan: a panorama at one depth, what moves in "
            "front of it. Walk while you film if views from other places are wanted."
        )
    elif len(found.placed) < WHOLE * len(names):
        part = longest_part(names, found.placed, 2)
        say(
            f"only a part of the film fits together: {len(found.placed)} of {len(names)} images, {len(part)} of them "
            f"in a row from {part[0]} to {part[-1]}; the training leaves out the others."
        )
    return found.model


def _without_movers(
    source: Reconstruction, found: Found, motion: Motion, matches: Match, size: Size
) -> tuple[Found, dict[str, Mask]]:
    """Find what moves, and place the cameras again without it.

    A reconstruction follows whatever its features agree on most, which may be what moves. Where much of the images
    disagrees, one is made of their rims alone, and the one that explains more of the images' area is right.
    """
    seen = judge(motion, source.names, found.model)
    if seen.moving > MUCH and found.pan is None:
        say(f"{seen.moving:.0%} of the image area disagrees with the first cameras: trying the images' rims alone.")
        source.use(without(matches, source.places, dict.fromkeys(source.names, rim()), size))
        other = search(source, size)
        if other is not None and len(other.placed) >= FEWEST * len(source.names):
            judged = judge(motion, source.names, other.model)
            limit = min(seen.noise, judged.noise)  # what is nearly rigid fits a wrong reconstruction nearly
            if judged.still(limit) > seen.still(limit):
                found, seen = other, judged
    if seen.followed < FOLLOWED:
        say(
            f"what moves could not be looked for in {1 - seen.followed:.0%} of the image area, where nothing could be "
            "followed from image to image: no mask covers that; film slower or with more light."
        )
    if seen.moving > LITTLE:
        say(f"{seen.moving:.1%} of the image area moves: masked, and the cameras are placed again.")
        other = again(source, found, matches, seen.rough(source.names), size)
        kept = other is not None and len(other.placed) >= len(found.placed) and len(other.faults) <= len(found.faults)
        if other is not None and kept:  # else the masks took too much
            found, seen = other, judge(motion, source.names, other.model)
    return found, cut_out(motion, source.names, seen) if seen.followed > UNKNOWN else {}


def _checked(source: Reconstruction, found: Found | None, size: Size) -> Found:
    """Raises InputError where too few images have a pose, and for a camera that neither walks nor turns."""
    placed, least = len(found.placed) if found else 0, max(2, round(FEWEST * len(source.names)))
    if found is None or placed < least:
        features = int(np.median([len(places) for places in source.places.values()]))
        verified = source.verified()
        shared = int(np.median([len(verified.get(pair, ())) for pair in itertools.pairwise(source.names)]))
        advice = "film more of what stands still, or mask what moves (--masks)"
        if features < FEATURES:
            advice = "film something with more texture, in focus and with more light"
        elif shared < SHARED:
            advice = "film slower, so that an image shows most of what the one before it shows"
        raise InputError(
            f"{placed} of {len(source.names)} images could be placed (at least {least} are needed): an image has "
            f"{features} features, of which {shared} fit the next image (medians); {advice}."
        )
    if found.pan is not None and found.pan.travel < STANDING * max(size):
        raise InputError(
            f"the camera stands still: its image moves by {found.pan.travel:.1f} pixels over the film (at least "
            f"{STANDING * max(size):.1f} are needed), so nothing tells how far away anything is; walk around what "
            "moves, or film it with several cameras at once."
        )
    return found


def _still_cameras(images: Path, cameras: Sequence[Sequence[Picture]], fps: float, work: Path) -> Any:
    """Compare all cameras at several times. Returns the pycolmap.Reconstruction. Raises InputError."""
    times = [[picture.name for picture in each] for each in common_times(cameras, fps, TIMES)]
    groups = list(zip(*times, strict=True))  # of each camera
    names = [name for group in groups for name in group]
    source = Reconstruction(images, names, work, FEW_CAMERAS_LENS)
    pairs = [pair for names in times for pair in itertools.combinations(names, 2)]
    matches = source.match(pairs, source.find_features())
    model = merged(source, matches, groups, work / "merged").solve()
    placed, least = 0 if model is None else model.num_reg_images(), max(2, len(groups) // 2)
    if placed < least:
        raise InputError(
            f"{placed} of {len(groups)} cameras could be placed (at least {least} are needed): put them closer "
            "together, so that neighbours show the same things from sides that differ by less than 30 degrees."
        )
    return model
