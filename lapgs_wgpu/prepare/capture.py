"""The whole way from films to a capture: images, poses, masks of what moves."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.masks import check_mask_folder
from lapgs_wgpu.data.readers.colmap import IMAGES, SPARSE
from lapgs_wgpu.data.timestamps import write_times
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture_folder import appearing
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.images import Picture, common_times, extract, extract_in_step, images_per_second
from lapgs_wgpu.prepare.masks import MASKS, read_masks, write_masks
from lapgs_wgpu.prepare.movers import remove_matches, solve_masked
from lapgs_wgpu.prepare.poses import Reconstruction, import_pycolmap, merged, neighbouring_pairs
from lapgs_wgpu.progress import say

TIMES = 8  # at which still cameras are compared
# Square pixels: a lens with more freedom bends until things that move seem to stand still.
LENS, FEW_CAMERAS_LENS = "RADIAL", "SIMPLE_RADIAL"  # few images do not determine more parameters
FEWEST = 0.5  # of the images need a pose
ADVICE = "film slower, with more texture and overlap, and walk around what moves instead of turning on the spot"


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
            wanted, model = len(pictures), _moving_camera(folder, [picture.name for picture in pictures], masks, work)
        placed = 0 if model is None else model.num_reg_images()
        if placed < max(2, FEWEST * wanted):
            what = "cameras" if len(films) > 1 else "images"
            raise InputError(f"{placed} of {wanted} {what} could be placed (at least half are needed): {ADVICE}.")
        write_times(folder, {picture.name: picture.seconds for picture in pictures})
        (folder / SPARSE / "0").mkdir(parents=True)
        model.write_binary(str(folder / SPARSE / "0"))
        shutil.rmtree(work)
    return Prepared(len(pictures), placed, wanted)


def _moving_camera(folder: Path, names: Sequence[str], masks: Path | None, work: Path) -> Any:
    """The pycolmap.Reconstruction, None where nothing fits together; writes masks of what moves.

    masks: the user's; None to find them.
    """
    size = check_image(folder / IMAGES / names[0], whole=False).size
    given = None if masks is None else read_masks(masks, names, size)
    reconstruction = Reconstruction(folder / IMAGES, names, work, LENS)
    reconstruction.find_features()
    reconstruction.match(neighbouring_pairs(names))
    if given is None:
        model, moving = solve_masked(reconstruction, size)
        write_masks(folder / MASKS, moving)
        return model
    with reconstruction.database() as database:
        share = remove_matches(database, given, size)
    say(f"{masks}: {share:.0%} of the matches are masked.")
    reconstruction.verify()
    write_masks(folder / MASKS, given)
    return reconstruction.solve()


def _still_cameras(images: Path, cameras: Sequence[Sequence[Picture]], fps: float, work: Path) -> Any:
    """Compare all cameras at several times. Returns the pycolmap.Reconstruction, None where nothing fits together."""
    times = [[picture.name for picture in each] for each in common_times(cameras, fps, TIMES)]
    groups = list(zip(*times, strict=True))  # of each camera
    source = Reconstruction(images, [name for group in groups for name in group], work, FEW_CAMERAS_LENS)
    source.find_features()
    source.match([pair for names in times for pair in itertools.combinations(names, 2)])
    return merged(source, groups, work / "merged").solve()
