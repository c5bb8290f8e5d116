"""The commands lapgs-train and lapgs-table."""

from __future__ import annotations

import argparse
import functools
import json
import sys
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path

from lapgs_wgpu.command import HelpFormatter, Parser, guarded, print_devices
from lapgs_wgpu.errors import InputError

if typing.TYPE_CHECKING:
    from lapgs_wgpu.data import Dataset
    from lapgs_wgpu.gpu.device import Device
    from lapgs_wgpu.motion.scene import Scene4D
    from lapgs_wgpu.train.config import Config
    from lapgs_wgpu.train.distributed import Ranks
    from lapgs_wgpu.train.run import Watch

# Short names for the keys that are given most often.
SHORTCUTS = {
    "data.path": "--data",
    "schedule.steps": "--steps",
    "schedule.batch": "--batch",
    "data.cache_gb": "--cache-gb",
}
# Of the keys, what goes with --eval: where the pictures lie now, and how they are read. The size must be the run's own.
EVAL_KEYS = ("data.path", "data.size", "data.background", "data.cache_gb")

USAGE = "lapgs-train PRESET --data DIR [--out RUN] [--KEY VALUE ...]"
DESCRIPTION = """\
Train a moving scene on the pictures of a folder, on any Vulkan adapter.

  lapgs-train demo --data synthetic             the built-in scene, in minutes on a CPU
  lapgs-train tiny --data motion:path=4,cycles=2   a built-in scene that measures motion (docs/metrics.md)
  lapgs-train tiny --data DIR                   a D-NeRF scene at 200x200, sized for a CPU
  lapgs-train dnerf --data DIR --out RUN        the same with the paper's pictures and schedule
  lapgs-train hypernerf --data DIR              a capture of nerfies or HyperNeRF; for a CPU: hypernerf-tiny
  lapgs-train neu3d --data DIR                  several cameras that stand still; for a CPU: neu3d-tiny
  lapgs-train tiny --data DIR                   your own films: lapgs-prepare --help makes DIR of them
  lapgs-train RUN/config.toml --out RUN2        the same training once more
  lapgs-train --resume RUN                      go on with a training that was interrupted, or killed
  lapgs-train --eval RUN                        measure RUN/checkpoint.ply on the test views again

The run folder then holds config.toml, log.jsonl, metrics.json, checkpoint.ply (which any 3DGS viewer opens as a still)
and eval/ with pictures: ground truth | rendering | 4 x error."""


def train_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-train: returns the exit code."""
    return guarded("lapgs-train", _train, list(sys.argv[1:] if arguments is None else arguments))


def table_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-table: returns the exit code, 1 where runs failed."""
    return guarded("lapgs-table", _table, list(sys.argv[1:] if arguments is None else arguments))


def _train(arguments: list[str]) -> None:
    if "--list-devices" in arguments:
        print_devices()
        return
    from lapgs_wgpu.train.presets import config_keys, load_config

    given = _parse(arguments)
    from lapgs_wgpu.gpu.device import open_device  # what follows needs torch, which takes seconds to import
    from lapgs_wgpu.train.distributed import join_ranks
    from lapgs_wgpu.train.run import train
    from lapgs_wgpu.train.run_folder import check_run_folder

    overrides = {key.name: given[key.name] for key in config_keys() if key.name in given}
    if given["eval"]:
        _evaluate(Path(given["eval"]), given, overrides)
        return
    if given["lpips_weights"]:
        raise InputError("--lpips-weights goes with --eval RUN, after the training.")
    if given["motion_from"]:
        raise InputError("--motion-from goes with --eval RUN, after the training.")
    watch = None
    if given["view"]:
        from lapgs_wgpu.viewer import live

        watch = live.watch
    ranks = join_ranks()
    if given["resume"]:
        _resume(Path(given["resume"]), given, overrides, watch, ranks)
        return
    if given["preset"] is None:
        raise InputError("name a preset, such as tiny, and the data to train on; lapgs-train --help says more.")
    ablate = [part.strip() for part in (given["ablate"] or "").split(",") if part.strip()]
    config = load_config(given["preset"], overrides, method=given["field"], ablate=ablate)
    out = Path(given["out"] or f"runs/{_scene_name(config)}-{Path(given['preset']).stem}")
    if ranks.first:
        check_run_folder(out, overwrite=given["overwrite"])
    device = open_device(given["device"], number=ranks.on_machine)
    config, dataset = _open_data(config, out.parent, ranks)
    train(config, dataset, out, device=device, overwrite=given["overwrite"], watch=watch, ranks=ranks)
    if ranks.first:
        _report(out)


def _resume(
    run: Path, given: dict[str, typing.Any], overrides: dict[str, typing.Any], watch: Watch | None, ranks: Ranks
) -> None:
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.train.presets import load_config
    from lapgs_wgpu.train.run import resume
    from lapgs_wgpu.train.run_folder import changes_since

    others = _others(given, ("preset", "field", "ablate", "out", "overwrite"), overrides)
    if others:
        raise InputError(f"--resume goes on as the run began, so {others[0]} cannot be given.")
    if not (run / "config.toml").is_file():
        raise InputError(f"{run / 'config.toml'} does not exist; --resume needs the folder of a run.")
    config = load_config(str(run / "config.toml"))
    device = open_device(given["device"], number=ranks.on_machine)
    config, dataset = _open_data(config, run.parent, ranks)
    for what, before, now in changes_since(run, device, dataset) if ranks.first else ():
        print(f"lapgs-train: {what} was {before} when {run} began and is {now}: bits may differ.", file=sys.stderr)
    resume(config, dataset, run, device=device, watch=watch, ranks=ranks)
    if ranks.first:
        _report(run)


def _others(given: dict[str, typing.Any], names: Sequence[str], keys: Iterable[str]) -> list[str]:
    """Those of the options `names` that were given, and the keys, as they stand on the command line."""
    words = [given[name] if name == "preset" else f"--{name}" for name in names if given[name]]
    return words + [f"--{key}" for key in keys]


def _evaluate(run: Path, given: dict[str, typing.Any], overrides: dict[str, str | list[str]]) -> None:
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.io.documents import read_json
    from lapgs_wgpu.motion.scene import load
    from lapgs_wgpu.train import plots
    from lapgs_wgpu.train.lpips import Lpips
    from lapgs_wgpu.train.presets import load_config
    from lapgs_wgpu.train.run import evaluate_run

    names = ("preset", "field", "ablate", "out", "resume", "overwrite", "view")
    others = _others(given, names, [key for key in overrides if key not in EVAL_KEYS])
    if others:
        raise InputError(f"--eval measures a run as it is, so {others[0]} cannot be given.")
    lpips = Lpips(Path(given["lpips_weights"])) if given["lpips_weights"] else None
    for name in ("config.toml", "checkpoint.ply"):
        if not (run / name).is_file():
            raise InputError(f"{run / name} does not exist; --eval needs the folder of a finished run.")
    size = load_config(str(run / "config.toml")).data.size
    config = load_config(str(run / "config.toml"), overrides)
    if config.data.size != size:
        raise InputError(
            f"--eval measures a run at its own size, so --data.size {config.data.size} cannot be given; "
            f"{run / 'config.toml'} says {size}."
        )
    device = open_device(given["device"])
    scene = load(run / "checkpoint.ply", device)
    config, dataset = _open_data(config, run.parent, normalize="placement" in scene.metadata)
    try:
        training = read_json(run / "metrics.json")["training"]
    except (InputError, KeyError, TypeError):
        step = scene.metadata.get("step", "")
        training = {"steps": int(step[:15]) if step.isascii() and step.isdigit() else 0}
    static = _static_fit(Path(given["motion_from"]), device) if given["motion_from"] else None
    evaluate_run(run, scene, dataset, config.data.background, training, lpips, static)
    if plots.available():
        plots.plot_run(run, scene)
    else:
        print(f"no plots: pip install 'lapgs-wgpu[plots]' adds them to {run / 'eval'}.", file=sys.stderr)
    _report(run)


def _static_fit(run: Path, device: Device) -> Scene4D:
    """The scene of a run that was trained without motion."""
    from lapgs_wgpu.motion.scene import load

    if not (run / "checkpoint.ply").is_file():
        raise InputError(f"{run / 'checkpoint.ply'} does not exist; --motion-from needs the folder of a finished run.")
    scene = load(run / "checkpoint.ply", device)
    if scene.field_config.kind != "static":
        raise InputError(
            f"{run} has the field {scene.field_config.kind}; --motion-from needs a run trained with --field static."
        )
    return scene


def _report(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    views, size = len(metrics["views"]), metrics["size"]
    print(
        f"{run}: {metrics['psnr']:.2f} dB PSNR, {metrics['ssim']:.4f} SSIM on {views} test views of "
        f"{size[0]}x{size[1]}, {metrics['gaussians']} Gaussians"
    )


def _scene_name(config: Config) -> str:
    from lapgs_wgpu.data.builtin import builtin_folder, is_builtin

    if is_builtin(config.data.path):
        return builtin_folder(config.data.path)
    return Path(config.data.path).resolve().name or "scene"


def _open_data(
    config: Config, parent: Path, ranks: Ranks | None = None, *, normalize: bool = True
) -> tuple[Config, Dataset]:
    """The dataset, and the configuration with its folder. parent: folder for built-in scenes, which the first of
    several processes writes. normalize: of `load_dataset`."""
    import dataclasses

    from lapgs_wgpu.data import load_dataset
    from lapgs_wgpu.data.builtin import SYNTHETIC, is_builtin, write_builtin

    path = config.data.path
    if not path.isprintable():
        raise InputError(f"{path!r} holds characters that config.toml cannot record; rename the folder.")
    if not path:
        raise InputError(f"name the folder of the scene with --data DIR, or take --data {SYNTHETIC}.")
    if ranks is not None and not ranks.first:
        ranks.any(False)  # waits until the first has done so
    folder = write_builtin(path, parent) if is_builtin(path) else Path(path)
    if ranks is not None and ranks.first:
        ranks.any(False)
    dataset = load_dataset(folder, image_size=config.data.size or None, normalize=normalize)
    data = dataclasses.replace(config.data, path=str(folder.resolve()))
    return dataclasses.replace(config, data=data), dataset


TABLE_DESCRIPTION = """\
Train every run of a table (scenes x rows x seeds, as SPEC.toml names them) and write the table.

  lapgs-table docs/tables/demo.toml --out runs/demo-table       the built-in scene
  lapgs-table SPEC.toml --data DIR --out OUT                    once more after an interruption: the rest
  lapgs-table --from A/results.json B/results.json              the table of runs that are done, on stdout

OUT/SCENE/ROW/seedN are run folders of lapgs-train; OUT/results.json and OUT/table.md are written after every run. A run
counts as finished when its folder, OUT/results.json or a --from file holds it in the wanted configuration."""


def _table(arguments: list[str]) -> int:
    parser = Parser("lapgs-table", description=TABLE_DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    parser.add_argument("spec", nargs="?", metavar="SPEC.toml", help="the table, as docs/tables/demo.toml explains")
    parser.add_argument("--data", metavar="DIR", default=".", help="where the scenes' folders lie [.]")
    parser.add_argument("--out", metavar="OUT", help="folder of the runs and the table")
    parser.add_argument(
        "--from", metavar="FILE", nargs="+", default=[], dest="known", help="results.json of other runs"
    )
    parser.add_argument("--device", metavar="NAME", help="part of an adapter's name, or cpu, integrated, discrete")
    parser.add_argument("--slim", action="store_true", help="drop checkpoint.ply and eval/ of each run once done")
    given = parser.parse_args(arguments)
    if given.spec and not given.out:
        raise InputError("name a folder for the runs and the table with --out.")
    if not given.spec and not given.known:
        raise InputError("name a SPEC.toml, or --from results.json; lapgs-table --help says more.")
    from lapgs_wgpu.train.table import make_table
    from lapgs_wgpu.train.table_results import markdown, merge_results, read_results, write_results
    from lapgs_wgpu.train.table_spec import read_spec

    known = [read_results(Path(file)) for file in given.known]
    if not given.spec:
        results = merge_results(known)
        if given.out:
            there = Path(given.out, "results.json")
            if there.exists() and not any(there.samefile(file) for file in given.known):
                raise InputError(f"{there} would be lost; name it after --from, too, or take another folder.")
            there.parent.mkdir(parents=True, exist_ok=True)
            write_results(there.parent, results)
        print(markdown(results), end="")
        return 0
    spec, out = read_spec(Path(given.spec)), Path(given.out)
    failed = make_table(spec, Path(given.data), out, known=known, device=given.device, slim=given.slim)
    print(f"{out / 'table.md'}: {len(spec.runs) - len(failed)} of {len(spec.runs)} runs")
    for key, reason in failed.items():
        print(f"lapgs-table: {key} failed: {reason}", file=sys.stderr)
    return 1 if failed else 0


_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", bool: "true|false"}


def _parse(arguments: list[str]) -> dict[str, typing.Any]:
    from lapgs_wgpu.train.presets import ABLATIONS, config_keys, did_you_mean, load_config, preset_names

    shown = next((word for word in arguments if word in preset_names()), "dnerf")
    preset = load_config(shown)
    parser = Parser(
        "lapgs-train",
        usage=USAGE,
        description=DESCRIPTION,
        formatter_class=HelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "preset", nargs="?", metavar="PRESET", help=f"{', '.join(preset_names())}, or a .toml file, e.g. a run's"
    )
    parser.add_argument(
        "--field",
        metavar="NAME",
        help="method: static (3DGS), mlp (deformable 3DGS), hexplane (4D-GS) or grid4d, each without what only the "
        "paper's method has, or laplacian, the paper's [the preset's]",
    )
    parser.add_argument(
        "--ablate", metavar="PART[,PART]", help=f"parts of the paper's method to leave out: {', '.join(ABLATIONS)}"
    )
    parser.add_argument("--out", metavar="RUN", help="run folder, new or empty [runs/SCENE-PRESET]")
    parser.add_argument("--resume", metavar="RUN", help="go on with an interrupted training from its last saved state")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that lies in the run folder")
    parser.add_argument(
        "--view", action="store_true", help="watch the training in a window, where it can be paused and single-stepped"
    )
    parser.add_argument("--device", metavar="NAME", help="part of an adapter's name, or cpu, integrated, discrete")
    parser.add_argument("--list-devices", action="store_true", help="list the adapters, the default one first")
    parser.add_argument(
        "--eval",
        metavar="RUN",
        help="measure a finished run again, on the data it was trained on; --data, "
        "--data.background, --cache-gb, --device, --lpips-weights and --motion-from may go with it",
    )
    parser.add_argument(
        "--lpips-weights",
        metavar="FILE",
        help="with --eval: measure LPIPS (VGG), too (docs/metrics.md)",
    )
    parser.add_argument(
        "--motion-from",
        metavar="RUN",
        help="with --eval: measure the pixels where this static run of the same capture is wrong (docs/metrics.md)",
    )
    groups: dict[str, argparse._ArgumentGroup] = {}
    for name, kind, about in config_keys():
        section = name.split(".")[0] if "." in name else "general"
        if section not in groups:
            groups[section] = parser.add_argument_group(f"{section} [value of the preset {shown}]")
        entries = len(typing.get_args(kind)) if typing.get_origin(kind) is tuple else None
        value = functools.reduce(getattr, name.split("."), preset)
        text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        groups[section].add_argument(
            *([SHORTCUTS[name]] if name in SHORTCUTS else []),
            f"--{name}",
            dest=name,
            nargs=entries,
            metavar=_METAVARS.get(kind) or ("INT" if entries else "|".join(typing.get_args(kind))),
            default=argparse.SUPPRESS,
            help=f"{about} [{text}]".replace("%", "%%"),
        )
    known, unknown = parser.parse_known_args(arguments)
    if unknown:
        word = unknown[0].split("=")[0]
        options = [name for action in parser._actions for name in action.option_strings]
        what = f"there is no option {word}" if word.startswith("-") else f"{word!r} is one word too many"
        raise InputError(f"{what}{did_you_mean(word, options) or '; lapgs-train --help lists the options'}.")
    return vars(known)


if __name__ == "__main__":  # how lapgs-table starts each run
    sys.exit(train_command())
