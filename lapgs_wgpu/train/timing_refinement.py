"""The timing of a capture, refined while training: by how much its images are early or late.

Films lose and repeat frames, and scenes are rendered from animations of another frame rate, so motion that is even in
the world goes by jerks in the images. A field that is smooth in time then fits no image. Of each training image, the
shift in time that fits it best follows by least squares (a step of Gauss-Newton) from pictures of the scene shortly
before and shortly after. What the images around it have in common is the field's delay, not theirs, and is left to the
field. Images that are measured have the timing between those of the training.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import EVEN, Timing
from lapgs_wgpu.train.ground_truth import HostImage

# Distances in time are in gaps between images (the usual one).
LARGEST_SHIFT = 0.5  # of one step, and the distance before and after at which pictures are compared
FARTHEST = 1.5  # of a field time from its image's time
LEAST_GAIN = 0.05  # share of an image's squared error that its shift must take away; of even films few shifts do
AROUND = 8  # images before and after one, whose median shift is the field's delay


class TimingRefinement:
    """How the timing of a scene is learnt: for the time of each image the time of the field that the image shows.

    truth: the image of a view. picture: the scene's picture (H, W, 3) of a view at a time of the field, which is
    compared with it. gap: the usual distance in time of two images of a camera.
    """

    summary = (  # of `report`
        "the times of the training images were corrected by {frames:.2f} of the distance of two images (root mean "
        "square; at most {frames_most:.2f})."
    )

    def __init__(
        self,
        scene: Scene4D,
        views: Sequence[View],
        truth: Callable[[View], HostImage],
        picture: Callable[[View, float], Tensor],
        gap: float,
    ) -> None:
        self._scene, self._truth, self._picture, self._gap = scene, truth, picture, gap
        self._times = np.unique([view.time for view in views])
        self._views = [[view for view in views if view.time == t] for t in self._times.tolist()]

    @property
    def _field_times(self) -> NDArray[np.float64]:
        """(T,) of the field, at the times of the images."""
        timing = self._scene.timing
        if np.array_equal(timing.times, self._times):
            return timing.moments
        return np.array([timing(t) for t in self._times.tolist()])

    def fitted(self, number: int) -> Timing:
        """The timing a step on. number: of the step, from 0 on: of several views of a time, it takes one.

        The same bits on every run of one adapter and driver. Raises InputError where an image cannot be read.
        """
        before = self._field_times
        pairs = zip(self._views, before.tolist(), strict=True)
        fits = [self._fit(views[number % len(views)], now) for views, now in pairs]
        shifts, gains = np.array(fits).T
        shifts = shifts - running_median(shifts, AROUND)
        shifts[shifts**2 * gains < LEAST_GAIN] = 0.0
        moved = before + self._gap * shifts.clip(-LARGEST_SHIFT, LARGEST_SHIFT)
        farthest = FARTHEST * self._gap
        moved = np.clip(moved, self._times - farthest, self._times + farthest)
        moved = np.maximum.accumulate(np.clip(moved, 0.0, 1.0))
        return EVEN if (moved == self._times).all() else Timing(self._times, moved)

    def _fit(self, view: View, now: float) -> tuple[float, float]:
        """How much later the field time is that fits a view best, in gaps between images; and the share of the view's
        squared error that goes with a shift by one gap, as the square of the shift."""
        before, after = max(now - LARGEST_SHIFT * self._gap, 0.0), min(now + LARGEST_SHIFT * self._gap, 1.0)
        first, middle, last = (self._picture(view, t).double() for t in (before, now, after))
        truth, left_out = self._truth(view)
        counts = ~left_out[..., 0]
        error = (middle - truth.double())[counts].flatten()
        speed = ((last - first) * (self._gap / (after - before)))[counts].flatten()
        along, size, whole = (float(a @ b) for a, b in ((speed, error), (speed, speed), (error, error)))
        return (-along / size, size / whole) if size > 0 and whole > 0 else (0.0, 0.0)

    def report(self) -> dict[str, float]:
        """Differences of field times from image times: root mean square and largest, in gaps between images."""
        differences = np.abs(self._field_times - self._times) / self._gap
        return {"frames": float(np.sqrt(np.mean(differences**2))), "frames_most": float(differences.max())}


def running_median(values: NDArray[np.float64], around: int) -> NDArray[np.float64]:
    """(N,) of each value and at most `around` before and after it, equally many."""
    reach = [min(around, i, len(values) - 1 - i) for i in range(len(values))]
    return np.array([np.median(values[i - r : i + r + 1]) for i, r in enumerate(reach)])
