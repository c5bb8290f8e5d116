"""Camera poses by structure from motion with pycolmap: features, matches, and cameras that explain them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Size
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.progress import counted

FEATURE_SIDE = 1600  # longer side, pixels: larger images are shrunk to find features
MOST_FEATURES = 2000  # of an image, the strongest; the time of matching grows with their square
RATIO, LIKE = 0.9, 0.7  # of the distances of the best and the second match; cosine of two descriptors, at least
LEAST_ANGLE = 0.5  # degrees between the rays of a point
SEED = 0
THREADS = 1  # that solve: the sums of several differ from run to run
Pair = tuple[str, str]
Ints = NDArray[np.integer]
Floats = NDArray[np.float64]
Plane = NDArray[np.float32]
Match = Mapping[Pair, Ints]  # of pairs of images: (m, 2) numbers of their features


class RefusedError(InputError):
    """Too few cameras could be placed. What was found stays."""


class Reconstruction:
    """Structure from motion over images.

    images: the folder of all images. names: of those to use, below it, in the order of time. work: folder for the
    database. model: COLMAP's name for the lens. lenses: SINGLE for one, PER_FOLDER, or PER_IMAGE.
    """

    def __init__(self, images: Path, names: Sequence[str], work: Path, model: str, lenses: str = "SINGLE") -> None:
        """Raises InputError where pycolmap is not installed."""
        self._colmap = colmap = import_pycolmap()
        self.images, self.names = images, list(names)
        self.places: dict[str, Plane] = {}
        self.matches: dict[Pair, Ints] = {}
        self._database, self._models = work / "database.db", work / "models"
        self._models.mkdir(parents=True, exist_ok=True)
        self.database().close()  # makes the file
        options = colmap.ImageReaderOptions()
        options.camera_model = model
        colmap.import_images(self._database, images, colmap.CameraMode.__members__[lenses], self.names, options)
        with self.database() as database:
            self._images = {image.name: image for image in database.read_all_images()}
            camera = database.read_all_cameras()[0]
        self.size: Size = (camera.width, camera.height)
        self.prior, self.exif = float(camera.mean_focal_length()), bool(camera.has_prior_focal_length)

    def database(self) -> Any:
        """The open pycolmap.Database, a context manager."""
        return self._colmap.Database.open(self._database)

    def match(self, pairs: Sequence[Pair], shown: Mapping[str, Sequence[str]] | None = None) -> None:
        """Find the features of all images, match those of pairs, and keep places and matches.

        shown: names of further images, below the same folder, for cameras that stand still: an image has the features
        of all of its own, as many for each and in the order of time, and those of one time are matched. So what moves
        ties the cameras together, too, and the noise of several times is averaged.
        """
        descriptors: dict[str, list[Plane]] = {}
        with self.database() as database:
            for name in counted(self.names, len(self.names), "images searched for features"):
                features = [sift(self.images / each) for each in (shown[name] if shown else [name])]
                self.places[name] = np.concatenate([places for places, _ in features])
                descriptors[name] = [looks for _, looks in features]
                database.write_keypoints(self._images[name].image_id, self.places[name])
        for pair in counted(pairs, len(pairs), "pairs of images matched"):
            found, before = [], np.zeros(2, np.int64)
            for one, other in zip(*(descriptors[name] for name in pair), strict=True):
                found.append(nearest(one, other) + before)
                before += [len(one), len(other)]
            self.matches[pair] = np.concatenate(found)

    def verify(self, masks: Mapping[str, Mask] | None = None) -> None:
        """Find epipolar geometries that explain many of the matches, of those outside masks alone."""
        colmap = self._colmap
        matches = self.matches if masks is None else without(self.matches, self.places, masks, self.size)
        with self.database() as database:
            database.clear_matches()
            database.clear_two_view_geometries()
            for camera in database.read_all_cameras():
                camera.has_prior_focal_length = self.exif  # the length of an earlier attempt would mislead
                database.update_camera(camera)
            for pair, each in matches.items():
                database.write_matches(*(self._images[name].image_id for name in pair), each.astype(np.uint32))
        options = colmap.TwoViewGeometryOptions()
        options.ransac.random_seed, options.ransac.max_num_trials = SEED, 1000
        options.detect_watermark = False  # what follows the camera is no watermark
        colmap.geometric_verification(self._database, two_view_geometry_options=options)

    def verified(self) -> dict[Pair, Ints]:
        """The matches that an epipolar geometry explains, of pairs that share 15 or more."""
        names, verified = {image.image_id: name for name, image in self._images.items()}, {}
        with self.database() as database:
            for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
                if len(geometry.inlier_matches) >= 15:
                    one, other = self._colmap.pair_id_to_image_pair(pair)
                    verified[names[one], names[other]] = geometry.inlier_matches.astype(np.int64)
        return verified

    def solve(
        self, focal: float | None = None, *, together: bool = False, held: bool = False, seconds: float = -1
    ) -> Any:
        """The largest reconstruction, a pycolmap.Reconstruction; None where no two images fit together.

        focal: length to begin with, pixels; None leaves what the database has. together: all cameras at once
        (GLOMAP), else one after the other, for at most so many seconds. held: the lens stays as it begins, since a wall
        or a far scene does not tell it.
        """
        colmap = self._colmap
        if focal is not None:
            with self.database() as database:
                for camera in database.read_all_cameras():
                    camera.params = [focal, *camera.params[1:3], *[0.0] * (len(camera.params) - 3)]
                    camera.has_prior_focal_length = True
                    database.update_camera(camera)
        if together:
            options = colmap.GlobalPipelineOptions()
            mapper, adjustment = options.mapper, options.mapper.bundle_adjustment
            for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning):
                part.random_seed = SEED
            options.num_threads = mapper.num_threads = THREADS
            mapper.min_tri_angle_deg = LEAST_ANGLE
            mapper.track_required_tracks_per_view = 150
            adjustment.ceres.solver_options.function_tolerance = 1e-4
            adjustment.refine_focal_length = adjustment.refine_extra_params = not held
            found = colmap.global_mapping(self._database, self.images, self._models, options)
        else:
            options = colmap.IncrementalPipelineOptions()
            options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
            options.num_threads = options.mapper.num_threads = THREADS
            options.min_model_size = 2
            options.max_runtime_seconds = round(seconds)
            options.ba_refine_focal_length = options.ba_refine_extra_params = not held
            if focal is not None:  # a film: many images from nearly one side, where COLMAP's limits are for photos
                options.mapper.init_min_tri_angle, options.mapper.ba_local_min_tri_angle = 4, 2
                options.mapper.filter_min_tri_angle = options.triangulation.min_angle = LEAST_ANGLE
                options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
            found = colmap.incremental_mapping(self._database, self.images, self._models, options)
        return max(found.values(), key=lambda model: model.num_reg_images(), default=None)

    def given(self, cameras: Mapping[str, tuple[Lens, Floats]]) -> Any:
        """As `unpointed`, with points by the verified matches. The model must be OPENCV."""
        options = self._colmap.IncrementalPipelineOptions()
        options.num_threads, options.triangulation.random_seed = THREADS, SEED
        options.triangulation.min_angle = LEAST_ANGLE
        options.mapper.filter_min_tri_angle = LEAST_ANGLE
        model = self.unpointed(cameras)
        return self._colmap.triangulate_points(model, self._database, self.images, self._models, options=options)

    def unpointed(self, cameras: Mapping[str, tuple[Lens, Floats]]) -> Any:
        """A pycolmap.Reconstruction without points. cameras: of images, lenses at their size and poses (3 or 4, 4),
        world to camera."""
        colmap, model = self._colmap, self._colmap.Reconstruction()
        for number, lens in {self._images[name].camera_id: lens for name, (lens, _) in cameras.items()}.items():
            values = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial[:2], *lens.tangential]
            model.add_camera_with_trivial_rig(
                colmap.Camera(model="OPENCV", width=lens.width, height=lens.height, params=values, camera_id=number)
            )
        for name, (_, pose) in cameras.items():
            model.add_image_with_trivial_frame(self._images[name], colmap.Rigid3d(pose[:3]))
        return model


def without(matches: Match, places: Mapping[str, Plane], masks: Mapping[str, Mask], size: Size) -> dict[Pair, Ints]:
    """The matches whose two features lie outside the masks. size: (width, height) of the images."""
    free = {name: ~in_mask(masks[name], at[:, :2], size) for name, at in places.items()}
    return {(a, b): m[free[a][m[:, 0]] & free[b][m[:, 1]]] for (a, b), m in matches.items()}


def in_mask(mask: Mask, places: NDArray[np.floating], size: Size) -> Mask:
    """Whether places (n, 2), in pixels of an image of (width, height), lie in its mask, which may be smaller."""
    shape = np.array(mask.shape[::-1])
    column, row = np.clip((places * (shape / size)).astype(int), 0, shape - 1).T
    return mask[row, column]


def sift(path: Path) -> tuple[Plane, Plane]:
    """The features of an image file: places (n, 4), pixels (the middle of the first is 0.5, 0.5), size, radians; and
    descriptors (n, 128), square roots of SIFT's histograms, of length 1 (Arandjelovic and Zisserman 2012)."""
    cv2 = import_cv2()
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    scale = min(1.0, FEATURE_SIDE / max(image.shape))
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, looks = cv2.SIFT_create(MOST_FEATURES, contrastThreshold=0.02).detectAndCompute(image, None)
    if not points:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.float32)
    found = [((p.pt[0] + 0.5) / scale, (p.pt[1] + 0.5) / scale, p.size / scale, np.radians(p.angle)) for p in points]
    return np.array(found, np.float32), np.sqrt(looks / np.maximum(looks.sum(axis=1, keepdims=True), 1e-9))


def nearest(one: Plane, other: Plane) -> Ints:
    """(m, 2) numbers of descriptors (n, 128) that are each other's nearest, and clearly nearer than the second."""
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 2), np.int64)
    alike, rows = one @ other.T, np.arange(len(one))
    match = alike.argmax(axis=1)
    best, back = alike[rows, match], alike.max(axis=0)
    alike[rows, match] = -1
    kept = (best == back[match]) & (np.maximum(1 - best, 1e-6) < RATIO**2 * (1 - alike.max(axis=1))) & (best > LIKE)
    return np.stack([rows[kept], match[kept]], axis=1)


def neighbouring_pairs(names: Sequence[str]) -> list[Pair]:
    """Pairs of images of one camera, in the order of time: each with the 6 after it, and then ever further ones."""
    offsets, distance = [1, 2, 3, 4, 5, 6], 6.0
    while (distance := 1.5 * distance) < len(names):
        offsets.append(round(distance))
    return [(names[i], names[i + k]) for k in offsets for i in range(len(names) - k)]


def import_pycolmap() -> Any:
    """The module pycolmap, which logs nothing. Raises InputError where it is not installed."""
    module = optional_module("pycolmap", "finding out where the cameras stood needs pycolmap", "prepare")
    module.logging.minloglevel = int(module.logging.FATAL)
    return module


def import_cv2() -> Any:
    """The module cv2 of OpenCV. Raises InputError where it is not installed."""
    module = optional_module("cv2", "finding and following features needs OpenCV", "prepare")
    module.setRNGSeed(0)
    return module
