"""Facts about the machine and the installation. Nothing here names users, hosts or folders: the report is public."""

from __future__ import annotations

import os
import platform
import subprocess
from contextlib import suppress
from importlib import metadata
from pathlib import Path

# Packages that a training, the viewer or lapgs-prepare use; optional ones are reported as missing.
PACKAGES = (
    "torch", "wgpu", "numpy", "scipy", "imageio", "pillow", "imgui-bundle", "glfw", "uvicorn", "av",
    "pycolmap",
)  # fmt: skip
# Environment variables that choose drivers or threads.
_VARIABLES = (
    "LAPGS_DEVICE", "VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_LOADER_LAYERS_ENABLE", "WGPU_BACKEND_TYPE",
    "LP_NUM_THREADS", "LP_NATIVE_VECTOR_WIDTH", "OMP_NUM_THREADS", "MESA_VK_DEVICE_SELECT", "DRI_PRIME",
)  # fmt: skip


def system_facts() -> dict[str, str]:
    """Name and text of each fact, in the order of the report."""
    facts = {
        "lapgs-wgpu": metadata.version("lapgs-wgpu"),
        "system": f"{_distribution()}, {platform.system()} {platform.release()} {platform.machine()}",
        "processor": f"{_processor()}, {_cores()} cores",
        "memory": _memory(),
        "Python": f"{platform.python_version()} ({platform.python_implementation()})",
        "packages": ", ".join(f"{name} {_version(name)}" for name in PACKAGES),
        "environment": _environment(),
    }
    return {name: text for name, text in facts.items() if text}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing"


def _distribution() -> str:
    if platform.system() == "Darwin":
        return f"macOS {platform.mac_ver()[0]}"
    if platform.system() == "Windows":
        return f"Windows {platform.version()}"
    with suppress(OSError, KeyError):
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    return "unknown distribution"


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, text = line.partition(":")
            if name.strip() == "model name" and text.strip():
                return text.strip()
    if platform.system() == "Darwin":  # Python knows the architecture alone
        with suppress(OSError, subprocess.SubprocessError):
            told = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(told, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    return platform.processor() or platform.machine()  # ARM's Linux tells no name


def _cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory() -> str:
    try:
        page, pages = os.sysconf("SC_PAGE_SIZE"), os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return ""
    return f"{page * pages / 2**30:.1f} GiB"


def _environment() -> str:
    """The variables that are set; of paths only the file names."""
    names = (name for name in _VARIABLES if name in os.environ)
    return ", ".join(f"{name}={_file_names(os.environ[name])}" for name in names)


def _file_names(value: str) -> str:
    return os.pathsep.join(part.replace("\\", "/").rsplit("/", 1)[-1] for part in value.split(os.pathsep))
