"""Pictures of what was learnt: training curves, the spectrum of the motion, dynamics, trajectories.

matplotlib draws them; it is an extra ("plots"), so it is imported only when a picture is made.
"""

from __future__ import annotations

import importlib.util
import json
import math
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from lapgs_wgpu.data.evenly import evenly_indices
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.motion.scene import Scene4D

if typing.TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.floating[Any]]

SAMPLE = 2000  # Gaussians among which those that move most are looked for
VISIBLE = 0.1  # opacity from which on a Gaussian's trajectory says something about the scene
TIMES = 64  # points of a trajectory
# Okabe and Ito's colors, which people with any color vision tell apart; without their yellow, too faint for lines.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
TIME_LABEL = "time t (0 to 1: the clip)"
FREQUENCY_LABEL = "frequency $f_k$ (cycles per clip)"
AMPLITUDE_LABEL = "amplitude $|c_k|$ (RMS over channels)"


def available() -> bool:
    """Whether matplotlib is there."""
    return importlib.util.find_spec("matplotlib") is not None


def plot_run(run: Path, scene: Scene4D) -> list[Path]:
    """Draw what a run folder's log.jsonl and its scene have to show into eval/plots/; returns the pictures."""
    folder = run / "eval" / "plots"
    folder.mkdir(parents=True, exist_ok=True)
    log, motion = _read_log(run / "log.jsonl"), scene.spectrum
    drawn = []

    def draw(name: str, function: typing.Callable[..., None], *values: Any) -> None:
        function(folder / name, *values)
        drawn.append(folder / name)

    if log:
        draw("training.png", training_curves, *_columns(log, "step", "loss", "psnr", "gaussians"))
    path = [line for line in log if {"frequencies", "amplitudes"} <= line.keys()]
    sizes = {len(line[name]) for line in path for name in ("frequencies", "amplitudes")}
    if len(path) > 1 and len(sizes) == 1:
        draw("spectrum-path.png", spectrum_path, *_columns(path, "step", "frequencies", "amplitudes"))
    if motion is not None:
        draw("spectrum.png", spectrum, motion.frequencies.numpy(force=True), motion.amplitudes().numpy(force=True))
    if "dynamics" in scene.parameters and len(scene):
        draw("dynamics.png", dynamics_histogram, scene.parameters["dynamics"].numpy(force=True))
    if scene.field is not None and len(scene):
        draw("trajectories.png", trajectories, *sample_trajectories(scene))
    return drawn


def _read_log(path: Path) -> list[dict[str, Any]]:
    """The lines of log.jsonl; those that are missing or damaged (the run was killed) have nothing to show."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
    read = []
    for line in lines:
        try:
            entry = json.loads(line)
            sound = all(math.isfinite(entry[name]) for name in ("step", "loss", "psnr", "gaussians"))
            for name in {"frequencies", "amplitudes"} & entry.keys():
                sound = sound and len(entry[name]) > 0 and all(math.isfinite(value) for value in entry[name])
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            continue
        if sound:
            read.append(entry)
    return read


def _columns(lines: Iterable[dict[str, Any]], *names: str) -> list[Floats]:
    return [np.asarray([line[name] for line in lines], np.float64) for name in names]


def sample_trajectories(scene: Scene4D) -> tuple[Floats, Floats]:
    """Times (T,) and the places (T, M, 3) of the M Gaussians that travel furthest among an even sample of all visible
    ones; the same for the same scene."""
    times = np.linspace(0, 1, TIMES)
    opacities = scene.parameters["opacity_logits"].detach().sigmoid().numpy(force=True)
    visible = np.flatnonzero(opacities >= VISIBLE)
    among = visible if len(visible) else np.arange(len(scene))
    sample = among[evenly_indices(len(among), SAMPLE)]
    with torch.no_grad():
        places = np.stack([scene.at(float(t)).means.numpy(force=True)[sample] for t in times])
    travelled = np.linalg.norm(np.diff(places, axis=0), axis=2).sum(axis=0)
    most = np.argsort(-travelled, kind="stable")[: len(COLORS)]
    return times, places[:, most]


def training_curves(path: Path, steps: ArrayLike, loss: ArrayLike, psnr: ArrayLike, gaussians: ArrayLike) -> None:
    """Loss, PSNR and number of Gaussians over the steps, each (S,)."""
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = _figure(7, 7)
    panels = figure.subplots(3, 1, sharex=True)
    shown = ((loss, "loss (mean over 50 steps)"), (psnr, "PSNR, training views (dB)"), (gaussians, "Gaussians"))
    for axes, (values, label), color in zip(panels, shown, COLORS, strict=False):
        axes.plot(steps, values, color=color, marker="." if np.size(steps) < 3 else None)
        axes.set_ylabel(label)
    panels[0].set_yscale("log")
    panels[0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panels[0].yaxis.set_major_formatter("{x:g}")  # 0.02 rather than 2 x 10^-2
    panels[0].yaxis.set_minor_formatter(NullFormatter())
    panels[2].yaxis.set_major_formatter("{x:,.0f}")
    panels[2].set_ylim(bottom=0)
    panels[2].set_xlabel("training step")
    _save(figure, path, "Training", panels)


def quality_curves(path: Path, curves: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Name of a run -> seconds of training and PSNR of the validation views, dB."""
    figure = _figure(7, 5)
    axes = figure.subplots()
    colors = _color_map(np.linspace(0, 0.9, len(curves)))
    for (name, curve), color in zip(curves.items(), colors, strict=True):
        axes.plot(*np.asarray(curve).T, color=color, marker=".", label=name)
    axes.set_xlabel("training with motion discovery (s)")
    axes.set_ylabel("PSNR, validation views (dB)")
    axes.legend()
    _save(figure, path, "Time to quality", [axes])


def spectrum(path: Path, frequencies: ArrayLike, amplitudes: ArrayLike) -> None:
    """Amplitudes over frequencies, both (K,)."""
    figure = _figure(7, 4)
    axes = figure.subplots()
    stems = axes.stem(frequencies, amplitudes, basefmt=" ")
    stems.stemlines.set_color(COLORS[0])
    stems.markerline.set_color(COLORS[0])
    axes.set_xlim(left=min(0.0, float(np.min(frequencies))))
    axes.set_ylim(bottom=0)
    axes.set_xlabel(FREQUENCY_LABEL)
    axes.set_ylabel(AMPLITUDE_LABEL)
    _save(figure, path, "Trained spectrum of the motion", [axes])


def spectrum_path(path: Path, steps: ArrayLike, frequencies: ArrayLike, amplitudes: ArrayLike) -> None:
    """How frequencies and amplitudes, both (S, K), went over the steps (S,)."""
    figure = _figure(7, 7)
    panels = figure.subplots(2, 1, sharex=True)
    frequencies, amplitudes = np.asarray(frequencies), np.asarray(amplitudes)
    # The color goes with the last frequency, from low to high: K may be too many for colors by name.
    order = np.argsort(np.argsort(frequencies[-1]))
    colors = _color_map(order / max(len(order) - 1, 1) * 0.9)
    for axes, values in zip(panels, (frequencies, amplitudes), strict=True):
        for k, color in enumerate(colors):
            axes.plot(steps, values[:, k], color=color)
    panels[0].set_ylabel(FREQUENCY_LABEL)
    panels[0].set_ylim(bottom=min(0.0, float(frequencies.min())))
    panels[1].set_ylabel(AMPLITUDE_LABEL)
    panels[1].set_ylim(bottom=0)
    panels[1].set_xlabel("training step")
    _save(figure, path, "Spectrum during the training, from low frequencies (dark) to high ones", panels)


def dynamics_histogram(path: Path, dynamics: ArrayLike) -> None:
    """How long the vectors d_i (N, D) are."""
    lengths = np.linalg.norm(np.asarray(dynamics), axis=1)
    figure = _figure(7, 4)
    axes = figure.subplots()
    axes.hist(lengths, bins=60, color=COLORS[0])
    median = float(np.median(lengths))
    axes.axvline(median, color=COLORS[1], linestyle="--", label=f"median {median:.3g}")
    axes.set_yscale("log")  # most Gaussians stand still: those that move would be no more than a line at the bottom
    axes.set_xlabel("length of the dynamics vector $\\|d_i\\|$ (no unit)")
    axes.set_ylabel("Gaussians")
    axes.legend()
    _save(figure, path, f"Dynamics of {len(lengths):,} Gaussians", [axes])


def trajectories(path: Path, times: ArrayLike, places: ArrayLike) -> None:
    """x, y and z over the times (T,) of positions (T, M, 3); M is at most len(COLORS)."""
    places = np.asarray(places)
    figure = _figure(7, 8)
    panels = figure.subplots(3, 1, sharex=True)
    for axis, axes in enumerate(panels):
        for place, color in zip(places[:, :, axis].T, COLORS, strict=False):
            axes.plot(times, place, color=color)
        axes.set_ylabel(f"{'xyz'[axis]} (world units)")
    panels[-1].set_xlabel(TIME_LABEL)
    panels[-1].set_xlim(0, 1)
    _save(figure, path, f"Trajectories of the {places.shape[1]} Gaussians that travel furthest", panels)


def _figure(width: float, height: float) -> Figure:
    """Of that many inches. A Figure without pyplot: no window, no state, the Agg canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _color_map(shares: Floats) -> Floats:
    """Colors (K, 4) of shares (K,) in [0, 1]: viridis, which grows lighter evenly."""
    from matplotlib import colormaps

    return np.asarray(colormaps["viridis"](shares))


def _save(figure: Figure, path: Path, title: str, panels: Sequence[Axes]) -> None:
    for axes in panels:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels(panels)
    figure.suptitle(title)
    with atomic_write(path) as file:
        figure.savefig(file, format="png")
