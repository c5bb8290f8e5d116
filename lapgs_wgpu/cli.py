"""The command lapgs-train."""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
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
    from lapgs_wgpu.gpu.device import Device
    from lapgs_wgpu.train.config import Config
    from lapgs_wgpu.train.lpips import Lpips

Table = dict[str, typing.Any]
STARTING = ("preset", "field", "ablate", "out", "resume", "overwrite", "view")  # options of a training that begins
BESIDE = {  # those and the keys that can be given with --eval, and with --resume: where the capture is now
    "eval": ("data.path", "data.background", "data.cache_gb"),
    "resume": ("view", "data.path", "data.masks", "data.cache_gb"),
}


def _train(arguments: list[str]) -> None:
    if "--list-devices" in arguments:
        print_devices()
        return
    options = parse_options(arguments)
    from lapgs_wgpu import run  # what follows needs torch, which takes seconds to import
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.train.lpips import Lpips
    from lapgs_wgpu.train.run_folder import changes_since, check_run_folder, result_text
    from lapgs_wgpu.train.setup import open_data

    overrides = {key: options[key] for key in config_keys() if key in options}
    lpips = Lpips(Path(options["lpips_weights"])) if options["lpips_weights"] else None
    watch = None
    if options["view"] and not options["eval"]:
        from lapgs_wgpu.viewer import live

        live.window.check_window("leave out --view")  # before anything is written or replaced
        watch = live.watch
    if options["eval"]:
        out = _evaluate(options, overrides, lpips)
    elif options["resume"]:
        out, config, dataset, device = _reopen("resume", options, overrides)
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
        config, dataset = open_data(config, out.parent)
        run.train(config, dataset, out, device=device, overwrite=overwrite, watch=watch, lpips=lpips)
    say(result_text(out))


def _evaluate(options: Table, overrides: Table, lpips: Lpips | None) -> Path:
    """Do what --eval says. Returns the folder of the run."""
    from lapgs_wgpu.data import load_dataset
    from lapgs_wgpu.io.safe_json_toml import read_json
    from lapgs_wgpu.motion.scene import load
    from lapgs_wgpu.run import evaluate_run

    movers = overrides.pop("data.movers", None)
    run, config, dataset, device = _reopen("eval", options, overrides)
    scene = load(run / "checkpoint.ply", device)
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
    evaluate_run(run, scene, dataset, config.data.background, training, lpips)
    return run


def _reopen(option: str, options: Table, overrides: Table) -> tuple[Path, Config, Dataset, Device]:
    """The folder of the run that --resume or --eval names, its configuration, its capture, and the device.

    Raises InputError where they are not there, or the option was given beside one that starts a training, or keys.
    """
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.train.run_folder import check_same_data
    from lapgs_wgpu.train.setup import open_data

    given = [name for name in STARTING if options[name]] + sorted(overrides)
    if given := [name for name in given if name not in (option, *BESIDE[option])]:
        word = repr(options["preset"]) if given[0] == "preset" else f"--{given[0]}"
        raise InputError(f"--{option} takes the configuration of the run as it is, so {word} cannot be given.")
    run = Path(options[option])
    file = run / "config.toml"
    if not file.is_file():
        raise InputError(f"{file} does not exist; --resume and --eval need the folder of a run.")
    config = load_config(file, overrides if option == "resume" else {**overrides, "data.masks": ""})
    path = config.data.path
    if path != "synthetic" and not Path(path).exists():
        raise InputError(f"{path}, the capture of {file}, does not exist; give --data where it is now.")
    device = open_device(options["device"])
    config, dataset = open_data(config, run.parent)
    if "data.path" in overrides:
        check_same_data(run, config.data.path, dataset)
    return run, config, dataset, device


train_command = partial(guarded, "lapgs-train", _train)

if __name__ == "__main__":
    sys.exit(train_command())
