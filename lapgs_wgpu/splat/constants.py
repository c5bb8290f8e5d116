"""The rasteriser's constants, by name, read from the shaders, where each stands once."""

from __future__ import annotations

import re

from ..gpu.shader import shader_text

CONSTANTS = {
    name: float(value)
    for name, value in re.findall(r"^const (\w+): f32 = ([^;]+);", shader_text("common/constants"), re.MULTILINE)
}
