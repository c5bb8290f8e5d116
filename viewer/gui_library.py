"""Dear ImGui: whether it can be loaded, a package and libraries of the system that it does not bring."""

from __future__ import annotations

import sys

from lapgs_wgpu.errors import InputError, pip_install

PACKAGES = "libx11-6 libxext6"  # Debian's and Ubuntu's, of libX11.so.6 and libXext.so.6


def check_imgui() -> None:
    """Raises InputError where it cannot be loaded."""
    try:
        import imgui_bundle  # noqa: F401
    except ModuleNotFoundError:
        raise InputError(f"the viewer needs imgui-bundle: {pip_install('viewer')}.") from None
    except ImportError as error:
        raise InputError(
            f"the viewer's package imgui-bundle cannot be loaded ({error}); install the system's library that it lacks"
            + (f", on Debian and Ubuntu: sudo apt-get install -y {PACKAGES}." if sys.platform == "linux" else ".")
        ) from None
