"""The command lapgs-train."""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
from collections.abc import Collection
from contextlib import suppress
from functools import partial
from pathlib import Path

from lapgs_wgpu.command import guarded, print_devices
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.progress import say
from lapgs_wgpu.train.presets import config_keys, load_config
from lapgs_wgpu.train_options import parse_options

if typing.TYPE_CHECKING:
    from lapgs_wgpu.data import Dataset
    from lapgs_wgpu.train.config import Config
    from lapgs_wgpu.train.lpips import Lpips

Table = dict[str, typing.Any]
EVAL_KEYS = ("data.path", "data.movers", "data.background", "data.cache_gb")  # keys that can be given with --eval
RESUME_KEYS = ("data.path", "data.masks", "data.cache_gb")  # and with --resume: where the capture is now


def _train(arguments: list[str]) -> None:
    if "--list-devices" in arguments:
        print_devices()
        return
    options = parse_options(arguments)
    from lapgs_wgpu import run  # what follows needs torch, which takes seconds to import
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.train.lpips import Lpips
    from lapgs_wgpu.train.run_folder import changes_since, check_run_folder, result_text

    overrides = {key: options[key] for key in config_keys() if key in options}
    lpips = Lpips(Path(options["lpips_weights"])) if options["lpips_weights"] else None
    watch = None
    if options["view"] and not options["eval"]:
        from lapgs_wgpu.viewer import live

        live.window.check_window("leave out --view")  # before anything is written or replaced
        watch = live.watch
    if options["eval"]:
        out = Path(options["eval"])
        _evaluate(out, options, overrides, lpips)
    elif options["resume"]:
        out = Path(options["resume"])
        _check_alone("resume", options, overrides.keys() - RESUME_KEYS, allowed=("view",))
        config = _config_of(out, overrides)
        device = open_device(options["device"])
        config, dataset = _open_data(config, out.parent, out if "data.path" in overrides else None)
        for what, before, now in changes_since(out, config, device, dataset):
            print(f"lapgs-train: {what} was {before} when {out} began and is {now}: bits may differ.", file=sys.stderr)
        run.resume(config, dataset, out, device=device, watch=watch, lpips=lpips)
    elif options["preset"] is None:
        raise InputError("name a preset, such as tiny, and the data to train on; lapgs-train --help says more.")
    else:
        ablate = [part.strip() for part in (options["ablate"] or "").split(",") if part.strip()]
        config = load_config(options["preset"], overrides, method=options["field"], ablate=ablate)
        scene = Path(config.data.path).resolve().name or "scene"
        out = Path(options["out"] or f"runs/{scene}-{Path(options['preset']).stem}")
        overwrite = options["overwrite"]
        check_run_folder(out, overwrite=overwrite)
        device = open_device(options["device"])
        config, dataset = _open_data(config, out.parent)
        run.train(config, dataset, out, device=device, overwrite=overwrite, watch=watch, lpips=lpips)
    say(result_text(out))


def _evaluate(run: Path, options: Table, overrides: Table, lpips: Lpips | None) -> None:
    from lapgs_wgpu.data import load_dataset
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.io.safe_json_toml import read_json
    from lapgs_wgpu.motion.scene import load
    from lapgs_wgpu.run import evaluate_run

    _check_alone("eval", options, overrides.keys() - EVAL_KEYS)
    movers = overrides.pop("data.movers", None)
    config = _config_of(run, {**overrides, "data.masks": ""})  # masks are for the training alone
    scene = load(run / "checkpoint.ply", open_device(options["device"]))
    config, dataset = _open_data(config, run.parent, run if "data.path" in overrides else None)
    if movers is not None:  # the world's coordinates follow the masks of the run
        given = load_dataset(config.data.path, image_size=config.data.size or None, movers=movers).test
        pairs = zip(dataset.test, given, strict=True)
        test = tuple(dataclasses.replace(view, moving=other.moving) for view, other in pairs)
        dataset = dataclasses.replace(dataset, test=test)
    step = scene.metadata.get("step", "")
    done, steps = int(step) if re.fullmatch("[0-9]{1,15}", step) else 0, config.schedule.steps
    if done < steps:
        print(f"note: {run} was interrupted; its checkpoint is of step {done} of {steps}.", file=sys.stderr)
    training: Table = {"steps": done}
    with suppress(ValueError, KeyError, TypeError):  # InputError is a ValueError
        training |= read_json(run / "metrics.json")["training"]
    evaluate_run(run, scene, dataset, config.data, training, lpips)


def _check_alone(option: str, options: Table, keys: Collection[str], allowed: Collection[str] = ()) -> None:
    """Raises InputError where --resume or --eval was given with an option that starts a training, or with keys."""
    starting = ("preset", "field", "ablate", "out", "resume", "overwrite", "view")
    given = [name for name in starting if options[name] and name not in (option, *allowed)]
    if given := [*given, *sorted(keys)]:
        word = repr(options["preset"]) if given[0] == "preset" else f"--{given[0]}"
        raise InputError(f"--{option} takes the configuration of the run as it is, so {word} cannot be given.")


def _config_of(run: Path, overrides: Table) -> Config:
    """The configuration of a run. Raises InputError where it or the run's capture is gone."""
    if not (run / "config.toml").is_file():
        raise InputError(f"{run / 'config.toml'} does not exist; --resume and --eval need the folder of a run.")
    config = load_config(str(run / "config.toml"), overrides)
    path = config.data.path
    if path != "synthetic" and not Path(path).exists():
        raise InputError(f"{path}, the capture of {run / 'config.toml'}, does not exist; give --data where it is now.")
    return config


def _open_data(config: Config, parent: Path, run: Path | None = None) -> tuple[Config, Dataset]:
    """The configuration with its data's folder, and the dataset. parent: folder for the built-in scene. run: whose
    capture it must be. Raises InputError."""
    from lapgs_wgpu.train.run_folder import check_same_data
    from lapgs_wgpu.train.setup import open_dataset, resolve_data

    config = resolve_data(config, parent)
    dataset = open_dataset(config)
    if run is not None:
        check_same_data(run, config.data.path, dataset)
    return config, dataset


train_command = partial(guarded, "lapgs-train", _train)

if __name__ == "__main__":
    sys.exit(train_command())
