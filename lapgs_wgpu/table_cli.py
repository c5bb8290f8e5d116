"""The command lapgs-table."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lapgs_wgpu.command import DEVICE_HELP, TIME_OVER, HelpFormatter, Parser, guarded
from lapgs_wgpu.errors import InputError

DESCRIPTION = """\
Train all runs of a table (scenes x rows x seeds, defined in SPEC.toml), and write their metrics as a table. A row is a
method, or the preset with some options changed.

  lapgs-table docs/tables/demo.toml --out runs/demo-table       built-in scene
  lapgs-table SPEC.toml --data DIR --out OUT                    your own table; repeated: trains the remaining runs
  lapgs-table --from A/results.json B/results.json              print a table of finished runs, without training

Each run has its own run folder, OUT/SCENE/ROW/seedN. OUT/results.json and OUT/table.md are updated after each run. A
run is skipped if its folder, OUT/results.json or a --from file has its results for the same configuration; one that was
interrupted goes on from its last saved state."""


def table_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-table: returns the exit code: 1 where runs failed, TIME_OVER where --hours ended it."""
    return guarded("lapgs-table", _table, list(sys.argv[1:] if arguments is None else arguments))


def options() -> Parser:
    """The parser of the command line."""
    parser = Parser("lapgs-table", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    # fmt: off
    add = parser.add_argument
    add("spec", nargs="?", metavar="SPEC.toml", help="table definition; docs/tables/demo.toml documents the format")
    add("--data", metavar="DIR", default=".", help="folder that contains the scenes' folders [.]")
    add("--out", metavar="OUT", help="output folder for the runs and the table; required with SPEC.toml")
    add("--from", metavar="FILE", nargs="+", default=[], dest="known", help="results.json files of lapgs-table; their "
        "runs are reused or, without SPEC.toml, printed")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--lpips-weights", metavar="FILE", help="also compute LPIPS (VGG) with the weights in FILE, a .safetensors "
        "file (docs/metrics.md); finished runs without it are measured again, if their checkpoint is there")
    add("--hours", type=float, metavar="H", help="stop within H hours, of which half a minute is kept for saving; the "
        "current run saves its state, and the same command continues it, also on another machine to which OUT was "
        f"copied; while runs are left, the exit code is {TIME_OVER}")
    add("--slim", action="store_true", help="delete checkpoint.ply and eval/ of each finished run, to save disk space")
    # fmt: on
    return parser


def _table(arguments: list[str]) -> int:
    given = options().parse_args(arguments)
    if given.spec and not given.out:
        raise InputError("name a folder for the runs and the table with --out.")
    if not given.spec and not given.known:
        raise InputError("name a SPEC.toml, or --from results.json; lapgs-table --help says more.")
    if given.hours is not None and not given.hours > 0:
        raise InputError(f"--hours must be a number above 0, got {given.hours:g}.")
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
    lpips = Path(given.lpips_weights).resolve() if given.lpips_weights else None
    if lpips is not None:
        from lapgs_wgpu.train.lpips import Lpips

        Lpips(lpips)  # only to learn now, and not from every run, that it cannot be read
    done = make_table(
        spec,
        Path(given.data),
        out,
        known=known,
        device=given.device,
        slim=given.slim,
        lpips=lpips,
        hours=given.hours,
    )
    over = "; the time is over, and the same command goes on" if done.stopped else ""
    print(f"{out / 'table.md'}: {done.finished} of {len(spec.runs)} runs{over}")
    for key, reason in done.failed.items():
        print(f"lapgs-table: {key} failed: {reason}", file=sys.stderr)
    return 1 if done.failed else TIME_OVER if done.stopped else 0
