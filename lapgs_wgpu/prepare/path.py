"""Signs of wrongly placed cameras: motion that no hand-held camera makes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lapgs_wgpu.prepare.poses import Floats

STEP, TURN = 8.0, 8.0  # largest step and turn over their medians
AROUND = 75.0  # degrees a second, around the middle of the scene, at most
FEWEST = 8  # images whose path is judged


def path_faults(places: Floats, axes: Floats, points: Floats, names: Sequence[str]) -> list[tuple[str, int]]:
    """The faults of a path, with the number of the image at which each is.

    places, axes: (n, 3) of the cameras and where they look, in the order of time. points: (N, 3) of the scene. names:
    of the images, which are milliseconds in films. Steps that are small beside the scene's distance are noise, of a
    camera that turns or stands.
    """
    if len(places) < FEWEST:
        return []
    steps = np.diff(places, axis=0)
    length = np.linalg.norm(steps, axis=1)
    away = float(np.median(np.linalg.norm(points - np.median(places, axis=0), axis=1)))
    usual = max(float(np.median(length)), 1e-3 * away)
    turns = np.degrees(np.arccos(np.clip((axes[1:] * axes[:-1]).sum(axis=1), -1, 1)))
    turn = max(float(np.median(turns)), 0.5)
    cosine = (steps[1:] * steps[:-1]).sum(axis=1) / np.maximum(length[1:] * length[:-1], 1e-12)
    back = (cosine < -0.5) & (np.minimum(length[1:], length[:-1]) > max(usual, 1e-2 * away))
    still = length < (0.02 * usual if np.median(length) == usual else 0.0)
    long = max(3, len(still) // 10)
    stalls = [i for i in range(len(still) - long + 1) if still[i : i + long].all()][:1]
    leaps, jerks = np.flatnonzero(length > STEP * usual).tolist(), np.flatnonzero(turns > TURN * turn).tolist()
    faults = [(f"a step of {length[i] / usual:.0f} times the usual one", i + 1) for i in leaps]
    faults += [(f"a turn of {turns[i]:.0f} degrees", i + 1) for i in jerks]
    faults += [("the path doubles back", i + 1) for i in np.flatnonzero(back).tolist()]
    faults += [("the path stalls", i) for i in stalls]
    stems = [Path(name).stem for name in names]
    if all(len(stem) == 8 and stem.isdecimal() for stem in stems):
        seconds = (int(stems[-1]) - int(stems[0])) / 1000
        around = (places[[0, -1]] - np.median(points, axis=0)) / away
        speed = np.degrees(2 * np.arcsin(min(float(np.linalg.norm(around[1] - around[0])) / 2, 1.0))) / seconds
        faults += [(f"{speed:.0f} degrees a second around the scene", 0)] * bool(speed > AROUND)
    return faults
