"""Masks of what moves: places that no still point explains, as the solved cameras and the film's flow say.

A place that is followed through the images around it is explained if one depth, between near and infinity, puts a still
point on its whole way, as exactly as the film's noise allows. So a camera that turns on the spot needs no depth, and
one that walks leaves only what moves along the rays of its own path undecided. Neighbouring images vote, along the
flow; colors then draw the border (GrabCut: Rother, Kolmogorov, Blake 2004).

Flow: DIS (Kroeger et al., "Fast optical flow using dense inverse search", 2016) of OpenCV, between neighbouring frames,
chained from image to image. A place is lost where the flow forth and back do not meet.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Pixels, Size, encode_png
from lapgs_wgpu.data.masks import Mask, check_mask_size, decode_mask, find_masks
from lapgs_wgpu.prepare.depth_errors import FEWEST, depth_errors
from lapgs_wgpu.prepare.film import Film, Picture
from lapgs_wgpu.prepare.poses import Floats, Plane, import_cv2
from lapgs_wgpu.progress import Progress

SIDE = 480  # longer side of the images that are followed, pixels
STEP = 4  # pixels between the places that are followed
REACH, LEAST_REACH, MOST_REACH = 0.5, 6, 12  # seconds to either side; images, at least and at most
MEET, MEET_SHARE = 1.5, 0.05  # pixels between a place and its way forth and back, and more by this share of the way
NOISE, NOISE_GROWS = 0.15, 0.05  # pixels of flow, at least: between neighbouring images; for each further one
MOVES = 5.0  # times the noise, at least: it moves
VOTED = 1.5  # times the noise: the border between still and moving is looked for among larger votes only
HALO = 1.5  # times that border: flow bends around what moves
FOLLOWED = 0.2  # of the area: where flow tells of less, nothing is masked
LEAST = 0.002  # of an image that moves; less is noise
SHARP = 2.5  # times the noise of the better of two reconstructions: it agrees
RIM = np.pad(np.ones((42, 42), bool), 9)  # mask of all but an image's rim, which seldom shows what moves


class Motion:
    """The flow of a film. names: of its pictures. images: (h, w, 3) RGB, SIDE pixels at most, one of each picture.
    grid: (rows, columns, 2) the places of an image that are followed, pixels. tracks: of each image, where its grid is
    in the images around it, by their offsets; NaN where it is lost."""

    def __init__(self, frames: Iterable[tuple[Pixels, bool]], names: Sequence[str], reach: int = LEAST_REACH) -> None:
        """frames: small images of equal size in order, the first being a picture, and whether each is one. reach: the
        images to either side in which one is followed."""
        cv2 = import_cv2()
        dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dis.setFinestScale(1)
        following = iter(frames)
        self.names, self.images, self.reach = names, [next(following)[0]], reach
        height, width = self.images[0].shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        before = cv2.cvtColor(self.images[0], cv2.COLOR_RGB2GRAY)
        flows: list[list[NDArray[np.float16]]] = []  # from each picture to the next one, and back
        flow: list[Plane] = []  # forth and back, from the last picture on
        with Progress(len(names), "images followed") as progress:
            progress.at(1)
            for image, chosen in following:
                gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
                there, again = dis.calc(before, gray, None), dis.calc(gray, before, None)
                if flow:
                    there, again = flow[0] + _at(there, pixels + flow[0]), again + _at(flow[1], pixels + again)
                flow, before = [there, again], gray
                if chosen:
                    flows.append([way.astype(np.float16) for way in flow])
                    self.images.append(image)
                    flow = []
                    progress.at(len(self.images))
        places = np.meshgrid(np.arange(STEP // 2, width, STEP), np.arange(STEP // 2, height, STEP))
        self.grid: Plane = np.stack(places, axis=-1).astype(np.float32)
        back = [flow[::-1] for flow in flows]
        self.tracks = [
            self._ways(flows[i : i + reach], 1) | self._ways(back[max(i - reach, 0) : i][::-1], -1)
            for i in range(len(self.images))
        ]

    @classmethod
    def of_film(cls, film: Film, pictures: Sequence[Picture]) -> "Motion":
        """The flow of a film, from the first to the last of its pictures."""
        seconds = pictures[-1].seconds - pictures[0].seconds
        reach = round(REACH * (len(pictures) - 1) / max(seconds, 1e-3))
        reach = min(max(reach, LEAST_REACH), MOST_REACH)
        return cls(_film_frames(film, pictures), [picture.name for picture in pictures], reach)

    def _ways(self, flows: Sequence[Sequence[NDArray[np.float16]]], way: int) -> dict[int, Plane]:
        """The grid in images 1, 2, ... times `way` away. flows: from each of these to the next one, and back."""
        found, at = {}, self.grid
        for offset, (there, again) in enumerate(flows, start=1):
            step = _at(there.astype(np.float32), at)
            on = at + step
            apart = np.linalg.norm(step + _at(again.astype(np.float32), on), axis=-1)
            on[~(apart < MEET + MEET_SHARE * np.linalg.norm(step, axis=-1))] = np.nan
            found[way * offset] = at = on
        return found


def _at(values: Plane, at: NDArray[np.floating]) -> Plane:
    cv2 = import_cv2()
    x, y = (np.ascontiguousarray(np.nan_to_num(at[..., i], nan=-9.0), dtype=np.float32) for i in (0, 1))
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 4)


def _film_frames(film: Film, pictures: Sequence[Picture]) -> Iterator[tuple[Pixels, bool]]:
    """Small frames of a film from its first picture to its last, at most 4 steps from one to the next."""
    times = [picture.seconds for picture in pictures]
    number, last = 0, 0.0
    for frame in film.frames():
        chosen = abs(frame.seconds - times[number]) < 1e-6
        span = times[number] - times[number - 1] if number else 0.0
        if chosen or (number and frame.seconds - last >= span / 4 - 1e-6):
            yield np.ascontiguousarray(frame.pixels(SIDE)), chosen
            last = frame.seconds
        number += chosen
        if number == len(times):
            return


class Judged(NamedTuple):
    """What a reconstruction does not explain. names: of the images. errors: (n, rows, columns) of their grids, in times
    the noise, NaN where nothing can be said. votes: the logarithms that neighbouring images agree on; above `limit` it
    moves. noise: pixels, between neighbouring images."""

    names: Sequence[str]
    errors: Plane
    votes: Plane
    limit: float
    noise: float

    @property
    def moving(self) -> float:
        """Share of the images' area that moves."""
        return float((self.votes > self.limit).mean())

    @property
    def followed(self) -> float:
        """Share of the area, of the images with cameras, in which flow can tell."""
        known = np.isfinite(self.errors).mean(axis=(1, 2))
        return float(known[known > 0].mean()) if known.any() else 0.0

    def explained(self, other: "Judged") -> float:
        """How much of the images' area still points explain, in times of what they explain in another one, at the noise
        of the better of the two: what is nearly rigid fits wrong cameras nearly."""
        limit = SHARP * min(self.noise, other.noise)
        mine, others = (float((each.errors * each.noise < limit).mean()) for each in (self, other))
        return mine / max(others, 1e-9)

    def contradicted(self) -> list[str]:
        """The images of which more than half of the known area is off by MOVES times the noise or more."""
        known = np.isfinite(self.errors).sum(axis=(1, 2))
        off = (self.errors > MOVES).sum(axis=(1, 2)) > 0.5 * np.maximum(known, 1)
        return [name for name, wrong in zip(self.names, off, strict=True) if wrong]

    def rough(self, *, turned_over: bool = False) -> dict[str, Mask]:
        """Masks on the grid, a little wider than what moves. turned_over: of what agrees instead, in images that
        disagree at least half as much as the worst one: their cameras may follow what moves."""
        masks = self.votes > self.limit
        if turned_over:
            share = masks.mean(axis=(1, 2), keepdims=True)
            masks = np.where(share >= share.max() / 2, self.errors < SHARP, masks)
        wider = [import_cv2().dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for mask in masks]
        return dict(zip(self.names, wider, strict=True))


class _Solved:
    """A pycolmap.Reconstruction of some of the flow's images, and how far the film misses it."""

    def __init__(self, motion: Motion, model: Any) -> None:
        images = {motion.names.index(model.image(i).name): model.image(i) for i in model.reg_image_ids()}
        self._motion = motion
        self._poses = {i: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for i, image in images.items()}
        self._camera = next(iter(images.values())).camera
        self._scale = self._camera.width / motion.images[0].shape[1]
        points = np.stack([point.xyz for point in model.points3D.values()])
        poses = [pose for i, pose in self._poses.items() if i % max(1, len(motion.names) // 20) == 0]
        depths = [points @ pose[2, :3] + pose[2, 3] for pose in poses]
        near = [np.percentile(depth[depth > 0], 5) for depth in depths if (depth > 0).any()]
        self._nearest = float(np.median(near or [1.0]))

    def _directions(self, at: Plane) -> Floats:
        flat = np.nan_to_num(at.reshape(-1, 2).astype(np.float64))
        seen = np.asarray(self._camera.cam_from_img((flat + 0.5) * self._scale))
        return np.where(np.isfinite(at.reshape(-1, 2)), seen, np.nan)

    def misses(self, i: int, noise: NDArray[np.floating], *, even: bool) -> tuple[Floats, dict[int, Floats]]:
        """Of the grid of image i (rows columns,), and by the offset of each image around it, in times the noise."""
        poses, grid = self._poses, self._motion.grid
        tracks = {k: at for k, at in self._motion.tracks[i].items() if i + k in poses}
        if i not in poses or len(tracks) < FEWEST:
            return np.full(grid[..., 0].size, np.nan), {}
        relative = np.stack([poses[i + k] for k in tracks]) @ np.linalg.inv(poses[i])
        seen = np.stack([self._directions(at) for at in tracks.values()])
        sigma = np.array([noise[abs(k)] for k in tracks]) / (self._camera.mean_focal_length() / self._scale)
        # Nothing is nearer than half as far as the nearest points of the scene.
        total, each = depth_errors(self._directions(grid), seen, relative, sigma, 2 / self._nearest, even=even)
        return total, dict(zip(tracks, each, strict=True))

    def noise(self, *, even: bool) -> NDArray[np.floating]:
        """(reach + 1,) pixels, by how many images apart."""
        noise, count = NOISE + NOISE_GROWS * np.arange(self._motion.reach + 1), len(self._motion.names)
        sampled = [self.misses(i, noise, even=even)[1] for i in range(0, count, max(1, count // 12))]
        for apart in range(1, len(noise)):
            errors = np.array([error for each in sampled for k, error in each.items() if abs(k) == apart])
            if len(known := errors[np.isfinite(errors)]):
                noise[apart] *= max(1.0, 1.55 * np.percentile(known, 25))  # the median, if all were noise
        return noise


def judge(motion: Motion, model: Any, *, even: bool = False) -> Judged:
    """model: a pycolmap.Reconstruction of some of the flow's images. even: without errors that change evenly over an
    image, as those of cameras and of their lens do."""
    solved = _Solved(motion, model)
    noise = solved.noise(even=even)
    errors = np.stack([solved.misses(i, noise, even=even)[0] for i in range(len(motion.names))], dtype=np.float32)
    errors = errors.reshape(-1, *motion.grid.shape[:2])
    votes = _votes(motion, errors)
    limit = max(float(np.log(MOVES)), np.log(HALO) + _valley(votes[votes > np.log(VOTED)]))
    return Judged(motion.names, errors, votes, limit, float(noise[1]))


def _votes(motion: Motion, errors: Plane) -> Plane:
    """The mean logarithm of the errors along each place's way through two thirds of the images around it, the nearer
    ones with more weight."""
    logs, result = np.log(np.maximum(errors, 0.5)), []
    for i, own in enumerate(logs):
        near = {k: (at - STEP // 2) / STEP for k, at in motion.tracks[i].items() if abs(k) <= 2 * motion.reach // 3}
        ways = {0: own} | {k: _at(logs[i + k], at) for k, at in near.items()}
        votes = np.stack(list(ways.values()))
        weight = np.isfinite(votes) / (1.0 + np.abs(list(ways)))[:, None, None]
        with np.errstate(invalid="ignore"):  # NaN where no image tells
            result.append((np.nan_to_num(votes) * weight).sum(axis=0) / weight.sum(axis=0))
    return np.stack(result).astype(np.float32)


def _valley(values: NDArray[np.floating]) -> float:
    """The value that parts values best into two classes. Otsu 1979."""
    if len(values) < 2:
        return 0.0
    low, span = float(values.min()), max(float(np.ptp(values)), 1e-9)
    levels = np.round(255 * (values - low) / span).astype(np.uint8)
    return low + span / 255 * float(import_cv2().threshold(levels, 0, 255, 8)[0])  # 8: THRESH_OTSU


def cut_out(motion: Motion, judged: Judged) -> dict[str, Mask]:
    """Masks of what moves (h, w), of the size of the flow's images; none where flow tells of too little area."""
    if judged.followed <= FOLLOWED:
        return {}
    planes = zip(motion.names, motion.images, judged.votes, strict=True)
    return {name: _cut(image, vote, judged.limit) for name, image, vote in planes}


def _cut(image: NDArray[np.uint8], vote: Plane, limit: float) -> Mask:
    """The mask (h, w) of an image, from the votes on its grid."""
    cv2 = import_cv2()
    height, width = image.shape[:2]
    value = cv2.resize(np.nan_to_num(vote, nan=0.0), (width, height), interpolation=cv2.INTER_LINEAR)

    def disk(radius: int) -> Any:
        return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))

    moves = cv2.morphologyEx((value > limit).astype(np.uint8), cv2.MORPH_OPEN, disk(2))
    if moves.mean() < LEAST:
        return np.zeros((height, width), bool)
    label = np.full((height, width), cv2.GC_BGD, np.uint8)
    label[cv2.dilate(moves, disk(10)) > 0] = cv2.GC_PR_BGD
    label[moves > 0] = cv2.GC_PR_FGD
    label[cv2.erode((value > limit + np.log(2)).astype(np.uint8), disk(5)) > 0] = cv2.GC_FGD
    if (label == cv2.GC_BGD).any():
        cv2.grabCut(image, label, None, np.zeros((1, 65)), np.zeros((1, 65)), 1, cv2.GC_INIT_WITH_MASK)
    inside = ((label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD)).astype(np.uint8)
    return cv2.morphologyEx(inside, cv2.MORPH_OPEN, disk(1)) > 0


def write_masks(folder: Path, masks: Mapping[str, Mask]) -> None:
    """Write PNG images below a folder, white where something moves, under the images' names."""
    for name, mask in masks.items():
        path = folder / PurePosixPath(name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(mask.astype(np.uint8) * 255))


def read_masks(folder: Path, names: Sequence[str], size: Size) -> dict[str, Mask]:
    """The masks of images of (width, height), white where something moves, by the images' names, each of which needs
    one (`find_masks`). Raises InputError."""
    paths = find_masks(folder, names, "each image in images/ of a first run without --masks, with the same --fps")
    for path in paths.values():
        check_mask_size(path, size)
    return {name: decode_mask(path) for name, path in paths.items()}
