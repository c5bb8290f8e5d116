"""The timing of a capture, refined while training: by how much its images are early or late.

Films lose and repeat frames, and scenes are rendered from animations of another frame rate, so motion that is even in
the world goes by jerks in the images. A field that is smooth in time then fits no image. Of each training image, the
shift in time that fits it best follows by least squares (a step of Gauss-Newton) from pictures of a moment shortly
before and shortly after its own. What the images around it have in common is the field's delay, not theirs, and is left
to the field. Images that are measured have the timing between those of the training.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import View, composite
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import EVEN, Timing
from lapgs_wgpu.train.distributed import Ranks

# Of gaps between images (the usual one), before and after: at which pictures are compared, and the largest step.
REACH = 0.5
FARTHEST = 1.5  # gaps between images, of a moment from its time
LEAST = 0.05  # share of an image's squared error that its shift must take away; of even films few shifts do
AROUND = 8  # images before and after one, whose median shift is the field's delay


class TimingRefinement:
    """How the timing of a scene is learnt.

    Args:
        scene: whose timing it is.
        views: of the training.
        truth: the image (H, W, 3) of a view; NaN where it does not count.
        picture: the scene's picture (H, W, 3) of a view, which is compared with it.
        gap: the usual distance in time of two images of a camera.
        ranks: which share the work.
    """

    def __init__(
        self,
        scene: Scene4D,
        views: Sequence[View],
        truth: Callable[[View], Tensor],
        picture: Callable[[View], Tensor],
        gap: float,
        ranks: Ranks,
    ) -> None:
        self._scene, self._truth, self._picture, self._ranks = scene, truth, picture, ranks
        self._times = np.unique([view.time for view in views])
        self._views = [[view for view in views if view.time == t] for t in self._times.tolist()]
        self._gap = gap
        self._moments = np.array([scene.timing(t) for t in self._times.tolist()])

    def fitted(self, number: int) -> NDArray[np.float64]:
        """(T,) all moments a step on. number: of the step, from 0 on: of several views of a time, it takes one.

        The same bits on every run of one adapter and driver. Raises InputError where an image cannot be read.
        """
        mine = torch.zeros(len(self._times), 2, dtype=torch.float64)
        for row in range(len(mine))[self._ranks.rank :: self._ranks.count]:
            views = self._views[row]
            mine[row] = torch.tensor(self._fit(views[number % len(views)], float(self._moments[row])))
        shifts, mended = self._ranks.all_reduce_sum([mine])[0].numpy().T
        shifts = shifts - running_median(shifts, AROUND)
        shifts[shifts**2 * mended < LEAST] = 0.0
        moved = self._moments + self._gap * shifts.clip(-REACH, REACH)
        farthest = FARTHEST * self._gap
        moved = np.clip(moved, self._times - farthest, self._times + farthest)
        return np.maximum.accumulate(np.clip(moved, 0.0, 1.0))

    def set(self, moments: NDArray[np.float64]) -> None:
        """Give the scene its timing. moments: (T,), never descending."""
        self._moments = moments
        self._scene.timing = EVEN if (moments == self._times).all() else Timing(self._times, moments)

    def _fit(self, view: View, moment: float) -> tuple[float, float]:
        """How much later the moment is that fits a view best, in gaps between images; and the share of the view's
        squared error that goes with a shift by one gap, as the square of the shift."""
        gap = self._gap
        first, last = max(moment - REACH * gap, 0.0), min(moment + REACH * gap, 1.0)
        before, now, after = (self._at(view, each).double() for each in (first, moment, last))
        truth = self._truth(view).double()
        counts = ~truth.isnan()
        error, speed = (now - truth)[counts], ((after - before) * (gap / (last - first)))[counts]
        along, size, whole = (float(a @ b) for a, b in ((speed, error), (speed, speed), (error, error)))
        return (-along / size, size / whole) if size > 0 and whole > 0 else (0.0, 0.0)

    def _at(self, view: View, moment: float) -> Tensor:
        """The picture of a view at a moment."""
        known = self._scene.timing
        self._scene.timing = Timing(np.array([view.time]), np.array([moment]))
        try:
            return self._picture(view)
        finally:
            self._scene.timing = known

    def report(self) -> dict[str, float]:
        """Of the moments' differences from their times: root mean square and largest, in gaps between images."""
        apart = np.abs(self._moments - self._times) / self._gap
        return {"frames": float(np.sqrt(np.mean(apart**2))), "frames_most": float(apart.max())}

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on."""
        return {"moments": torch.from_numpy(self._moments)}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from what `state` gave. Raises ValueError where it is of another capture."""
        moments = state["moments"].numpy()
        if moments.shape != self._moments.shape or moments.dtype != np.float64:
            raise ValueError(f"its moments are {moments.dtype} of shape {moments.shape}")
        if not (((moments >= 0) & (moments <= 1)).all() and (np.diff(moments) >= 0).all()):
            raise ValueError("its moments do not rise from 0 to 1")
        self.set(moments)


def image_to_fit(view: View, color: Tensor) -> Tensor:
    """The image (H, W, 3) of a training view on a background (3,); NaN where the loss ignores it. Raises InputError."""
    image = torch.from_numpy(composite(view.load(), color.numpy()).astype(np.float32) / 255)
    ignored = view.load_ignored()
    return image if ignored is None else image.masked_fill(torch.from_numpy(ignored)[..., None], torch.nan)


def running_median(values: NDArray[np.float64], around: int) -> NDArray[np.float64]:
    """(N,) of each value and at most `around` before and after it, equally many."""
    reach = [min(around, i, len(values) - 1 - i) for i in range(len(values))]
    return np.array([np.median(values[i - r : i + r + 1]) for i, r in enumerate(reach)])
