"""Measures of where a capture's cameras stand, and of what moves before them: parallax, motion, coverage, time gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lapgs_wgpu.data.cloud import in_view
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.validation import GAP, GAP_FACTOR
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.masks import Mask
from lapgs_wgpu.prepare.measure import Floats, Look, Measure
from lapgs_wgpu.splat.camera import Camera

MOST_CAMERAS = 48  # between which angles are measured
PARALLAX = 5.0  # degrees; half a pixel of a phone's image is then 1 % of the depth
SPAN = 20.0  # degrees around what moves
CAMERAS = 3.0  # that see what moves at one moment
LITTLE, MUCH = 0.01, 0.5  # share of the images that moves
CUT = 0.3  # share of the images in which what moves reaches the image's edge
RIM = 0.045  # of the shorter side: as near to the edge masks come, since nothing is followed at the edge itself
SEEN = 0.002  # share of an image that moves, from which on it shows something that does


def parallax(cameras: Sequence[Camera], points: Floats) -> Measure:
    """The largest angle between two cameras that see a point, the median over the points."""
    chosen = evenly(cameras, MOST_CAMERAS)
    seen = np.stack([in_view(points, camera)[1] for camera in chosen])
    away = points - np.stack([camera.position for camera in chosen])[:, None]
    rays = np.where(seen[..., None], away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-12), np.nan)
    least = np.full(len(points), 1.0)
    for ray in rays:
        cosines = np.einsum("cni,ni->cn", rays, ray)
        least = np.fmin(least, np.fmin.reduce(cosines, axis=0))
    several = seen.sum(axis=0) > 1
    degrees = float(np.median(np.degrees(np.arccos(np.clip(least[several], -1, 1))))) if several.any() else 0.0
    return Measure(
        "parallax",
        degrees,
        f"{degrees:.1f} degrees between the two cameras furthest apart that see a point",
        f"{PARALLAX:g} or more",
        degrees >= PARALLAX,
        "walk around what moves instead of turning on the spot, or put the cameras further apart: depth is a guess",
    )


def motion(looks: Sequence[Look], still: bool, cameras: Sequence[Camera], points: Floats) -> list[Measure]:
    """Share of the images that moves; coverage of what moves; how often it is cut off."""
    masks = [look.mask for look in looks if look.mask is not None]
    share = float(np.mean([mask.mean() for mask in masks])) if masks else float("nan")
    unknown = "not known without masks of what moves, which lapgs-prepare makes of films"
    moves = Measure(
        "moving share",
        share,
        f"{share:.1%} of the image area moves" if masks else "not measured",
        f"{LITTLE:.0%} to {MUCH:.0%}",
        LITTLE <= share <= MUCH if masks else None,
        unknown
        if not masks
        else "film longer, or closer, or train with --field static: hardly anything moves"
        if share < LITTLE
        else "leave more of what stands still in the picture, since the cameras are placed by that",
    )
    found = [moves, _coverage_of_still(looks) if still else _coverage_of_moving(cameras, points)]
    showing = [mask for mask in masks if mask.mean() > SEEN]
    cut = float(np.mean([_touches_edge(mask) for mask in showing])) if showing else float("nan")
    cut_off = Measure(
        "cut off",
        cut,
        f"in {cut:.0%} of the images what moves reaches the image's edge" if showing else "not measured",
        f"{CUT:.0%} or less",
        cut <= CUT if showing else None,
        "keep what moves inside the picture, with room around it"
        if showing
        else unknown
        if not masks
        else "it is still",
    )
    return [*found, cut_off]


def _coverage_of_still(looks: Sequence[Look]) -> Measure:
    """Of cameras that stand still: how many see something move at one moment."""
    moments: dict[float, int] = {}
    for look in looks:
        shows = look.mask is not None and look.mask.mean() > SEEN
        moments[round(look.view.time, 6)] = moments.get(round(look.view.time, 6), 0) + shows
    moving = [count for count in moments.values() if count]
    cameras = float(np.median(moving)) if moving else 0.0
    return Measure(
        "coverage",
        cameras,
        f"{cameras:g} cameras see something move at one moment",
        f"{CAMERAS:g} or more",
        cameras >= CAMERAS,
        "aim more cameras at what moves: where less than three see it, its place in depth is a guess",
    )


def _coverage_of_moving(cameras: Sequence[Camera], points: Floats) -> Measure:
    """Of a camera that moves: the angle that it goes around the middle of the scene."""
    away = np.stack([camera.position for camera in cameras]) - np.median(points, axis=0)
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    degrees = float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1, 1))))
    return Measure(
        "coverage",
        degrees,
        f"the camera goes {degrees:.0f} degrees around the scene",
        f"{SPAN:g} or more",
        degrees >= SPAN,
        "walk further around what moves: its other sides stay empty, and few views of each side tell its depth",
    )


def _touches_edge(mask: Mask) -> bool:
    rim = max(1, round(RIM * min(mask.shape)))
    edge = np.concatenate(
        [
            *(part.any(axis=0) for part in (mask[:rim], mask[-rim:])),
            *(part.any(axis=1) for part in (mask[:, :rim], mask[:, -rim:])),
        ]
    )
    return bool(edge.mean() > 0.01)


def gaps(times: Floats) -> Measure:
    """The longest time without an image."""
    steps = np.diff(times)
    if not len(steps):
        raise InputError("all images have the same time, so nothing can move; film for a few seconds.")
    longest, usual = float(steps.max()), float(np.median(steps))
    at = float(times[int(np.argmax(steps))])
    return Measure(
        "time gaps",
        longest,
        f"{longest:.1%} of the clip without an image, {longest / usual:.1f} usual steps, from {at:.0%} on",
        f"{GAP:.0%} or less, or {GAP_FACTOR:g} usual steps",
        longest <= GAP or longest <= GAP_FACTOR * usual,
        "film without pauses and move slowly there: images were blurred, repeated, or could not be placed",
    )
