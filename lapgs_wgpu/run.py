"""A run from start to end: a configuration and a capture become a trained scene in its run folder."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from lapgs_wgpu.data.initial_gaussians import first_points
from lapgs_wgpu.data.validation import check_in_view, check_spacing, check_times
from lapgs_wgpu.data.views import Dataset, spread_views
from lapgs_wgpu.discovery.discover import start_training
from lapgs_wgpu.errors import DeviceError, InputError, NumericalError, quoted
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.io.folder_lock import locked_folder
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.progress import say
from lapgs_wgpu.train import run_folder
from lapgs_wgpu.train.camera_refinement import corrected_views, held_out_corrections
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.evaluate import Lpips, evaluate, write_metrics
from lapgs_wgpu.train.host import keep_freed_memory, return_freed_memory
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.step_result import StepResult
from lapgs_wgpu.train.trainer import Trainer

PROBES = 2048  # points of the scene that say whether a camera sees it
TRAINING_VIEWS = 8  # that are measured during the training where there are no validation views
OUTSIDE = 0.05  # warn if this share of the Gaussians, or more, is outside the encoder's box
STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # Ctrl-C, kill, a terminal that closes, Windows' Ctrl-Break

# Takes over a training's steps, such as a viewer does: called with the checkpoint's path, the scene, where to look at
# it from, and the steps, of which it takes as many as it likes, each one a step. The rest follows when it returns.
Watch = Callable[[Path, Scene4D, InitialView, Iterator[StepResult]], None]


def train(
    config: Config,
    dataset: Dataset,
    out: str | Path,
    *,
    device: Device | None = None,
    overwrite: bool = False,
    watch: Watch | None = None,
    parts: Parts | None = None,
    lpips: Lpips | None = None,
) -> Scene4D:
    """Train on a dataset, evaluate on its test views, and leave config.toml, log.jsonl, metrics.json, checkpoint.ply
    and eval/ in the folder `out`, which must be new or empty, or hold an earlier run when `overwrite` is set.

    device: the default adapter where None. parts: what Python gives the training (docs/api.md). lpips: of the
    evaluation. The same configuration, pictures, adapter and driver give the same checkpoint to the last byte, watched
    or not, interrupted and resumed or not. Raises InputError before anything is written where the input is not usable,
    and KeyboardInterrupt after Ctrl-C or SIGTERM, when checkpoint and state of the last whole step have been written.
    DeviceError, NumericalError and whatever else ends a step go on to the caller when that state has been written.
    """
    out = Path(out)
    if not dataset.test:
        raise InputError(f"{dataset.name} has no test view, by which a run is measured; add images to the capture.")
    found = check_times(dataset, moving=config.field.kind != "static") + check_spacing(dataset)
    found += check_in_view(dataset, first_points(dataset, PROBES, config.points.box, config.seed)[0])
    run_folder.check_run_folder(out, overwrite=overwrite)
    keep_freed_memory()
    device = device or open_device()
    with locked_folder(out):
        run_folder.check_run_folder(out, overwrite=overwrite)  # again: another training may have written it meanwhile
        if dataset.summary:
            say(f"capture: {dataset.summary}")
        for warning in (*dataset.warnings, *found):
            print(f"warning: {warning}", file=sys.stderr, flush=True)
        if dataset.normalization is not None:
            say(f"normalization: {dataset.normalization}")
        training = start_training(config, dataset, device, parts=parts)
        run_folder.start_run_folder(out, training.user_config, training.scene.device, dataset)
        if training.discovery is not None:
            say(f"discovery: {training.discovery}; {training.discovery_seconds:.0f} s")
        say(f"steps: {training.steps_are}")
        return _run(training, out, watch, lpips)


def resume(
    config: Config,
    dataset: Dataset,
    out: str | Path,
    *,
    device: Device | None = None,
    watch: Watch | None = None,
    parts: Parts | None = None,
    lpips: Lpips | None = None,
) -> Scene4D:
    """Go on with an interrupted training of this configuration and dataset in its run folder, from its last saved
    state, or from the start where it has none. Otherwise as `train`."""
    out = Path(out)
    measured, unfinished = (out / "metrics.json").exists(), (out / run_folder.STATE).is_file()
    if measured and not unfinished:  # --eval measures interrupted runs, too
        raise InputError(f"{out} is finished: there is nothing to resume.")
    keep_freed_memory()
    device = device or open_device()
    with locked_folder(out):
        state = run_folder.load_state(out)
        if state is None and (out / "checkpoint.ply").exists():
            missing = f"no state to go on from ({run_folder.STATE}); copy that file, too, or train anew"
            raise InputError(f"{out} holds a checkpoint, but {missing}.")
        run_folder.note_paths(out, config)
        if state is None:
            training = start_training(config, dataset, device, parts=parts)
        else:
            training = Trainer(config, dataset, device, parts=parts)
            try:
                run_folder.check_state(state, views=len(dataset.train), steps=config.schedule.steps)
                training.restore(state)
            except (IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
                reason = f"{type(error).__name__}: {error}".splitlines()[0]
                raise InputError(f"{out}: its state and its config.toml do not belong together ({reason}).") from error
        return _run(training, out, watch, lpips)


def _outside(scene: Scene4D) -> str:
    """A warning where the hash grids do not cover the canonical means of many Gaussians; else nothing."""
    bound = scene.field_config.bound
    count = int((scene.parameters["means"].detach().abs() > bound).any(dim=1).sum())
    if not isinstance(scene.field, GridField) or count < OUTSIDE * len(scene):
        return ""
    return (
        f"warning: {count} of {len(scene)} Gaussians lie outside the field's box of half side {bound:g}, where it "
        "cannot tell one from another and moves all alike; where something moves there, or a background trembles, "
        "raise field.bound."
    )


def _run(training: Trainer, out: Path, watch: Watch | None, lpips: Lpips | None) -> Scene4D:
    """The steps that are left, with all that a run folder receives."""
    config, scene = training.config, training.scene
    schedule, before = config.schedule, training.discovery_seconds
    log = Log(out / "log.jsonl", schedule.steps, done=training.done, before=before, quick=schedule.half_size_steps)
    with log, stop_requests() as interrupted:
        if training.discovery is not None:
            log.discovered(training.discovery)
        steps = _steps(training, out, log, interrupted)
        if watch is not None:
            watch(out / "checkpoint.ply", scene, training.initial_view, steps)
        for _ in steps:
            pass
        if not training.whole:  # nothing of it may be saved
            raise RuntimeError(f"step {training.done + 1} broke off halfway, and what watched it kept its error.")
        done, all_steps = training.done, config.schedule.steps
        measured: dict[str, Any] = {"steps": done, "seconds": round(log.seconds, 3)}
        if done == all_steps and (outside := _outside(scene)):
            log.note(outside)
        for name, refinement in (("cameras", training.cameras), ("image_times", training.timing)):
            if refinement is not None:
                measured[name] = refinement.report()
                log.note(refinement.summary.format(**measured[name]))
        if training.cameras is not None and (corrections := held_out_corrections(training.cameras, training.dataset)):
            measured["cameras"]["test_views"] = corrections

    return_freed_memory()
    run_folder.save_state(out, training.state())
    training.save(out / "checkpoint.ply")
    going_on = f"lapgs-train --resume {quoted(out)} goes on."
    if done < all_steps:
        held = f"{out / 'checkpoint.ply'} holds it"
        raise KeyboardInterrupt(f"stopped after step {done} of {all_steps}; {held}, and {going_on}")
    try:
        evaluate_run(out, scene, training.dataset, config.data.background, measured, lpips)
    except KeyboardInterrupt:
        stopped = "stopped after the last step, while the test views were measured"
        raise KeyboardInterrupt(f"{stopped}; {going_on}") from None
    run_folder.drop_states(out)
    return scene


def _steps(training: Trainer, out: Path, log: Log, interrupted: threading.Event) -> Iterator[StepResult]:
    """Take the steps that are left, until `interrupted` is set, and log them. At their intervals, measure the PSNR of
    validation views, or of some training views, and save the state in `out`, as an error does."""
    config, data = training.config, training.dataset
    eval_interval, save_interval, last = config.eval.interval, config.schedule.save_interval, config.schedule.steps
    name, views = ("val", data.val) if data.val else ("train", spread_views(data.train, TRAINING_VIEWS))
    try:
        while training.done < last and not interrupted.is_set():
            result = training.step()
            log.step(result, len(training.scene))
            if eval_interval and result.step % eval_interval == 0:
                start = time.perf_counter()
                log.evaluated(result.step, training.psnr(views), name, time.perf_counter() - start)
            if save_interval and result.step % save_interval == 0 and result.step < last:
                run_folder.save_state(out, training.state())
            yield result
    except Exception as error:
        told = _saved(training, out)
        if isinstance(error, DeviceError | NumericalError):
            raise type(error)(f"{error}{told}") from error
        if isinstance(error, MemoryError):  # numpy has its own
            raise MemoryError(f"{error}{told}") from error
        raise
    finally:
        training.close()


def _saved(training: Trainer, out: Path) -> str:
    """Save the state of a training that cannot go on, if it has one worth saving; what a user should know of it."""
    if training.whole and training.done:
        with suppress(DeviceError):  # which has the newest parameters, and gives nothing any more
            try:
                run_folder.save_state(out, training.state())
            except InputError as error:  # no second trouble instead of the first
                return f" (and {error})"
            return f"; stopped after step {training.done}, from which lapgs-train --resume {quoted(out)} goes on."
    if (out / run_folder.STATE).is_file():
        return f"; lapgs-train --resume {quoted(out)} goes on from the state that was saved last."
    return "; nothing was saved yet."


@contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """An event that STOP_SIGNALS set until the block ends, instead of an exception in the middle of a step.

    The second one of a kind raises KeyboardInterrupt, but for SIGHUP: a shell repeats what the system has sent. Where
    SIGHUP is ignored (as by nohup) it stays so. Only the main thread may listen to signals; in others nothing happens.
    """
    hangup = getattr(signal, "SIGHUP", None)
    requested, seen = threading.Event(), set[int]()

    def take(number: int, frame: FrameType | None) -> None:
        if number in seen and number != hangup:
            raise KeyboardInterrupt
        seen.add(number)
        requested.set()

    before = {}
    with suppress(ValueError):
        for number in (getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)):
            if number != hangup or signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, take)
    try:
        yield requested
    finally:
        for number, own in before.items():
            signal.signal(number, own)


def evaluate_run(
    out: Path, scene: Scene4D, dataset: Dataset, background: str, training: dict[str, Any], lpips: Lpips | None = None
) -> None:
    """Evaluate on the test views (`evaluate`); write metrics.json and eval/ of a run folder. training: goes into
    metrics.json as it is; `cameras.test_views`, if there, corrects the views' cameras."""
    folder = out / "eval"
    if folder.is_symlink():
        raise InputError(f"{folder} is a link, and images are written into the run's own folder only; remove it.")
    folder.mkdir(exist_ok=True)
    views = corrected_views(dataset.test, training.get("cameras", {}).get("test_views", {}))
    metrics = evaluate(scene, views, background, folder, lpips=lpips)
    write_metrics(out, {**metrics, "training": training})
