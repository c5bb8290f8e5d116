"""The command lapgs-table."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lapgs_wgpu.command import DEVICE_HELP, HelpFormatter, Parser, guarded
from lapgs_wgpu.errors import InputError

DESCRIPTION = """\
Train all runs of a table (scenes x rows x seeds, defined in SPEC.toml), and print the means of their metrics. A row is
a method, or the preset with some keys changed. docs/tables/demo.toml describes the format.

  lapgs-table docs/tables/demo.toml --out runs/demo-table       built-in scene
  lapgs-table SPEC.toml --data DIR --out OUT                    your own table

Each run has its own run folder, OUT/SCENE/ROW/seedN; OUT/results.json holds the results of all finished runs. The same
command again skips the runs that are finished and resumes the one that was interrupted."""


def table_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-table: returns the exit code, 1 where a run failed."""
    return guarded("lapgs-table", _table, list(sys.argv[1:] if arguments is None else arguments))


def options() -> Parser:
    """The parser of the command line."""
    parser = Parser("lapgs-table", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    add = parser.add_argument
    add("spec", metavar="SPEC.toml", help="definition of the table")
    add("--data", metavar="DIR", default=".", help="folder that contains the scenes' folders [.]")
    add("--out", metavar="OUT", required=True, help="output folder for the runs and results.json")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--lpips-weights", metavar="FILE", help="also compute LPIPS (VGG) with the weights in FILE (docs/metrics.md)")
    return parser


def _table(arguments: list[str]) -> int:
    given = options().parse_args(arguments)
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.table import make_table, markdown, read_result, read_spec
    from lapgs_wgpu.train.lpips import Lpips

    runs, out = read_spec(Path(given.spec)), Path(given.out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; name a folder for the table with --out.")
    lpips = Lpips(Path(given.lpips_weights)) if given.lpips_weights else None
    failed = make_table(runs, Path(given.data), out, device=open_device(given.device), lpips=lpips)
    print(markdown([result for run in runs if (result := read_result(out, run)) is not None]))
    for run in failed:
        print(f"lapgs-table: {run} failed.", file=sys.stderr)
    return 1 if failed else 0
