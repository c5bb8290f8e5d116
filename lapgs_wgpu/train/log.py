"""What a training tells while it runs: one progress line on the terminal, and log.jsonl in the run's folder."""

import json
import math
import time
from collections import Counter, deque
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from lapgs_wgpu.errors import InputError, quoted
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.progress import Progress, duration
from lapgs_wgpu.train.step_result import StepResult

INTERVAL = 50  # steps from one line of log.jsonl to the next, over which loss and PSNR are averaged


class Log(Progress):
    """Progress of a training, step by step. A context manager.

    docs/metrics.md describes the lines of log.jsonl. Their entry "timing" differs from run to run; all others repeat,
    except in the first line after a resumption, which averages the steps since then. Evaluations do not count as time
    of the training.

    path: of log.jsonl, which is written anew, or continued after the step `done`. before: seconds that the training
    took before its first step. quick: number of first steps that take less time than the others. terminal: stderr
    where None.
    """

    def __init__(
        self,
        path: Path,
        steps: int,
        *,
        done: int = 0,
        before: float = 0.0,
        quick: int = 0,
        terminal: TextIO | None = None,
    ) -> None:
        super().__init__(steps, "steps", terminal)
        self._path, self._quick = path, quick
        self._file, so_far = _continued(path, done)
        self._recent: deque[StepResult] = deque(maxlen=INTERVAL)
        self._fresh: list[StepResult] = []  # that were not yet asked what they tell
        self._start = time.perf_counter() - (so_far or before)
        self._began = self.seconds
        self._times: deque[float] = deque(maxlen=INTERVAL + 1)  # at which steps ended

    def __exit__(self, *error: object) -> None:
        if error[0] is not None:
            with suppress(Exception):  # one trouble is enough
                self._take_in()
        super().__exit__(*error)
        self._file.close()

    @property
    def seconds(self) -> float:
        """Since the start, motion discovery included, evaluations not."""
        return time.perf_counter() - self._start

    def step(self, result: StepResult, gaussians: int) -> None:
        """Take in a step that is done (the loss of a skipped one does not count), and the Gaussians after it."""
        step = result.step
        logged = step % INTERVAL == 0 or step == self._total
        self._fresh.append(result)
        self._times.append(self.seconds)
        if logged or self.due:
            self._take_in()
        if not self._recent:
            return
        if logged:
            means, rate = self._means(), round(self._steps_per_second(), 3)
            self._write_line({"step": step, **means, "gaussians": gaussians}, steps_per_second=rate)
        self.at(step, lambda: self._progress_line(step, gaussians))

    def _take_in(self) -> None:
        """Ask the last steps what they tell, which waits for those that the device is still doing."""
        for result in self._fresh:
            if result.skipped is not None:
                self.note(str(result.skipped))
            if math.isfinite(result.loss) and math.isfinite(result.psnr):
                self._recent.append(result)
        self._fresh.clear()

    def _steps_per_second(self) -> float:
        """Of the last steps. The first one, which compiles kernels, counts only while it is alone."""
        steps, since = (len(self._times) - 1, self._times[0]) if len(self._times) > 1 else (1, self._began)
        return steps / max(self._times[-1] - since, 1e-9)

    def _means(self) -> dict[str, Any]:
        count = len(self._recent)
        terms = Counter[str]()
        for each in self._recent:
            terms.update({name: value / count for name, value in each.terms.items()})
        return {
            "loss": round(sum(each.loss for each in self._recent) / count, 7),
            "psnr": round(sum(each.psnr for each in self._recent) / count, 4),
            "terms": {name: round(value, 9) for name, value in terms.items()},
        }

    def _progress_line(self, step: int, gaussians: int) -> str:
        psnr, rate = self._means()["psnr"], self._steps_per_second()
        left = duration((self._total - step) / rate) if len(self._times) > 1 or step == self._total else "?"
        if step < self._quick:
            left = f"more than {left}"
        return f"step {step}/{self._total}  {psnr:5.2f} dB  {gaussians} Gaussians  {rate:.1f} steps/s  {left} left"

    def discovered(self, summary: str) -> None:
        """Take in what motion discovery found, before the first step."""
        self._write_line({"step": 0, "discovery": summary})

    def evaluated(self, step: int, psnr: float, views: str, seconds: float) -> None:
        """Take in the mean PSNR (dB) of views ("val" or "train") after a step, and how long it took to measure."""
        self._start += seconds
        self._write_line({"step": step, "val_psnr": round(psnr, 4), "val_views": views})
        shown = {"val": "validation", "train": "training"}[views]
        self.note(f"step {step}: {psnr:.2f} dB on the {shown} views")

    def _write_line(self, line: dict[str, Any], **timing: float) -> None:
        line["timing"] = {"seconds": round(self.seconds, 3), **timing}
        try:
            self._file.write((json.dumps(line) + "\n").encode())
        except OSError as error:
            raise InputError(
                f"{self._path}: not written ({error.strerror or error}); free some space or check the disk, then "
                f"lapgs-train --resume {quoted(self._path.parent)} goes on from the last saved state"
            ) from error


def _continued(path: Path, done: int) -> tuple[BinaryIO, float]:
    """The log of the first `done` steps, open at its end, and the seconds that they took."""
    kept, seconds = [], 0.0
    if done:
        # A damaged log is no reason to stop.
        with suppress(OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            for text in path.read_text(encoding="utf-8").splitlines():
                line = json.loads(text)
                if line["step"] <= done:
                    kept.append(text + "\n")
                    seconds = min(max(float(line["timing"]["seconds"]), 0.0), 1e9)
    with atomic_write(path) as file:
        file.write("".join(kept).encode())
    return path.open("ab", buffering=0), seconds  # a line is one write, and none waits for a later one to fail
