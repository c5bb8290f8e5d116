"""Tracks of what masks say moves in the images of one camera: cut-outs of some images, followed through the others.

A cut-out is what is connected in the mask of one image and not mostly explained by earlier ones. It is followed from
image to image by its colors (Baker and Matthews, Lucas-Kanade 20 years on, IJCV 2004), affinely and with bends, until
it no longer looks alike. It stands upright at the depth of the ground below. Images show those of the nearest ones.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from lapgs_wgpu.data.cloud import points_at
from lapgs_wgpu.data.evenly import evenly_indices
from lapgs_wgpu.discovery.residual import Floats, Mask, Residual
from lapgs_wgpu.discovery.tracks import Tracks

MOST = 40  # cut-outs
LEAST = 4e-3  # share of an image that a cut-out covers, at least
ENOUGH = 0.15  # share of an image's moving pixels that may stay unexplained
BLURS = 4.0, 2.0, 1.0  # pixels; of the images that are compared, one after another
NEWS = 0.5  # share of what a cut-out explains in an image that none of a nearer image does, at least
POINTS = 18_000  # of all cut-outs, at most
ALIKE = 0.12  # difference of two blurred colors that look alike
LOST, VISIBLE = 0.65, 0.3  # shares of a cut-out that must look alike, and lie in the image
COMPARED = 1500  # pixels of a cut-out
NEAR = 2.0  # pixels, from one of a cut-out: it explains a pixel
KNOTS = 8  # pixels, about, between two at which a cut-out bends
TENSION = 0.05  # weight of how bends differ from knot to knot
STIFF = 0.02  # weight of a change from one image to the next
FOOT = 0.15  # of its height: the lowest part of a cut-out, which stands on the ground
HIDDEN, BEFORE = 0.1, 0.9  # quantile of the depths of what a cut-out hides; how far before that and the ground it is
APART = -0.5, 0.5  # half sides of the box: how far the first and the last cut-out are moved away from the cameras
FAR_BELOW = 3  # pixels; the ground that a foot stands on lies so far below

Weights = NDArray[np.float64]


class _Cutout(NamedTuple):
    """pixels: (n, 2) columns and rows. at: (T, n, 2) where they are in each image. seen: (T,). explained: (T, H, W),
    what it explains of each mask."""

    key: int
    pixels: NDArray[np.int64]
    at: Floats
    seen: NDArray[np.bool_]
    explained: Mask


def cutout_tracks(
    residuals: Sequence[Residual], depths: Sequence[Floats], half_side: float
) -> tuple[Tracks | None, float]:
    """Tracks of what moves in images of one camera, None where nothing does, and the share of it that they explain.

    Their positions do not share the way that all go, and those of each cut-out lie apart: the field has less to learn,
    and it tells Gaussians apart by place.

    residuals: images in the order of their times, whose masks say what moves. depths: (H, W) of what stands still in
    each, world units, NaN where unknown. half_side: of the box that the field covers, world units.
    """
    masks = np.stack([each.mask for each in residuals])
    cutouts, rest = _cutouts([_levels(each) for each in residuals], masks)
    if not cutouts:
        return None, 0.0
    ground = [_depths(mask, depth) for mask, depth in zip(masks, depths, strict=True)]
    placed = [_placed(cutout, residuals, ground, POINTS // len(cutouts)) for cutout in cutouts]
    paths, colors = (np.concatenate(each, axis=-2) for each in zip(*placed, strict=True))
    number = np.repeat(np.arange(len(cutouts)), [len(own) for _, own in placed])
    seen = np.stack([cutout.seen for cutout in cutouts], axis=1)
    way = _common_way(paths, seen[:, number], np.array([each.time for each in residuals]))
    for k in range(len(cutouts)):  # beyond, it goes as all go
        shown, own = np.flatnonzero(seen[:, k]), number == k
        nearest = np.arange(len(seen)).clip(shown[0], shown[-1])
        paths[:, own] = paths[np.ix_(nearest, own)] + (way - way[nearest])[:, None]
    _show_nearest(cutouts, seen)
    keys = np.array([cutout.key for cutout in cutouts])
    ahead = np.mean([each.camera.T_cam_world[2, :3] for each in residuals], axis=0).astype(np.float32)
    apart = np.linspace(*APART, len(cutouts), dtype=np.float32)[np.argsort(np.argsort(keys))]  # by rank in time
    positions = (paths - way[:, None])[keys[number], np.arange(len(number))]
    positions += half_side * apart[number][:, None] * ahead - positions.mean(axis=0)
    return Tracks(positions, colors, number, paths, seen[:, number]), float((masks & ~rest).sum() / masks.sum())


def _cutouts(levels: Sequence[list[Floats]], masks: Mask) -> tuple[list[_Cutout], Mask]:
    """Cut out what moves where most of it is left, image by image; and what then is left of the masks (T, H, W)."""
    rest, least = masks.copy(), LEAST * masks[0].size
    cutouts: list[_Cutout] = []
    sizes = masks.sum(axis=(1, 2))
    enough, searched = np.maximum(ENOUGH * sizes, least), np.zeros(len(masks), bool)
    while len(cutouts) < MOST and (sizes > enough).any():
        key = int(np.argmax(sizes))
        labels, count = ndimage.label(ndimage.binary_opening(masks[key]))
        for label in range(1, count + 1):
            part = labels == label
            if (part & rest[key]).sum() > max(ENOUGH * part.sum(), least):
                rows, columns = np.nonzero(part)
                cutouts.append(_followed(levels, masks, key, np.stack([columns, rows], axis=1)))
                rest &= ~cutouts[-1].explained
        searched[key] = True
        sizes = np.where(searched, 0, rest.sum(axis=(1, 2)))
    return cutouts, rest


def _show_nearest(cutouts: Sequence[_Cutout], seen: Mask) -> None:
    """Have each image show the cut-outs of the nearest images, and none where a nearer one explains the same: there
    seen (T, cut-outs) becomes False."""
    for t in range(len(seen)):
        known = np.zeros_like(cutouts[0].explained[t])
        for k in np.argsort([abs(cutout.key - t) for cutout in cutouts], kind="stable"):
            own = cutouts[k].explained[t]
            seen[t, k] &= (own & ~known).sum() > NEWS * own.sum()
            if seen[t, k]:
                known |= own
    for k, cutout in enumerate(cutouts):  # without a break
        runs = ndimage.label(seen[:, k])[0]
        seen[:, k] = runs == runs[cutout.key]


def _common_way(paths: Floats, seen: Mask, times: NDArray[np.float64]) -> Floats:
    """(T, 3) how far all tracks have moved on average since half of the clip: where none is seen at two times one after
    another, as fast as before and after."""
    lapses, steps, both = np.diff(times), np.diff(paths, axis=0), seen[1:] & seen[:-1]
    known = np.flatnonzero(both.any(axis=1) & (lapses > 0))
    if not len(known):
        return np.zeros_like(paths[:, 0])
    speeds = np.array([steps[t, both[t]].mean(axis=0) / lapses[t] for t in known], np.float64)
    filled = np.stack([np.interp(np.arange(len(lapses)), known, axis) for axis in speeds.T], axis=1)
    way = np.concatenate([np.zeros((1, 3)), np.cumsum(filled * lapses[:, None], axis=0)])
    return (way - way[len(way) // 2]).astype(np.float32)


def _levels(residual: Residual) -> list[Floats]:
    """For each of BLURS (H, W, 12): colors and mask, and their slopes along x and along y."""
    planes = np.concatenate([residual.image, residual.mask[..., None]], axis=2).astype(np.float32)
    blurred = (ndimage.gaussian_filter(planes, (blur, blur, 0)) for blur in BLURS)
    return [np.concatenate([each, *np.gradient(each, axis=(1, 0))], axis=2) for each in blurred]


def _followed(levels: Sequence[list[Floats]], masks: Mask, key: int, pixels: NDArray[np.int64]) -> _Cutout:
    """Follow a cut-out to both ends of the clip."""
    warp, at = _Warp(pixels), np.tile(pixels.astype(np.float32), (len(masks), 1, 1))
    seen, explained = np.zeros(len(masks), bool), np.zeros_like(masks)
    seen[key] = explained[key, pixels[:, 1], pixels[:, 0]] = True
    for way in (-1, 1):
        before = step = np.zeros((warp.basis.shape[1], 2))
        for t in range(key + way, len(masks) if way > 0 else -1, way):
            found, alike = _registered(levels[key], levels[t], warp, before + step)
            if alike < LOST:
                break
            at[t], seen[t] = pixels + warp.basis @ found, True
            step, before = found - before, found
            explained[t] = _explained(levels[key], levels[t], masks[t], pixels, at[t])
    return _Cutout(key, pixels, at, seen, explained)


class _Warp:
    """How the pixels (n, 2) of a cut-out may go: basis (n, 3 + k) @ weights (3 + k, 2) is how far, by an affine map and
    by bends at k knots. tension: (3 + k, 3 + k), what bends cost that differ from those at the knots beside them."""

    def __init__(self, pixels: NDArray[np.int64]) -> None:
        chosen = evenly_indices(len(pixels), COMPARED)
        self.pixels = pixels[chosen]
        middle, scale = self.pixels.mean(axis=0), max(float(self.pixels.std()), 1.0)
        inside = pixels - pixels.min(axis=0)
        knots = [np.linspace(0, most, max(2, 1 + round(most / KNOTS))) for most in np.maximum(inside.max(axis=0), 1)]
        across, down = (np.maximum(0, 1 - np.abs(inside[:, i, None] - at) / at[1]) for i, at in enumerate(knots))
        bends = (across[:, :, None] * down[:, None]).reshape(len(pixels), -1)
        self.basis = np.concatenate([(pixels - middle) / scale, np.ones((len(pixels), 1)), bends], axis=1)
        self.compared = self.basis[chosen].astype(np.float32)
        steps = [np.diff(np.eye(len(at)), axis=0) for at in knots]
        beside = np.kron(steps[0].T @ steps[0], np.eye(len(knots[1])))
        beside += np.kron(np.eye(len(knots[0])), steps[1].T @ steps[1])
        self.tension = np.pad(TENSION * beside, ((3, 0), (3, 0)))


def _registered(source: list[Floats], target: list[Floats], warp: _Warp, weights: Weights) -> tuple[Weights, float]:
    """How a cut-out goes to another image, near `weights`, and the share of its pixels that look alike there."""
    x, y = warp.pixels.T
    height, width = source[0].shape[:2]
    weights = weights.copy()
    for blur, there, here in zip(BLURS, target, source, strict=True):
        wanted, count = here[y, x, :4], 3 if blur == BLURS[0] else len(weights)
        basis, tension = warp.compared[:, :count], warp.tension[:count, :count]
        for _ in range(8):
            at = (warp.pixels + warp.compared @ weights).T
            inside = (at >= 0).all(axis=0) & (at[0] <= width - 1) & (at[1] <= height - 1)
            sampled = _sampled(there, at)
            difference = sampled[:, :4] - wanted
            size = np.sqrt(np.square(difference[:, :3]).sum(axis=1))
            weight = (inside / (1 + np.square(size / ALIKE))).astype(np.float32)
            slopes = sampled[:, 4:].reshape(-1, 2, 4).transpose(0, 2, 1)
            J = (slopes[..., None] * basis[:, None, None]).reshape(-1, 2 * count)
            weighted = J * np.repeat(weight, 4)[:, None]
            H = (weighted.T @ J).astype(np.float64)
            scale = np.trace(H) / len(H)
            stiff = np.diag([STIFF, STIFF, 0.01 * STIFF, *[STIFF] * (count - 3)])
            slope = (weighted.T @ difference.ravel()).reshape(2, count) + scale * weights[:count].T @ tension
            H += np.kron(np.eye(2), scale * (stiff + tension)) + 1e-6 * np.eye(len(H))
            change = np.linalg.solve(H, slope.ravel()).reshape(2, count)
            weights[:count] -= change.T
            if np.abs(change).max() < 0.02:
                break
    alike = float((inside & (size < ALIKE) & (sampled[:, 3] > 0.5)).sum() / max(inside.sum(), 1))
    return weights, alike if inside.mean() > VISIBLE else 0.0


def _sampled(planes: Floats, at: NDArray[np.float64]) -> Floats:
    """(n, C) of planes (H, W, C) at columns and rows (2, n), interpolated; at its rim beyond an image."""
    height, width, channels = planes.shape
    x, y = np.clip(at[0], 0, width - 1.001), np.clip(at[1], 0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    a, b = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
    flat, first = planes.reshape(-1, channels), row * width + column
    above = flat[first] * (1 - a) + flat[first + 1] * a
    below = flat[first + width] * (1 - a) + flat[first + width + 1] * a
    return above * (1 - b) + below * b


def _explained(source: list[Floats], target: list[Floats], mask: Mask, pixels: NDArray[np.int64], at: Floats) -> Mask:
    """(H, W) the moving pixels of another image that look like those of a cut-out that come to lie there."""
    result = np.zeros_like(mask)
    rows, columns = np.nonzero(mask)
    distances, nearest = cKDTree(at).query(np.stack([columns, rows], axis=1), distance_upper_bound=NEAR)
    rows, columns, nearest = (each[np.isfinite(distances)] for each in (rows, columns, nearest))
    x, y = pixels[nearest].T
    alike = np.abs(source[1][y, x, :3] - target[1][rows, columns, :3]).max(axis=1) < ALIKE
    result[rows, columns] = alike
    return result


def _depths(mask: Mask, depth: Floats) -> Floats:
    """(H, W) the depth of each moving pixel: of the ground below what is connected; NaN elsewhere."""
    result = np.full(mask.shape, np.nan, np.float32)
    free = np.where(ndimage.binary_dilation(mask, iterations=2), np.nan, depth)
    labels, count = ndimage.label(mask)
    for label in range(1, count + 1):
        part = labels == label
        rows, columns = np.nonzero(part)
        if len(rows) < LEAST * mask.size:
            continue
        lowest = np.full(mask.shape[1], -1)
        lowest[columns] = rows  # ascending
        at = np.flatnonzero((lowest >= rows[-1] - FOOT * (np.ptp(rows) + 1)) & (lowest < len(mask) - FAR_BELOW))
        ground = free[lowest[at] + FAR_BELOW, at]
        if not len(ground) or np.isfinite(ground).mean() < 0.3:  # below the image
            ring = ndimage.binary_dilation(part, iterations=8)
            ground = np.sort(free[ring])[: max(1, int(0.3 * ring.sum()))]
        behind = depth[part][np.isfinite(depth[part])]
        nearest = [np.nanmedian(ground)] if np.isfinite(ground).any() else []
        nearest += [np.quantile(behind, HIDDEN)] if len(behind) else []
        if nearest:
            result[part] = BEFORE * min(nearest)
    return result


def _placed(cutout: _Cutout, images: Sequence[Residual], depths: Sequence[Floats], most: int) -> tuple[Floats, Floats]:
    """The paths (T, n, 3) and colors (n, 3) of a cut-out, of so many points at most."""
    picked = evenly_indices(len(cutout.pixels), most)
    (x, y), at = cutout.pixels[picked].T, cutout.at[:, picked].transpose(0, 2, 1)
    height, width = depths[0].shape
    seen = np.flatnonzero(cutout.seen).tolist()
    inverse: dict[int, float] = {}
    for t in seen:
        column, row = np.rint(at[t]).astype(np.int64).clip(0, [[width - 1], [height - 1]])
        near = depths[t][row, column]
        if np.isfinite(near).any():
            inverse[t] = np.float64(1.0) / np.nanmedian(near)
    depth = np.ones(len(images))
    if inverse:  # nearly a line over a few times
        filled = np.interp(np.arange(len(images)), list(inverse), list(inverse.values()))
        depth = 1 / ndimage.gaussian_filter1d(ndimage.median_filter(filled, 9, mode="nearest"), 3.0, mode="nearest")
    paths = np.zeros((len(images), len(picked), 3), np.float32)
    for t in seen:
        paths[t] = points_at(images[t].camera, at[t].T + 0.5, depth[t : t + 1])
    return paths, images[cutout.key].image[y, x].astype(np.float32)
