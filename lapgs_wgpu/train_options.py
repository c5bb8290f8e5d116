"""The options of lapgs-train: a fixed part, and an option for each key of the configuration."""

from __future__ import annotations

import argparse
import functools
import typing

from lapgs_wgpu.command import DEVICE_HELP, LIST_DEVICES_HELP, HelpFormatter, Parser
from lapgs_wgpu.errors import InputError

# Short names for the keys that are given most often.
SHORTCUTS = {
    "data.path": "--data",
    "schedule.steps": "--steps",
    "schedule.batch": "--batch",
    "data.cache_gb": "--cache-gb",
}
USAGE = "lapgs-train PRESET --data DIR [--out RUN] [--KEY VALUE ...]"
DESCRIPTION = """\
Train a 4D Gaussian splatting model of a moving scene on a folder of images, on any Vulkan, Metal or D3D12 adapter.

  lapgs-train demo --data synthetic             built-in scene; takes minutes on a CPU
  lapgs-train tiny --data motion:path=4         built-in scene that measures motion (docs/metrics.md)
  lapgs-train tiny --data DIR                   D-NeRF scene at 200x200 pixels, with settings for a CPU
  lapgs-train dnerf --data DIR --out RUN        D-NeRF scene as in the paper (800x800 pixels)
  lapgs-train dnerf-400 --data DIR              D-NeRF scene at 400x400 pixels, some hours on two CPU cores
  lapgs-train hypernerf --data DIR              Nerfies or HyperNeRF capture; for a CPU: hypernerf-tiny
  lapgs-train neu3d --data DIR                  several static cameras; for a CPU: neu3d-tiny
  lapgs-train hypernerf-tiny --data DIR         your own film, converted by lapgs-prepare (see its --help)
  lapgs-train RUN/config.toml --out RUN2        repeat a run
  lapgs-train --resume RUN                      continue an interrupted training
  lapgs-train --eval RUN                        evaluate RUN/checkpoint.ply on the test views again

The run folder receives config.toml, log.jsonl, metrics.json, checkpoint.ply (any 3DGS viewer opens it as a static
scene) and eval/ with images: ground truth | rendering | 4 x error.

[Values in brackets] are defaults: those of the built-in preset on the command line, as in lapgs-train tiny --help,
otherwise those of dnerf. World units are those of the scene after it was moved and scaled into the presets' cube, from
-1.3 to 1.3 along each axis; D-NeRF's own scenes keep their coordinates. "With discovery" means: if the training starts
with motion discovery (discovery.enabled). Learning rates are those of Adam. "The paper" is "Laplacian Analysis Meets
Dynamics Modelling"."""


_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", bool: "true|false"}


def parse_options(arguments: list[str]) -> dict[str, typing.Any]:
    """Option name -> value; configuration keys by their dotted names, only those that were given. Raises InputError."""
    from lapgs_wgpu.io.dataclass_table import did_you_mean
    from lapgs_wgpu.train.presets import ABLATIONS, config_keys, load_config, preset_names

    shown = next((word for word in arguments if word in preset_names()), "dnerf")
    preset = load_config(shown)
    parser = Parser(
        "lapgs-train", usage=USAGE, description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False
    )
    # fmt: off
    add = parser.add_argument
    names, parts = ", ".join(preset_names()), "; ".join(f"{name} ({text})" for name, (text, _, _) in ABLATIONS.items())
    add("preset", nargs="?", metavar="PRESET",
        help=f"preset configuration: {names} (names with a scene, such as hypernerf-broom, have the settings published "
        "for that scene), or the path of a .toml file: RUN/config.toml, or your own, which starts with base = "
        '"dnerf" or another preset, and names what differs')
    add("--field", metavar="NAME", help="method: static (3DGS, no motion), mlp (deformable 3DGS), hexplane (4D-GS), "
        "grid4d (Grid4D) or laplacian (the paper's). All but laplacian also turn off the paper's losses (loss.pyramid, "
        "loss.ncc) and its adaptive split (density.split); they have no dynamics attributes; all else stays as in the "
        "preset [the preset's]")
    add("--ablate", metavar="PART[,PART]", help=f"turn off parts of the paper's method, comma-separated: {parts}")
    add("--out", metavar="RUN", help="run folder for all output; must be new or empty, but for --overwrite "
        "[runs/SCENE-PRESET in the current folder; SCENE: name of the capture's folder]")
    add("--resume", metavar="RUN", help="continue the interrupted training in run folder RUN from its last saved "
        "state, with its own configuration. Can be combined with --view, --device, --lpips-weights, --cache-gb, "
        "--data (where the capture is now) and --data.masks (where its masks are) only")
    add("--overwrite", action="store_true", help="replace an existing run in the run folder: its files are deleted, "
        "other files stay")
    add("--view", action="store_true", help="watch the training in a window; P pauses it, S takes a single step; the "
        "training goes on when the window is closed")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--list-devices", action="store_true", help=LIST_DEVICES_HELP)
    add("--eval", metavar="RUN", help="evaluate the finished run in folder RUN again, without training; overwrites "
        "metrics.json, metrics.csv and the images in eval/. Can be combined with --data, --data.split, "
        "--data.background, --cache-gb, --device, --lpips-weights and --motion-from only")
    add("--lpips-weights", metavar="FILE", help="also compute LPIPS (VGG) in the evaluation with the weights in FILE, "
        "a .safetensors file (docs/metrics.md)")
    add("--motion-from", metavar="RUN", help="with --eval: find the moving pixels, for their metrics, by comparing the "
        "test images with the renderings of RUN, a static fit of the same capture (--field static; docs/metrics.md), "
        "in place of the median of still cameras")
    # fmt: on
    groups: dict[str, argparse._ArgumentGroup] = {}
    for name, kind, about in config_keys():
        section = name.split(".")[0] if "." in name else "general"
        if section not in groups:
            groups[section] = parser.add_argument_group(f"{section} [defaults of the preset {shown}]")
        entries = len(typing.get_args(kind)) if typing.get_origin(kind) is tuple else None
        value = functools.reduce(getattr, name.split("."), preset)
        text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        text = text.lower() if kind is bool else text
        groups[section].add_argument(
            *([SHORTCUTS[name]] if name in SHORTCUTS else []),
            f"--{name}",
            dest=name,
            nargs=entries,
            metavar=_METAVARS.get(kind) or ("INT" if entries else "|".join(typing.get_args(kind))),
            default=argparse.SUPPRESS,
            help=f"{about} [{text}]".removesuffix(" []").replace("%", "%%"),
        )
    known, unknown = parser.parse_known_args(arguments)
    if unknown:
        word = unknown[0].split("=")[0]
        options = [name for action in parser._actions for name in action.option_strings]
        what = f"there is no option {word}" if word.startswith("-") else f"{word!r} is one word too many"
        raise InputError(f"{what}{did_you_mean(word, options, '; lapgs-train --help lists the options.')}")
    return vars(known)
