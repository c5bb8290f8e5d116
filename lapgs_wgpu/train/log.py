"""What a training tells while it runs: one progress line on the terminal, and log.jsonl in the run's folder."""

from __future__ import annotations

import json
import math
import platform
import subprocess
import time
from collections import deque
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, TextIO

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion
from lapgs_wgpu.progress import Progress, duration

INTERVAL = 50  # steps from one line of log.jsonl to the next, over which loss and PSNR are averaged
_MOST_SECONDS = 1e9  # that a training takes


class Log:
    """Progress of a training, step by step. A context manager.

    path: log.jsonl, written anew, or continued after the step `done`. Each line holds step, loss, psnr (dB, training
    views) and gaussians, and the frequencies and amplitudes of the motion's spectrum where there is one, all of which
    repeat from run to run, but for the first line after a resumption, which averages what came since; and under
    "timing" seconds and steps_per_second, which do not. An evaluation during the training has a line of its own: step,
    val_psnr, val_views ("val" or "train") and "timing". Its time does not count as time of the training.
    """

    def __init__(self, path: Path, steps: int, *, done: int = 0, terminal: TextIO | None = None) -> None:
        self._steps = steps
        self._progress = Progress(steps, "steps", terminal)
        self._path = path
        self._file, before = _continued(path, done)
        self._recent: deque[tuple[float, float]] = deque(maxlen=INTERVAL)
        now = time.perf_counter()
        self._start = now - before
        self._times: deque[float] = deque([now], maxlen=INTERVAL + 1)

    def __enter__(self) -> Log:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.__exit__(kind, error, traceback)
        self._file.close()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.perf_counter() - self._start

    def step(
        self, step: int, loss: float, psnr: float, gaussians: int, spectrum: LaplacianMotion | None = None
    ) -> None:
        """Take in a step that is done (counted from 1); the loss of one that was skipped does not count."""
        now = time.perf_counter()
        if math.isfinite(loss) and math.isfinite(psnr):
            self._recent.append((loss, psnr))
        self._times.append(now)
        if not self._recent:
            return
        rate = (len(self._times) - 1) / max(now - self._times[0], 1e-9)
        if step % INTERVAL == 0 or step == self._steps:
            mean_loss, mean_psnr = (sum(values) / len(self._recent) for values in zip(*self._recent, strict=True))
            line = {
                "step": step,
                "loss": round(mean_loss, 7),
                "psnr": round(mean_psnr, 4),
                "gaussians": gaussians,
                **(_spectrum(spectrum) if spectrum else {}),
                "timing": {"seconds": round(now - self._start, 3), "steps_per_second": round(rate, 3)},
            }
            self._write(json.dumps(line) + "\n")

        def text() -> str:
            smooth = sum(psnr for _, psnr in self._recent) / len(self._recent)
            left = duration((self._steps - step) / rate)
            return (
                f"step {step}/{self._steps}  {smooth:5.2f} dB  {gaussians} Gaussians  {rate:.1f} steps/s  {left} left"
            )

        self._progress.at(step, text)

    def evaluated(self, step: int, psnr: float, views: str, seconds: float) -> None:
        """Take in the mean PSNR (dB) of views after a step, and how long it took to measure."""
        self._start += seconds
        self._times = deque((at + seconds for at in self._times), maxlen=self._times.maxlen)
        timing = {"seconds": round(self.seconds, 3)}
        self._write(json.dumps({"step": step, "val_psnr": round(psnr, 4), "val_views": views, "timing": timing}) + "\n")
        self.tell(f"step {step}: {psnr:.2f} dB on the {'validation' if views == 'val' else 'training'} views")

    def _write(self, line: str) -> None:
        try:
            self._file.write(line.encode())
        except OSError as error:
            raise InputError(
                f"{self._path}: not written ({error.strerror or error}); free some space or check the disk, then "
                f"lapgs-train --resume {self._path.parent} goes on from the last saved state"
            ) from error

    def tell(self, text: str) -> None:
        """A line of its own on the terminal."""
        self._progress.note(text)


def _continued(path: Path, done: int) -> tuple[BinaryIO, float]:
    """The log of the first `done` steps, open at its end, and the seconds that they took."""
    kept, seconds = [], 0.0
    if done:
        with suppress(
            OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError
        ):  # a damaged log is no reason to stop
            for text in path.read_text(encoding="utf-8").splitlines():
                line = json.loads(text)
                if line["step"] <= done:
                    kept.append(text + "\n")
                    seconds = min(max(float(line["timing"]["seconds"]), 0.0), _MOST_SECONDS)
    with atomic_write(path) as file:
        file.write("".join(kept).encode())
    return path.open("ab", buffering=0), seconds  # a line is one write, and none waits for a later one to fail


def _spectrum(motion: LaplacianMotion) -> dict[str, list[float]]:
    values = {"frequencies": motion.frequencies.detach(), "amplitudes": motion.amplitudes()}
    return {name: [round(value, 6) for value in tensor.tolist()] for name, tensor in values.items()}


def environment(device: Device) -> dict[str, str]:
    """With what a run was made: versions, adapter and driver, and the git revision where the code is a checkout."""
    packages = ("lapgs-wgpu", "torch", "wgpu", "numpy")
    found = {name.replace("-", "_"): metadata.version(name) for name in packages}
    found |= {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    found |= {"adapter": device.info.name, "backend": device.info.backend, "driver": device.info.driver}
    checkout = Path(__file__).parents[2]
    if (checkout / ".git").exists():
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
            found["revision"] = done.stdout.strip()
        except (OSError, subprocess.SubprocessError):
            pass  # no git here, or not ours to read: the versions must do
    return found
