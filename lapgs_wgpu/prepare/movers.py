"""Masks of what moves, from the film itself: tracks of features that no single point explains, seen by the cameras.

A reconstruction follows whatever its features agree on most. That may be the thing that moves, if it is rich in
texture and always in the image. So area decides: of what agrees with a reconstruction and what does not,
the part that covers more of the images stands still. The rest is masked, and the cameras are solved again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Size
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.masks import Mask
from lapgs_wgpu.prepare.measures import Floats
from lapgs_wgpu.prepare.poses import Reconstruction, import_pycolmap
from lapgs_wgpu.progress import say

Ints = NDArray[np.int64]

SHORTEST = 5  # images of a track that counts: two images agree with almost any motion along their epipolar lines
TOLERANCE, MIN_TOLERANCE = 2.5e-3, 1.0  # median reprojection error of a still track: of the longer side; pixels
SHARP = 3.0  # times the error of what fits best: an error that is noise
GRID = 160  # pixels along the longer side of a mask
REACH = 0.025  # of the longer side: standard deviation of the weight with which features decide around them
LEAST_WEIGHT = 0.2  # of the features around a place, in features next to it: emptier places are not masked
MIDDLE = 0.7  # of width and height, that the second reconstruction leaves out
LITTLE, MUCH = 0.01, 0.1  # share of the images: less motion needs no masks; more may have led the reconstruction astray
LONG, STANDING = 0.5, 0.3  # a camera stands still: this share of the tracks stay in place for that share of the film
BEHIND = 1e6  # pixels: error of a point behind its camera


class World(NamedTuple):
    """What a reconstruction takes for still. model: a pycolmap.Reconstruction, None where nothing fits together.
    errors: of all tracks. masks: of what moves, by image, (h, w)."""

    model: Any
    errors: Floats
    masks: dict[str, Mask]

    @property
    def moving(self) -> float:
        """Share of the images that moves."""
        return float(np.mean([mask.mean() for mask in self.masks.values()]))

    @property
    def noise(self) -> float:
        """Pixels: error of the tracks that fit well; infinite without tracks."""
        known = self.errors[np.isfinite(self.errors)]
        return float(np.percentile(known, 25)) if len(known) else np.inf


def solve_masked(matched: Reconstruction, size: Size) -> tuple[Any, dict[str, Mask]]:
    """Place the cameras by what stands still. matched: with verified matches; size: (width, height) of its images.

    Where much disagrees with a first reconstruction, a second one is made of the images' rims alone. The one that
    explains more of the images' area tells what moves. Returns a pycolmap.Reconstruction, None where nothing fits
    together, and the masks of what moves, by image. Raises InputError for a camera that stands still.
    """
    with matched.database() as database:
        tracks = find_tracks(database)
    standing = standing_share(tracks, size)
    if standing > STANDING:
        raise InputError(
            f"the camera stands still: {standing:.0%} of the features that are followed stay within "
            f"{tolerance(size):.1f} pixels for half of the film or longer (at most {STANDING:.0%} may), so nothing "
            "tells how far away anything is; walk around what moves, or film it with several cameras at once."
        )
    best = _judged(matched.solve(), tracks, size)
    if best.moving > MUCH:
        say(f"{best.moving:.0%} of the image area disagrees with the first cameras: trying the images' rims alone.")
        other = _judged(_without(matched, dict.fromkeys(matched.names, rim(size)), size, "rim"), tracks, size)
        # What is nearly rigid fits a wrong reconstruction nearly: the better fit of the two sets the standard.
        limit = SHARP * min(best.noise, other.noise)
        best = max(best, other, key=lambda world: _still_area(tracks, world.errors, size, limit))
    if best.moving < LITTLE:
        return best.model, dict.fromkeys(matched.names, np.zeros_like(rim(size)))
    say(f"{best.moving:.0%} of the image area moves: masked, and the cameras are placed again.")
    again = _judged(_without(matched, best.masks, size, "masked"), tracks, size)
    if again.model is None or again.model.num_reg_images() < best.model.num_reg_images():  # the masks took too much
        again = best
    return again.model, again.masks


def _judged(model: Any, tracks: Tracks, size: Size) -> World:
    errors = np.full(len(tracks), np.nan) if model is None or not len(tracks) else track_errors(tracks, model)
    return World(model, errors, agreement(tracks, errors, size, tolerance(size))[1])


def _still_area(tracks: Tracks, errors: Floats, size: Size, limit: float) -> float:
    """Share of the images where tracks have errors below `limit` pixels."""
    return float(np.mean([mask.mean() for mask in agreement(tracks, errors, size, limit)[0].values()]))


def _without(matched: Reconstruction, masks: Mapping[str, Mask], size: Size, name: str) -> Any:
    """The largest reconstruction without the matches in masked places."""
    rest = matched.copy(matched.work / name)
    with rest.database() as database:
        remove_matches(database, masks, size)
    rest.verify()
    return rest.solve()


@dataclass(frozen=True)
class Tracks:
    """Features that matches connect, each image at most once.

    image, place: of each observation (n,) the image's number in `names`, and (n, 2) its pixels. starts: (T,) first
    observation of each track.
    """

    names: tuple[str, ...]
    image: Ints
    place: Floats
    starts: Ints

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def track(self) -> Ints:
        """(n,) the track of each observation."""
        return np.repeat(np.arange(len(self)), np.diff(np.append(self.starts, len(self.image))))


def find_tracks(database: Any) -> Tracks:
    """The tracks of at least SHORTEST images in a database with verified matches."""
    from scipy.sparse import coo_matrix  # slow to import
    from scipy.sparse.csgraph import connected_components

    colmap = import_pycolmap()
    images = sorted(database.read_all_images(), key=lambda image: image.image_id)
    keypoints = [database.read_keypoints(image.image_id)[:, :2].astype(np.float64) for image in images]
    numbers = {image.image_id: number for number, image in enumerate(images)}
    first = np.concatenate([[0], np.cumsum([len(each) for each in keypoints])])
    edges = [np.zeros((0, 2), np.int64)]
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        a, b = (numbers[i] for i in colmap.pair_id_to_image_pair(pair))
        edges.append(geometry.inlier_matches.astype(np.int64).reshape(-1, 2) + np.array([first[a], first[b]]))
    one, other = np.concatenate(edges).T
    count = int(first[-1])
    if count == 0:  # nothing but blank images
        return Tracks(tuple(image.name for image in images), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, int))
    _, labels = connected_components(
        coo_matrix((np.ones(len(one)), (one, other)), shape=(count, count)), directed=False
    )
    image = np.repeat(np.arange(len(images)), np.diff(first))
    order = np.lexsort((image, labels))
    sizes = np.bincount(labels)[labels[order]]
    twice = np.zeros(labels.max() + 1, bool)  # tracks with two features of one image hold a wrong match
    same = (np.diff(labels[order]) == 0) & (np.diff(image[order]) == 0)
    twice[labels[order][1:][same]] = True
    order = order[(sizes >= SHORTEST) & ~twice[labels[order]]]
    starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
    places = np.concatenate(keypoints) if keypoints else np.zeros((0, 2))
    return Tracks(tuple(image.name for image in images), image[order], places[order], starts)


def standing_share(tracks: Tracks, size: Size) -> float:
    """Share of the tracks that stay in their place while LONG of the film passes. size: (width, height) of images."""
    if len(tracks) == 0:
        return 0.0
    spread = np.zeros(len(tracks))
    for column in tracks.place.T:
        both = np.maximum.reduceat(column, tracks.starts) - np.minimum.reduceat(column, tracks.starts)
        spread = np.maximum(spread, both)
    last = np.append(tracks.starts[1:], len(tracks.image)) - 1
    long = tracks.image[last] - tracks.image[tracks.starts] >= LONG * (len(tracks.names) - 1)
    return float((long & (spread < tolerance(size))).mean())


def track_errors(tracks: Tracks, model: Any) -> Floats:
    """(T,) pixels: the median error of the point that a track's observations triangulate to. NaN for tracks of which
    less than SHORTEST images have a camera in the pycolmap.Reconstruction."""
    placed = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    poses = np.stack([placed[n].cam_from_world().matrix() if n in placed else np.zeros((3, 4)) for n in tracks.names])
    camera = next(iter(placed.values())).camera
    ray = np.asarray(camera.cam_from_img(tracks.place))
    pose = poses[tracks.image]
    rows = ray[:, :, None] * pose[:, 2:3] - pose[:, :2]  # of the linear triangulation; zeros where there is no camera
    normal = np.add.reduceat(np.einsum("nki,nkj->nij", rows, rows), tracks.starts, axis=0)
    point = np.linalg.eigh(np.where(np.isfinite(normal), normal, 0.0))[1][:, :, 0]
    seen = np.einsum("nij,nj->ni", pose, point[tracks.track])
    front = seen[:, 2] * point[tracks.track, 3] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(front[:, None], seen[:, :2] / seen[:, 2:] - ray, BEHIND)
    error = camera.mean_focal_length() * np.linalg.norm(offset, axis=1)
    has_camera = np.array([name in placed for name in tracks.names])[tracks.image]
    error[~has_camera] = np.nan
    sizes = np.add.reduceat(has_camera.astype(np.int64), tracks.starts)
    order = np.lexsort((error, tracks.track))  # NaN last
    median = error[order][tracks.starts + np.maximum(sizes - 1, 0) // 2]
    return np.where(sizes >= SHORTEST, median, np.nan)


def agreement(tracks: Tracks, errors: Floats, size: Size, limit: float) -> tuple[dict[str, Mask], dict[str, Mask]]:
    """Where most tracks agree with a reconstruction, and where most disagree, by image: masks (h, w) whose longer side
    is GRID. errors: of `track_errors`; below `limit` pixels they agree. size: (width, height) of the images."""
    from scipy.ndimage import binary_closing, binary_opening, gaussian_filter  # slow to import

    known = np.isfinite(errors)[tracks.track]
    moves = (errors >= limit)[tracks.track]
    scale = GRID / max(size)
    shape = (max(1, round(size[1] * scale)), max(1, round(size[0] * scale)))
    deviation = REACH * GRID
    least = LEAST_WEIGHT / (2 * np.pi * deviation**2)
    still, moving = {}, {}
    for number, name in enumerate(tracks.names):
        mine = known & (tracks.image == number)
        column, row = np.clip((tracks.place[mine] * scale).astype(int), 0, [shape[1] - 1, shape[0] - 1]).T
        weights = [np.zeros(shape), np.zeros(shape)]
        np.add.at(weights[0], (row, column), 1.0)
        np.add.at(weights[1], (row, column), moves[mine].astype(float))
        total, against = (gaussian_filter(weight, deviation, mode="constant") for weight in weights)
        covered = total > least
        against_most = binary_closing(binary_opening(covered & (against > 0.5 * total), iterations=2), iterations=3)
        moving[name], still[name] = against_most, covered & ~against_most
    return still, moving


def remove_matches(database: Any, masks: Mapping[str, Mask], size: Size) -> float:
    """Remove the matches of features in masked places. Returns the share of all matches that was removed."""
    colmap = import_pycolmap()
    masked = {
        image.image_id: in_mask(masks.get(image.name), database.read_keypoints(image.image_id)[:, :2], size)
        for image in database.read_all_images()
    }
    before = after = 0
    for pair, matches in zip(*database.read_all_matches(), strict=True):
        a, b = colmap.pair_id_to_image_pair(pair)
        kept = matches[~(masked[a][matches[:, 0]] | masked[b][matches[:, 1]])] if len(matches) else matches
        before, after = before + len(matches), after + len(kept)
        if len(kept) < len(matches):
            database.delete_matches(a, b)
            database.write_matches(a, b, kept)
    return 1 - after / max(before, 1)


def in_mask(mask: Mask | None, places: NDArray[np.floating], size: Size) -> Mask:
    """Whether places (n, 2), in pixels of an image of (width, height), lie in its mask, which may be smaller."""
    if mask is None:
        return np.zeros(len(places), bool)
    scale = np.array([mask.shape[1] / size[0], mask.shape[0] / size[1]])
    column, row = np.clip((places * scale).astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
    return mask[row, column]


def tolerance(size: Size) -> float:
    """Median reprojection error, in pixels, up to which a track stands still."""
    return max(MIN_TOLERANCE, TOLERANCE * max(size))


def rim(size: Size) -> Mask:
    """Mask of the middle of an image. Its rim seldom shows what moves."""
    height, width = (max(1, round(side * GRID / max(size))) for side in (size[1], size[0]))
    mask = np.zeros((height, width), bool)
    rows, columns = (round(side * (1 - MIDDLE) / 2) for side in mask.shape)
    mask[rows : height - rows, columns : width - columns] = True
    return mask
