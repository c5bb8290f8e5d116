"""Camera poses by structure from motion with pycolmap: features, matches, and cameras that explain them."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.errors import InputError, pip_install
from lapgs_wgpu.progress import Progress

FEATURE_SIDE = 1600  # longer side, pixels: larger images are shrunk to find features
MOST_FEATURES = 3000  # of an image, those of the largest scales; the time of matching grows with their square
NEIGHBOURS = 6  # an image is matched with so many after it, then with ever more distant ones, each further by GROWTH
GROWTH = 1.5
EXTRACTED_AT_ONCE, MATCHED_AT_ONCE = 8, 64  # images and pairs between two updates of the progress
FEWEST_IMAGES = 2  # of a reconstruction
SEED = 0
Pair = tuple[str, str]


class Reconstruction:
    """Structure from motion over images that share one lens.

    images: the folder of all images. names: of those to use, below it, in the order of time. work: folder for the
    database. model: COLMAP's name for the lens.
    """

    def __init__(self, images: Path, names: Sequence[str], work: Path, model: str) -> None:
        """Raises InputError where pycolmap is not installed."""
        self._colmap = import_pycolmap()
        self.images, self.names, self.model = images, list(names), model
        self.work = work
        self._database = work / "database.db"
        work.mkdir(parents=True, exist_ok=True)

    def find_features(self) -> None:
        """Find the features of all images."""
        colmap = self._colmap
        options = colmap.ImageReaderOptions()
        options.camera_model = self.model
        extraction = colmap.FeatureExtractionOptions()
        extraction.max_image_size = FEATURE_SIDE
        extraction.sift.max_num_features = MOST_FEATURES
        with Progress(len(self.names), "images searched for features") as progress:
            for names in _chunks(self.names, EXTRACTED_AT_ONCE):
                colmap.extract_features(
                    self._database, self.images, names, colmap.CameraMode.SINGLE, options, extraction, colmap.Device.cpu
                )
                options.existing_camera_id = 1  # the lens of the first ones
                progress.at(min(len(self.names), self.names.index(names[-1]) + 1))

    def import_images(self) -> None:
        """Enter the images into the database without searching them for features."""
        colmap = self._colmap
        options = colmap.ImageReaderOptions()
        options.camera_model = self.model
        with self.database():  # makes the file
            pass
        colmap.import_images(self._database, self.images, colmap.CameraMode.SINGLE, self.names, options)

    def match(self, pairs: Sequence[Pair]) -> None:
        """Match the features of pairs of images, and keep what an epipolar geometry explains."""
        colmap, listed = self._colmap, self.work / "pairs.txt"
        options = colmap.ImportedPairingOptions()
        options.match_list_path = listed
        with Progress(len(pairs), "pairs of images matched") as progress:
            for number, some in enumerate(_chunks(pairs, MATCHED_AT_ONCE)):
                listed.write_text("".join(f"{a} {b}\n" for a, b in some), encoding="utf-8")
                colmap.match_image_pairs(
                    self._database,
                    pairing_options=options,
                    verification_options=self._verification(),
                    device=colmap.Device.cpu,
                )
                progress.at(min(len(pairs), (number + 1) * MATCHED_AT_ONCE))

    def solve(self) -> Any:
        """The largest reconstruction, a pycolmap.Reconstruction; None where no two images fit together."""
        colmap = self._colmap
        options = colmap.IncrementalPipelineOptions()
        options.random_seed = SEED
        options.min_model_size = FEWEST_IMAGES
        options.mapper.random_seed = options.triangulation.random_seed = SEED
        options.extract_colors = True
        folder = self.work / "models"
        folder.mkdir(exist_ok=True)
        with Progress(len(self.names), "cameras placed") as progress:
            placed = itertools.count(1)
            found = colmap.incremental_mapping(
                self._database,
                self.images,
                folder,
                options,
                next_image_callback=lambda: progress.at(min(next(placed), len(self.names))),
            )
        return max(found.values(), key=lambda model: model.num_reg_images(), default=None)

    @contextmanager
    def database(self) -> Iterator[Any]:
        """The open pycolmap.Database."""
        database = self._colmap.Database.open(self._database)
        try:
            yield database
        finally:
            database.close()

    def copy(self, work: Path) -> Reconstruction:
        """The same images, features and matches in a database of their own."""
        result = Reconstruction(self.images, self.names, work, self.model)
        shutil.copyfile(self._database, result._database)
        return result

    def verify(self) -> None:
        """Find the epipolar geometries of all matches in the database anew."""
        colmap = self._colmap
        with self.database() as database:
            database.clear_two_view_geometries()
        colmap.geometric_verification(self._database, two_view_geometry_options=self._verification())

    def _verification(self) -> Any:
        options = self._colmap.TwoViewGeometryOptions()
        options.ransac.random_seed = SEED
        return options


def neighbouring_pairs(names: Sequence[str]) -> list[Pair]:
    """Pairs of images of one camera, in the order of time: near ones all, distant ones ever more rarely."""
    offsets, distance = list(range(1, NEIGHBOURS + 1)), float(NEIGHBOURS)
    while (distance := distance * GROWTH) < len(names):
        offsets.append(round(distance))
    return [(names[i], names[i + k]) for k in offsets for i in range(len(names) - k)]


def import_pycolmap() -> Any:
    """The module pycolmap, which logs nothing. Raises InputError where it is not installed."""
    try:
        import pycolmap
    except ImportError:
        raise InputError(
            f"pycolmap, which finds out where the cameras stood, is not installed: {pip_install('prepare')}."
        ) from None
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    return pycolmap


def _chunks(items: Sequence[Any], size: int) -> Iterator[list[Any]]:
    for first in range(0, len(items), size):
        yield list(items[first : first + size])


def merged(source: Reconstruction, groups: Sequence[Sequence[str]], work: Path) -> Reconstruction:
    """One image for each group of images of a camera that stands still: it has the features of all of them.

    source: has matched images of equal places in their groups, which were taken at the same time. So what moves ties
    the cameras together, too, and the noise of several times is averaged.
    groups: names of images, as many for each camera. The first of each stands for the camera.
    """
    result = Reconstruction(source.images, [group[0] for group in groups], work, source.model)
    result.import_images()
    with source.database() as old, result.database() as new:
        ids = {image.name: image.image_id for image in old.read_all_images()}
        own = {image.name: image.image_id for image in new.read_all_images()}
        first: dict[str, int] = {}  # of each image's features among those of its group
        for group in groups:
            keypoints = [old.read_keypoints(ids[name]) for name in group]
            counts = [0, *itertools.accumulate(len(each) for each in keypoints)]
            first |= dict(zip(group, counts, strict=False))
            new.write_keypoints(own[group[0]], np.concatenate(keypoints))
        for one, other in itertools.combinations(groups, 2):
            matches = [
                old.read_matches(ids[a], ids[b]).reshape(-1, 2) + np.array([first[a], first[b]], dtype=np.uint32)
                for a, b in zip(one, other, strict=True)
            ]
            new.write_matches(own[one[0]], own[other[0]], np.concatenate(matches))
    result.verify()
    return result
