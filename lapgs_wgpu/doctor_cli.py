"""The command lapgs-doctor: a report of the system, its adapters and a self-test, to paste into an issue."""

import os
import platform
import re
import sys
from contextlib import suppress
from functools import partial
from importlib import metadata

from lapgs_wgpu.command import DEVICE_HELP, Parser, guarded
from lapgs_wgpu.gpu.device import adapter_details

DESCRIPTION = """\
Print a report to paste into an issue: system, versions, graphics adapters with their limits, and a self-test that draws
a known image on one adapter and computes its gradient.

  lapgs-doctor > report.md            test the default adapter
  lapgs-doctor --device integrated    test another one

The report is Markdown. It contains no names of users, hosts or folders. Exit code: 0 if all checks passed, 1 if one
failed, 3 without an adapter."""

PACKAGES = ("lapgs-wgpu", "torch", "wgpu", "numpy", "scipy", "imageio", "pillow", "imgui-bundle", "av", "pycolmap")
# Environment variables that choose drivers or threads.
VARIABLES = (
    "LAPGS_DEVICE", "VK_DRIVER_FILES", "VK_ICD_FILENAMES", "WGPU_BACKEND_TYPE", "LP_NUM_THREADS",
    "LP_NATIVE_VECTOR_WIDTH", "OMP_NUM_THREADS", "MESA_VK_DEVICE_SELECT", "DRI_PRIME",
)  # fmt: skip


def options() -> Parser:
    """The parser of the command line."""
    parser = Parser("lapgs-doctor", DESCRIPTION)
    parser.add_argument("--device", metavar="NAME", help=DEVICE_HELP)
    return parser


def _doctor(arguments: list[str]) -> int:
    given = options().parse_args(arguments)
    print("\n".join(["## lapgs-doctor", "", *system_lines(), "", *adapter_lines(), ""]), flush=True)
    from lapgs_wgpu.doctor import self_test  # needs torch; the report so far is out, should a driver crash or hang

    return self_test(given.device)


def system_lines() -> list[str]:
    """Markdown list of versions, system and environment."""
    versions = dict.fromkeys(PACKAGES, "missing")
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    folder = re.compile(rf"[^{os.pathsep}]*[/\\]")  # of a path, in a list of them
    variables = [f"{name}={folder.sub('', os.environ[name])}" for name in VARIABLES if name in os.environ]
    return [
        f"- {', '.join(f'{name} {version}' for name, version in versions.items())}",
        f"- {platform.platform()}, Python {platform.python_version()}, {os.cpu_count()} processors",
        *([f"- {', '.join(variables)}"] if variables else []),
    ]


def adapter_lines() -> list[str]:
    """Markdown list of the adapters, the default one first, with what they offer of what kernels use."""
    adapters = adapter_details()
    lines = [f"### Adapters ({len(adapters)})", ""]
    for adapter in adapters:
        info = adapter.info
        lines += [
            f"- **{info.name}**: {info.kind}, {info.backend}, {info.driver or 'driver unknown'}",
            f"  - features: {', '.join(adapter.features) or 'none of the optional ones'}",
            f"  - limits: {', '.join(f'{name} {value:,}' for name, value in adapter.limits.items())}",
        ]
        for name, (offered, needed) in adapter.too_small.items():
            lines.append(f"  - **cannot be used**: {name} is {offered}, {needed} is needed")
    return lines


doctor_command = partial(guarded, "lapgs-doctor", _doctor)

if __name__ == "__main__":
    sys.exit(doctor_command())
