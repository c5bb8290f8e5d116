"""The command lapgs-train. Its options: a fixed part, and one for each key of the configuration."""

from __future__ import annotations

import argparse
import dataclasses
import json
import operator
import re
import sys
import textwrap
import typing
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import UnionType

from lapgs_wgpu.command import DEVICE_HELP, LIST_DEVICES_HELP, Parser, guarded, print_devices
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.dataclass_table import did_you_mean
from lapgs_wgpu.progress import say
from lapgs_wgpu.train.presets import ABLATIONS, config_keys, load_config, preset_names

if typing.TYPE_CHECKING:
    from lapgs_wgpu.data import Dataset
    from lapgs_wgpu.gpu.device import Device
    from lapgs_wgpu.train.config import Config
    from lapgs_wgpu.train.evaluate import Lpips

Table = dict[str, typing.Any]
STARTING = ("preset", "field", "ablate", "out", "resume", "overwrite", "view")  # options that start a training
BESIDE = {  # of these and of the keys, what may be given with --eval (and data.movers), and with --resume
    "eval": ("data.path", "data.background", "data.cache_gb"),
    "resume": ("view", "data.path", "data.masks", "data.cache_gb"),
}

# Short names for the keys that are given most often.
SHORTCUTS = {"data.path": ["--data"], "schedule.steps": ["--steps"], "data.cache_gb": ["--cache-gb"]}
USAGE = "lapgs-train PRESET --data DIR [--out RUN] [--KEY VALUE ...]"
DESCRIPTION = """\
Train a 4D Gaussian splatting model of a moving scene on a folder of images, on any Vulkan, Metal or D3D12 adapter.

  lapgs-train demo --data synthetic             built-in scene; takes minutes on a CPU
  lapgs-train tiny --data DIR                   D-NeRF scene at 200x200 pixels, with settings for a CPU
  lapgs-train dnerf-400 --data DIR              D-NeRF scene at 400x400 pixels, some hours on two CPU cores
  lapgs-train dnerf --data DIR --out RUN        D-NeRF scene as in the paper (800x800 pixels)
  lapgs-train hypernerf --data DIR              Nerfies or HyperNeRF capture; for a CPU: hypernerf-tiny
  lapgs-train neu3d --data DIR                  several static cameras; for a CPU: neu3d-tiny
  lapgs-train rig-full --data DIR               calibrated cameras around what moves; for a CPU: rig
  lapgs-train film-full --data DIR              your own film and its masks/ (lapgs-prepare); for a CPU: film
  lapgs-train RUN/config.toml --out RUN2        repeat a run
  lapgs-train --resume RUN                      continue an interrupted training
  lapgs-train --eval RUN                        evaluate RUN/checkpoint.ply on the test views again

The run folder receives config.toml, log.jsonl, metrics.json, checkpoint.ply (any 3DGS viewer opens it as a static
scene) and eval/ with images: ground truth | rendering | 4 x error."""
KEYS = """\
keys of the configuration [in brackets: values of the preset {preset}]:
  "World units" are those of the scene after it was moved and scaled into the cube from -1.3 to 1.3; D-NeRF scenes keep
  their coordinates. "The cameras' extent" is 1.1 times the largest distance of a training camera from their mean. "With
  discovery" means: if the training starts with motion discovery (discovery.enabled). "The paper" is "Laplacian Analysis
  Meets Dynamics Modelling". Learning rates (rates, and .rate of others) are Adam's: they change exponentially, from or
  to 0 in a straight line, from .start to .end, which they reach at step .steps; with both 0, nothing changes."""
_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", bool: "true|false"}


def _train(arguments: list[str]) -> None:
    if "--list-devices" in arguments:
        print_devices()
        return
    options = parse_options(arguments)
    from lapgs_wgpu import run  # what follows needs torch, which takes seconds to import
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.train.evaluate import Lpips
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
    """Folder, configuration, capture and device of the run that --resume or --eval names. Raises InputError."""
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


def parse_options(arguments: list[str]) -> dict[str, typing.Any]:
    """Option name -> value; configuration keys by their dotted names, only those that were given. Raises InputError."""
    presets = preset_names()
    preset = next((word for word in arguments if word in presets), "dnerf")
    help_wanted = "-h" in arguments or "--help" in arguments
    parser = Parser("lapgs-train", DESCRIPTION, usage=USAGE, epilog=keys_help(preset) if help_wanted else None)
    # fmt: off
    add = parser.add_argument
    parts = "; ".join(f"{name} ({text})" for name, (text, _, _) in ABLATIONS.items())
    add("preset", nargs="?", metavar="PRESET",
        help=f"preset configuration: {', '.join(presets)} (names with a scene, such as hypernerf-broom, have the "
        "settings published for that scene), or the path of a .toml file: RUN/config.toml, or your own, which starts "
        'with base = "dnerf" or another preset, and names what differs')
    add("--field", metavar="NAME", help="method: static (3DGS, no motion), mlp (deformable 3DGS), hexplane (4D-GS), "
        "grid4d (Grid4D) or laplacian (the paper's). All but laplacian also turn off the paper's losses (loss.pyramid, "
        "loss.ncc) and its adaptive split (density.split) [the preset's]")
    add("--ablate", metavar="PART[,PART]", help=f"turn off parts of the paper's method, comma-separated: {parts}")
    add("--out", metavar="RUN", help="run folder for all output; must be new or empty, unless --overwrite is given "
        "[runs/SCENE-PRESET in the current folder; SCENE: name of the capture's folder]")
    add("--resume", metavar="RUN", help="continue the interrupted training in run folder RUN from its last saved "
        "state. Can be combined with --view, --device, --lpips-weights, --cache-gb, --data (where the capture is now) "
        "and --data.masks (where its masks are) only")
    add("--overwrite", action="store_true", help="replace an existing run in the run folder; other files stay")
    add("--view", action="store_true", help="watch the training in a window; P pauses it, S takes a single step; the "
        "training goes on when the window is closed")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--list-devices", action="store_true", help=LIST_DEVICES_HELP)
    add("--eval", metavar="RUN", help="evaluate the checkpoint in folder RUN again; replaces metrics.json "
        "and the images in eval/. Takes --data, --data.background, --data.movers, --cache-gb, --device and "
        "--lpips-weights only")
    add("--lpips-weights", metavar="FILE", help="also compute LPIPS (VGG) in the evaluation with the weights in FILE, "
        "a .safetensors file (docs/metrics.md)")
    # fmt: on
    for name, (kind, _) in config_keys().items():
        entries = len(typing.get_args(kind)) if typing.get_origin(kind) is tuple else None
        words = [*SHORTCUTS.get(name, []), f"--{name}"]
        add(*words, dest=name, nargs=entries, default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    known, unknown = parser.parse_known_args(arguments)
    if unknown:
        word = unknown[0].split("=")[0]
        options = [name for action in parser._actions for name in action.option_strings]
        what = f"there is no option {word}" if word.startswith("-") else f"{word!r} is one word too many"
        raise InputError(f"{what}{did_you_mean(word, options, '; lapgs-train --help lists the options.')}")
    return vars(known)


def keys_help(preset: str) -> str:
    """The list of the keys of the configuration, those of no section first, with the values of a preset."""
    config, lines, section = load_config(preset), [KEYS.format(preset=preset)], None
    for name, (kind, text) in sorted(config_keys().items(), key=lambda key: "." in key[0]):
        *sections, _ = name.split(".")
        if sections[:1] != section:
            section = sections[:1]
            lines.append("")
        value = operator.attrgetter(name)(config)
        entries = value if isinstance(value, tuple) else (value,)
        shown = " ".join(entry if isinstance(entry, str) else json.dumps(entry) for entry in entries)
        kinds = typing.get_args(kind) or (kind,)
        literal = typing.get_origin(kind) is typing.Literal
        between = "|" if isinstance(kind, UnionType) else " "
        metavar = "|".join(kinds) if literal else between.join(_METAVARS[each] for each in kinds)
        option = f"{', '.join([*SHORTCUTS.get(name, []), f'--{name}'])} {metavar}"
        first, others = f"  {option:<38}  ", " " * 42
        text += f" [{shown}]" if shown else ""
        lines += textwrap.wrap(text, 120, initial_indent=first, subsequent_indent=others, break_on_hyphens=False)
    return "\n".join(lines)


train_command = partial(guarded, "lapgs-train", _train)

if __name__ == "__main__":
    sys.exit(train_command())
