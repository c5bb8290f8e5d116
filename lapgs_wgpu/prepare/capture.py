"""The whole way from films to a capture: frames, poses, masks of what moves, diagnosis."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.masks import check_mask_folder
from lapgs_wgpu.data.readers.colmap import IMAGES, SPARSE
from lapgs_wgpu.data.timestamps import write_times
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture_folder import appearing
from lapgs_wgpu.prepare.diagnosis import Diagnosis, diagnose
from lapgs_wgpu.prepare.extract import (
    LONGER_SIDE,
    Extraction,
    common_end,
    common_moments,
    extract,
    images_per_second,
    shortened,
)
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.masks import MASKS, read_masks, write_masks
from lapgs_wgpu.prepare.moving import World, area, remove_matches, rim, solve_world
from lapgs_wgpu.prepare.reconstruct import Reconstruction, all_pairs, import_pycolmap, merged, neighbouring_pairs
from lapgs_wgpu.prepare.report import REPORT, write_report

MOMENTS = 8  # at which still cameras are compared
# Square pixels: a lens with more freedom bends until things that move seem to stand still.
LENS, FEW_CAMERAS_LENS = "RADIAL", "SIMPLE_RADIAL"  # few images do not determine more parameters
FEWEST = 0.5  # of the images need a pose
ADVICE = "film slower, with more texture and overlap, and walk around what moves instead of turning on the spot"


@dataclass(frozen=True)
class Prepared:
    """A finished capture. images: their number. placed: cameras with a pose, of `cameras`."""

    folder: Path
    images: int
    placed: int
    cameras: int
    diagnosis: Diagnosis


def prepare(
    videos: Sequence[Path],
    out: Path,
    *,
    fps: float | None = None,
    longer_side: int = LONGER_SIDE,
    masks: Path | None = None,
) -> Prepared:
    """Make a capture of one film of a moving camera, or of the films of several cameras that stand still.

    out: a new or empty folder for images/, times.json, sparse/0, masks/ and report.html; it appears when all of it is
    there.
    fps: images a second, at most; None lets the length of the films decide. longer_side: of the images, pixels.
    masks: folder with a mask of what moves for each image of a moving camera; None to find them in the film.
    Raises InputError.
    """
    if fps is not None and not 0 < fps <= 1000:
        raise InputError(f"--fps must be above 0 and at most 1000, got {fps:g}.")
    if not 64 <= longer_side <= 8192:
        raise InputError(f"--size must be 64 to 8192 pixels, got {longer_side}.")
    if masks is not None and len(videos) > 1:
        raise InputError("--masks goes with one moving camera; cameras that stand still need no masks.")
    if masks is not None:
        check_mask_folder(masks, "each image")
    import_pycolmap()
    films = [Film(video) for video in videos]
    with appearing(out) as folder:
        extractions = extract_all(films, folder / IMAGES, fps, longer_side)
        pictures = [picture for each in extractions for picture in each.pictures]
        write_times(folder, {picture.name: picture.seconds for picture in pictures})
        still = len(films) > 1
        if still:
            model = _still_cameras(folder, extractions)
        else:
            model, moving, _ = _moving_camera(folder, extractions[0], masks)
            nothing = np.zeros(rim(films[0].size).shape, bool)  # moves
            write_masks(folder / MASKS, moving or dict.fromkeys((picture.name for picture in pictures), nothing))
        wanted = len(films) if still else len(pictures)
        placed = 0 if model is None else model.num_reg_images()
        if placed < max(2, FEWEST * wanted):
            raise InputError(
                f"{placed} of {wanted} {'cameras' if still else 'images'} could be placed (at least half are needed): "
                f"{ADVICE}."
            )
        (folder / SPARSE / "0").mkdir(parents=True)
        model.write_binary(str(folder / SPARSE / "0"))
        diagnosis = diagnose(folder)
        told = tuple(warning.replace(str(folder), str(out)) for warning in diagnosis.dataset.warnings)
        diagnosis = replace(diagnosis, folder=out, dataset=replace(diagnosis.dataset, warnings=told))
        write_report(diagnosis, folder / REPORT, out.resolve().name)
        shutil.rmtree(folder / "colmap", ignore_errors=True)
    return Prepared(out, len(pictures), placed, wanted, diagnosis)


def extract_all(films: Sequence[Film], images: Path, fps: float | None, longer_side: int) -> list[Extraction]:
    """The images of all films. Says how many, and why. Several films end with the shortest, and have one rate."""
    still = len(films) > 1
    rate = max(images_per_second(film, fps, still=still) for film in films)
    extractions = []
    for index, film in enumerate(films):
        prefix = f"cam{index:02d}/" if still else ""
        extractions.append(extract(film, images, prefix, rate, longer_side, still=still))
        say(f"{film.path}: {extractions[-1]}")
        for note in film.notes:
            say(note)
        if film.size != films[0].size:
            raise InputError(
                f"{film.path} is {film.size[0]}x{film.size[1]} pixels and {films[0].path} is "
                f"{films[0].size[0]}x{films[0].size[1]}; film with one size."
            )
    if still:
        end = common_end(extractions)
        longest = max(each.pictures[-1].seconds for each in extractions)
        if longest > end + 1 / extractions[0].fps:
            say(f"the films are {end:.2f} to {longest:.2f} s long; all are cut to {end:.2f} s.")
        extractions = [shortened(each, images, end) for each in extractions]
    return extractions


def _moving_camera(folder: Path, extraction: Extraction, masks: Path | None) -> World:
    """masks: the user's; None to find them."""
    names = [picture.name for picture in extraction.pictures]
    reconstruction = Reconstruction(folder / IMAGES, names, folder / "colmap", LENS)
    reconstruction.find_features()
    size = check_image(folder / IMAGES / names[0], whole=False).size
    given = None if masks is None else read_masks(masks, names, size)
    reconstruction.match(neighbouring_pairs(names))
    if given is None:
        return solve_world(reconstruction, size, say)
    with reconstruction.database() as database:
        share = remove_matches(database, given, size)
    say(f"{masks}: {share:.0%} of the matches are masked.")
    reconstruction.verify()
    return World(reconstruction.solve(), given, area(given))


def _still_cameras(folder: Path, extractions: Sequence[Extraction]) -> Any:
    """Compare all cameras at several moments."""
    moments = common_moments(extractions, MOMENTS)
    groups = [[picture.name for picture in of_camera] for of_camera in zip(*moments, strict=True)]
    work = folder / "colmap"
    source = Reconstruction(folder / IMAGES, [name for group in groups for name in group], work, FEW_CAMERAS_LENS)
    source.find_features()
    source.match([pair for moment in zip(*groups, strict=True) for pair in all_pairs(moment)])
    return merged(source, groups, work / "merged").solve()


def say(text: str) -> None:
    """Tell the user what was found or decided."""
    print(text, file=sys.stderr, flush=True)
