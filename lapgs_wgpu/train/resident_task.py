"""What a resident step is given: a view, the rows that the device draws, and what the schedule says."""

from __future__ import annotations

from dataclasses import dataclass, field

from lapgs_wgpu.data.views import View
from lapgs_wgpu.motion.passes.samples import Samples
from lapgs_wgpu.train.step_result import Scheduled
from lapgs_wgpu.train.view_order import Mark


@dataclass
class Task:
    """A step to be taken.

    scheduled: what the schedule says. before, drawn: where the draws stood before its view and before its samples.
    view: of the training, on a background (3,). time: of the field. sh_degree: of the harmonics in use. rates: of the
    optimizer's groups, and of the frequencies. near, near_time: the places and the time that the smoothness loss
    compares; None in steps without it. even, even_times: those of the acceleration loss. counts: how many steps had
    moved each tensor before.
    """

    scheduled: Scheduled
    before: Mark
    drawn: Mark
    view: View
    background: tuple[float, float, float]
    time: float
    sh_degree: int
    rates: dict[str, float]
    frequency_rate: float
    near: Samples | None = None
    near_time: float = 0.0
    even: Samples | None = None
    even_times: tuple[float, float] = (0.0, 0.0)
    counts: dict[str, int] = field(default_factory=dict)
