"""The command lapgs-doctor."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from lapgs_wgpu.command import DEVICE_HELP, HelpFormatter, Parser, guarded

DESCRIPTION = """\
Print a report to paste into an issue: system, versions, graphics adapters with their limits, and a self-test of about
20 seconds that runs the kernels on one adapter against known answers and measures their speed.

  lapgs-doctor > report.md            test the default adapter
  lapgs-doctor --device integrated    test another one

The report is Markdown. It contains no names of users, hosts or folders. Exit code: 0 if all checks passed, 1 if one
failed, 3 without an adapter."""


def doctor_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-doctor: returns the exit code."""
    return guarded("lapgs-doctor", _doctor, list(sys.argv[1:] if arguments is None else arguments))


def options() -> Parser:
    """The parser of the command line."""
    parser = Parser("lapgs-doctor", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    parser.add_argument("--device", metavar="NAME", help=DEVICE_HELP)
    return parser


def _doctor(arguments: list[str]) -> int:
    given = options().parse_args(arguments)
    from lapgs_wgpu.doctor.report import Report

    report = Report(given.device)
    for line in report.lines():
        print(line, flush=True)
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(doctor_command())
