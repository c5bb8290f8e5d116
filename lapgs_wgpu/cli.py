"""The command lapgs-train."""

from __future__ import annotations

import sys
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path

from lapgs_wgpu.command import guarded, print_devices
from lapgs_wgpu.errors import InputError, pip_install
from lapgs_wgpu.progress import say
from lapgs_wgpu.train_options import parse_options

if typing.TYPE_CHECKING:
    from lapgs_wgpu.data import Dataset
    from lapgs_wgpu.gpu.device import Device
    from lapgs_wgpu.motion.scene import Scene4D
    from lapgs_wgpu.run import Watch
    from lapgs_wgpu.train.config import Config
    from lapgs_wgpu.train.distributed import Ranks
    from lapgs_wgpu.train.lpips import Lpips

# Of the keys, what goes with --eval: where the pictures lie now, and how they are read. The size must be the run's own.
EVAL_KEYS = ("data.path", "data.size", "data.split", "data.background", "data.cache_gb")
# And with --resume: where they and their masks lie now, on another machine.
RESUME_KEYS = ("data.path", "data.masks", "data.cache_gb")


def train_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-train: returns the exit code."""
    return guarded("lapgs-train", _train, list(sys.argv[1:] if arguments is None else arguments))


def _train(arguments: list[str]) -> None:
    if "--list-devices" in arguments:
        print_devices()
        return
    from lapgs_wgpu.train.presets import config_keys, load_config

    given = parse_options(arguments)
    from lapgs_wgpu.gpu.device import open_device  # what follows needs torch, which takes seconds to import
    from lapgs_wgpu.run import train
    from lapgs_wgpu.train.distributed import join_ranks
    from lapgs_wgpu.train.run_folder import check_run_folder, result_text

    overrides = {key.name: given[key.name] for key in config_keys() if key.name in given}
    if given["eval"]:
        _evaluate(Path(given["eval"]), given, overrides)
        return
    if given["motion_from"]:
        raise InputError("--motion-from goes with --eval RUN, after the training.")
    lpips = _lpips(given)
    ranks = join_ranks()
    watch = None
    if given["view"]:
        from lapgs_wgpu.viewer import live

        if ranks.first:
            live.check_window()  # before anything is written or replaced
        watch = live.watch
    if given["resume"]:
        _resume(Path(given["resume"]), given, overrides, watch, ranks, lpips)
        return
    if given["preset"] is None:
        raise InputError("name a preset, such as tiny, and the data to train on; lapgs-train --help says more.")
    ablate = [part.strip() for part in (given["ablate"] or "").split(",") if part.strip()]
    config = load_config(given["preset"], overrides, method=given["field"], ablate=ablate)
    default = f"runs/{_scene_name(config)}-{Path(given['preset']).stem}"
    out = Path(default if given["out"] is None else given["out"])
    if ranks.first:
        check_run_folder(out, overwrite=given["overwrite"])
    device = open_device(given["device"], number=ranks.local_rank)
    config, dataset = _open_data(config, out.parent, ranks)
    train(config, dataset, out, device=device, overwrite=given["overwrite"], watch=watch, ranks=ranks, lpips=lpips)
    if ranks.first:
        say(result_text(out))


def _resume(
    run: Path,
    given: dict[str, typing.Any],
    overrides: dict[str, typing.Any],
    watch: Watch | None,
    ranks: Ranks,
    lpips: Lpips | None,
) -> None:
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.run import resume
    from lapgs_wgpu.train.presets import load_config
    from lapgs_wgpu.train.run_folder import changes_since, check_same_data, result_text

    names = ("preset", "field", "ablate", "out", "overwrite")
    others = _others(given, names, [key for key in overrides if key not in RESUME_KEYS])
    if others:
        raise InputError(f"--resume goes on as the run began, so {others[0]} cannot be given.")
    _check_files("--resume", "a run", run / "config.toml")
    config = load_config(str(run / "config.toml"), overrides)
    _check_capture(run, config)
    device = open_device(given["device"], number=ranks.local_rank)
    config, dataset = _open_data(config, run.parent, ranks)
    if "data.path" in overrides:
        check_same_data(run, config.data.path, dataset)
    for what, before, now in changes_since(run, config, device, dataset) if ranks.first else ():
        print(f"lapgs-train: {what} was {before} when {run} began and is {now}: bits may differ.", file=sys.stderr)
    resume(config, dataset, run, device=device, watch=watch, ranks=ranks, lpips=lpips)
    if ranks.first:
        say(result_text(run))


def _others(given: dict[str, typing.Any], names: Sequence[str], keys: Iterable[str]) -> list[str]:
    """Those of the options `names` that were given, and the keys, as they stand on the command line."""
    words = [given[name] if name == "preset" else f"--{name}" for name in names if given[name]]
    return words + [f"--{key}" for key in keys]


def _evaluate(run: Path, given: dict[str, typing.Any], overrides: dict[str, str | list[str]]) -> None:
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.io.safe_json_toml import read_json
    from lapgs_wgpu.motion.scene import load
    from lapgs_wgpu.run import evaluate_run
    from lapgs_wgpu.train import plots
    from lapgs_wgpu.train.distributed import SINGLE_PROCESS
    from lapgs_wgpu.train.presets import load_config
    from lapgs_wgpu.train.run_folder import check_same_data, result_text

    names = ("preset", "field", "ablate", "out", "resume", "overwrite", "view")
    others = _others(given, names, [key for key in overrides if key not in EVAL_KEYS])
    if others:
        raise InputError(f"--eval measures a run as it is, so {others[0]} cannot be given.")
    lpips = _lpips(given)
    _check_files("--eval", "a finished run", run / "config.toml", run / "checkpoint.ply")
    size = load_config(str(run / "config.toml")).data.size
    config = load_config(str(run / "config.toml"), {**overrides, "data.masks": ""})  # which concern the training alone
    if config.data.size != size:
        raise InputError(
            f"--eval measures a run at its own size, so --data.size {config.data.size} cannot be given; "
            f"{run / 'config.toml'} says {size}."
        )
    _check_capture(run, config)
    device = open_device(given["device"])
    scene = load(run / "checkpoint.ply", device)
    config, dataset = _open_data(config, run.parent, SINGLE_PROCESS, normalize="placement" in scene.metadata)
    if "data.path" in overrides and "data.split" not in overrides:
        check_same_data(run, config.data.path, dataset)
    try:
        training = read_json(run / "metrics.json")["training"]
    except (InputError, KeyError, TypeError):
        step = scene.metadata.get("step", "")
        training = {"steps": int(step[:15]) if step.isascii() and step.isdigit() else 0}
    steps = config.schedule.steps
    done = training.get("steps") if isinstance(training, dict) else None
    if isinstance(done, int) and done < steps:
        print(f"note: {run} was interrupted; its checkpoint is of step {done} of {steps}.", file=sys.stderr)
    static = _static_fit(Path(given["motion_from"]), device) if given["motion_from"] else None
    evaluate_run(run, scene, dataset, config.data, training, lpips, static)
    if plots.available():
        plots.plot_run(run, scene)
    else:
        print(f"no plots: {pip_install('plots')} adds them to {run / 'eval'}.", file=sys.stderr)
    say(result_text(run))


def _lpips(given: dict[str, typing.Any]) -> Lpips | None:
    """LPIPS with the weights that were given. Raises InputError."""
    from lapgs_wgpu.train.lpips import Lpips

    return Lpips(Path(given["lpips_weights"])) if given["lpips_weights"] else None


def _static_fit(run: Path, device: Device) -> Scene4D:
    """The scene of a run that was trained without motion."""
    from lapgs_wgpu.motion.scene import load

    _check_files("--motion-from", "a finished run", run / "checkpoint.ply")
    scene = load(run / "checkpoint.ply", device)
    if scene.field_config.kind != "static":
        raise InputError(
            f"{run} has the field {scene.field_config.kind}; --motion-from needs a run trained with --field static."
        )
    return scene


def _check_files(option: str, what: str, *files: Path) -> None:
    for file in files:
        if not file.is_file():
            raise InputError(f"{file} does not exist; {option} needs the folder of {what}.")


def _check_capture(run: Path, config: Config) -> None:
    """Raises InputError where the capture of a run is gone."""
    from lapgs_wgpu.data.builtin import is_builtin

    if not is_builtin(config.data.path) and not Path(config.data.path).exists():
        raise InputError(
            f"{config.data.path}, the capture of {run / 'config.toml'}, does not exist; give --data the folder where "
            "it is now."
        )


def _scene_name(config: Config) -> str:
    from lapgs_wgpu.data.builtin import builtin_folder, is_builtin

    if is_builtin(config.data.path):
        return builtin_folder(config.data.path)
    return Path(config.data.path).resolve().name or "scene"


def _open_data(config: Config, parent: Path, ranks: Ranks, *, normalize: bool = True) -> tuple[Config, Dataset]:
    """The dataset, and the configuration with its folder. parent: folder for built-in scenes, which the first of
    several processes writes. normalize: of `load_dataset`."""
    from lapgs_wgpu.train.open_dataset import open_dataset, resolve_data

    if not ranks.first:
        ranks.barrier()  # waits for the first process, which writes the scene
    config = resolve_data(config, parent)
    if ranks.first:
        ranks.barrier()
    return config, open_dataset(config, normalize=normalize)


if __name__ == "__main__":  # lapgs-table starts its runs this way
    sys.exit(train_command())
