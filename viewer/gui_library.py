"""The check that Dear ImGui can be loaded."""

from __future__ import annotations

from lapgs_wgpu.errors import InputError, pip_install


def check_imgui() -> None:
    """Raises InputError where the package is missing, or a library of the system that it does not bring."""
    try:
        import imgui_bundle  # noqa: F401
    except ModuleNotFoundError:
        raise InputError(f"the viewer needs imgui-bundle: {pip_install('viewer')}.") from None
    except ImportError as error:
        raise InputError(
            f"imgui-bundle cannot be loaded ({error}); on Debian and Ubuntu: sudo apt-get install -y libx11-6 libxext6."
        ) from None
