"""Constants that kernels and Python share, by name. They are defined in shaders/common/constants.wgsl."""

from __future__ import annotations

import re

from lapgs_wgpu.gpu.shader import shader_text

CONSTANTS = {
    name: float(value)
    for name, value in re.findall(r"^const (\w+): f32 = ([^;]+);", shader_text("common/constants"), re.MULTILINE)
}
