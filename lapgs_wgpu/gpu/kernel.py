"""Compute kernels, whose arrays are bound by name, and lists of commands that run them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import wgpu

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu import native
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.buffer import BindGroup, Buffer
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.recording import Recording
from lapgs_wgpu.gpu.shader import Binding, Defines, ShaderError, compose, enabled, pack, reflect
from lapgs_wgpu.gpu.wgpu_errors import TranslatedErrors, is_lost

_LAYOUT_TYPE = {"uniform": "uniform", "read": "read-only-storage", "read_write": "storage"}


class Kernel:
    """shaders/<name>.wgsl with some defines, compiled for a device."""

    def __init__(self, device: Device, name: str, defines: Defines) -> None:
        self.device = device
        self.name = name
        self.source = compose(name, defines)
        self.bindings = reflect(self.source)
        storage = [b for b in self.bindings.values() if b.kind in ("read", "read_write")]
        limit = device.limits["max-storage-buffers-per-shader-stage"]
        if len(storage) > limit:
            raise ShaderError(f"shaders/{name}.wgsl binds {len(storage)} storage buffers; the device allows {limit}")
        wgpu_device = device.wgpu_device
        try:
            module = wgpu_device.create_shader_module(label=name, code=self.source)
        except wgpu.GPUError as error:
            if is_lost(wgpu_device):
                with TranslatedErrors(device, "a shader"):
                    raise
            raise ShaderError(f"shaders/{name}.wgsl does not compile:\n{error}") from error
        entries: list[Any] = [
            {"binding": b.number, "visibility": wgpu.ShaderStage.COMPUTE}
            | (
                {"storage_texture": {"access": "read-only", "format": b.type, "view_dimension": "2d"}}
                if b.kind == "texture"
                else {"buffer": {"type": _LAYOUT_TYPE[b.kind]}}
            )
            for b in self.bindings.values()
        ]
        self._layout = wgpu_device.create_bind_group_layout(entries=entries)
        self.pipeline = wgpu_device.create_compute_pipeline(
            label=name,
            layout=wgpu_device.create_pipeline_layout(bind_group_layouts=[self._layout]),
            compute={"module": module, "entry_point": "main"},
        )
        self.native = self.pipeline._internal
        self._groups: dict[Any, BindGroup] = {}
        self.textures = {name: binding.type for name, binding in self.bindings.items() if binding.kind == "texture"}
        self.written = [name for name, binding in self.bindings.items() if binding.kind == "read_write"]
        self._kinds = {name: _scalar(binding) for name, binding in self.bindings.items()}

    @staticmethod
    def get(device: Device, name: str, **defines: int) -> Kernel:
        """Return the kernel with these defines (`shader.enabled`), compiled once per device."""
        defines = enabled(defines)
        if device.textures:
            defines["TEXTURES"] = 1
        key = (name, tuple(sorted(defines.items())))
        if key not in device.kernel_cache:
            device.kernel_cache[key] = Kernel(device, name, defines)
        kernel: Kernel = device.kernel_cache[key]
        return kernel

    def uniform(self, struct_name: str, **values: object) -> bytes:
        """Return the bytes of one of the shader's structs, by member name."""
        return pack(self.source, struct_name, values)

    def check(self, arrays: dict[str, DeviceArray]) -> None:
        """Raise ShaderError unless names and dtypes of the arrays match the shader's bindings, and DeviceMemoryError
        if an array is too large for a binding."""
        if arrays.keys() != self.bindings.keys():
            missing, unknown = self.bindings.keys() - arrays.keys(), arrays.keys() - self.bindings.keys()
            raise ShaderError(f"shaders/{self.name}.wgsl: missing arrays {sorted(missing)}, unknown {sorted(unknown)}")
        for name, array in arrays.items():
            if not isinstance(array, DeviceArray):
                raise ShaderError(f"shaders/{self.name}.wgsl: {name} must be a DeviceArray, got {type(array).__name__}")
            declared = self._kinds[name]
            if declared is not None and (array.dtype == "float32") != (declared == "f32"):
                raise ShaderError(f"shaders/{self.name}.wgsl: {name} holds {declared}, got {array.dtype}")
            if array.bound_bytes > self.device.max_binding:
                raise DeviceMemoryError(
                    f"{name} of the pass {self.name} needs {array.bound_bytes} bytes in one binding, "
                    f"but {self.device.info.name} allows {self.device.max_binding}"
                )

    def bind(self, arrays: dict[str, DeviceArray], textures: dict[str, Any]) -> BindGroup:
        """Return the bind group for arrays; `textures` replace some of them. Raises as `check` does."""
        key = tuple((name, array.key, id(textures.get(name))) for name, array in arrays.items())
        group = self._groups.get(key)
        if group is None:
            self.check(arrays)
            entries = []
            for name, array in arrays.items():
                resource = textures.get(name, array.resource)
                entries.append({"binding": self.bindings[name].number, "resource": resource})
            if len(self._groups) > 64:  # groups of earlier array sizes accumulate
                self._groups.clear()
            made = self.device.wgpu_device.create_bind_group(layout=self._layout, entries=entries)
            group = self._groups[key] = BindGroup(made._internal, made, textures, self._groups, key)
            for array in arrays.values():
                array.buffer.bound.add(group)
        return group


def _scalar(binding: Binding) -> str | None:
    if binding.kind == "uniform":
        return None
    if binding.kind == "texture":
        return "f32" if binding.type.endswith("float") else "u32"
    names = re.findall(r"\w+", binding.type)
    return names[-1] if names[-1] in ("f32", "u32", "i32") else None


class Commands:
    """A list of dispatches, clears and copies, submitted when the `with` block ends without an error.

    whole: submit all at once, whatever `flush` asks for.
    """

    def __init__(self, device: Device, *, whole: bool = False) -> None:
        self.device, self._whole = device, whole
        self._list: list[native.Command] = []
        self._copied: list[Buffer] = []

    def dispatch(self, kernel: Kernel, groups: int, **arrays: DeviceArray) -> None:
        """Run `groups` workgroups, in two dimensions if there are too many for one (common/index.wgsl)."""
        limit = self.device.limits["max-compute-workgroups-per-dimension"]
        rows = max(1, -(-groups // limit))
        self.dispatch_grid(kernel, (-(-groups // rows), rows), **arrays)

    def run(self, kernel: Kernel, groups: int, arrays: Mapping[str, Any]) -> None:
        """`dispatch` with those of the arrays that the shader binds."""
        self.dispatch(kernel, groups, **{name: arrays[name] for name in kernel.bindings})

    def dispatch_grid(self, kernel: Kernel, groups: tuple[int, int], **arrays: DeviceArray) -> None:
        """Run columns x rows workgroups on arrays, given by the names of the shader's bindings."""
        if min(groups) <= 0:
            return
        if arrays.keys() != kernel.bindings.keys() or not all(
            isinstance(array, DeviceArray) for array in arrays.values()
        ):
            kernel.check(arrays)
        textures = {name: self._texture(arrays[name], texels) for name, texels in kernel.textures.items()}
        self._list.append(("dispatch", kernel, kernel.bind(arrays, textures), *groups))
        for name in kernel.written:
            arrays[name].buffer.version += 1

    def _texture(self, array: DeviceArray, texel_format: str) -> Any:
        view, copies = array.buffer.texture(texel_format, array.offset, array.bound_bytes)
        if copies is not None:
            self._copied.append(array.buffer)
            self._list.append(("texture", copies))
        return view

    def clear(self, array: DeviceArray) -> None:
        """Set an array, rounded up to 4 bytes, to zero."""
        if array.nbytes:
            array.buffer.version += 1
            self._list.append(("clear", array.buffer.wgpu_buffer, array.offset, (array.nbytes + 3) & ~3))

    def copy(self, source: DeviceArray, target: DeviceArray) -> None:
        """Copy an array to another of the same size in bytes."""
        if source.nbytes != target.nbytes:
            raise ValueError(f"{target.buffer.label}: {source.nbytes} bytes are copied to {target.nbytes}")
        target.buffer.version += 1
        self.copy_out(source, target.buffer.wgpu_buffer, target.offset)

    def copy_out(self, source: DeviceArray, target: Any, offset: int) -> None:
        """Copy an array to a wgpu buffer, `offset` bytes from its start."""
        self._list.append(("copy", source.buffer.wgpu_buffer, source.offset, target, offset, source.nbytes))

    @contextmanager
    def taken_down(self, recording: Recording) -> Iterator[None]:
        """Take down in a recording what is done within, for `replay`."""
        first, self.device.recording = len(self._list), recording
        try:
            yield
        finally:
            self.device.recording = None
        recording.finish(self._list[first:])

    def replay(self, recording: Recording) -> None:
        """Do what was recorded, with uniforms that are written anew."""
        recording.renew()
        self._list += recording.commands

    def flush(self) -> None:
        """Submit what was recorded so far, where a watchdog ends long submissions, and go on. It runs even where the
        `with` block fails later."""
        if self.device.watchdog and not self._whole:
            self._submit()

    def _submit(self) -> None:
        with TranslatedErrors(self.device, "commands"):
            encoder = self.device.wgpu_device.create_command_encoder()
            with native.raising("commands"):
                native.play(encoder, self._list)
            self.device.queue.submit([encoder.finish()])
        self._list, self._copied = [], []

    def __enter__(self) -> Commands:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None:
            self._submit()
            return
        for buffer in self._copied:  # the copies are never made
            buffer.version += 1
        TranslatedErrors(self.device, "commands").__exit__(kind, error, at)
