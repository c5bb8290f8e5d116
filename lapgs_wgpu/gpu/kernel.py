"""Compute kernels whose buffers are bound by name, and the command list that runs them."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any

import wgpu

from ..errors import DeviceMemoryError
from .buffer import Buffer
from .shader import Defines, ShaderError, compose, pack, reflect
from .wgpu_errors import Guard, is_lost

if TYPE_CHECKING:
    from .device import Device

_LAYOUT_TYPE = {"uniform": "uniform", "read": "read-only-storage", "read_write": "storage"}


@dataclass(eq=False)
class BindGroup:
    """What a kernel is given, in wgpu's form, and the kernel's store of such groups, where it has the key."""

    native: Any
    textures: dict[str, Any]  # kept, so that an id in the key cannot come to mean another view
    store: dict[Any, BindGroup]
    key: Any

    def drop(self) -> None:
        """A buffer of it is gone."""
        self.store.pop(self.key, None)


class Kernel:
    """shaders/<name>.wgsl under some defines, compiled for a device."""

    def __init__(self, device: Device, name: str, defines: Defines) -> None:
        self.device = device
        self.name = name
        self.source = compose(name, defines)
        self.bindings = reflect(self.source)
        storage = [b for b in self.bindings.values() if b.kind in ("read", "read_write")]
        limit = device.limits["max-storage-buffers-per-shader-stage"]
        if len(storage) > limit:
            raise ShaderError(f"shaders/{name}.wgsl binds {len(storage)} storage buffers; the device allows {limit}")
        native = device.wgpu_device
        try:
            module = native.create_shader_module(label=name, code=self.source)
        except wgpu.GPUError as error:
            if is_lost(native):
                with Guard(device, "a shader"):
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
        self._layout = native.create_bind_group_layout(entries=entries)
        self._pipeline = native.create_compute_pipeline(
            label=name,
            layout=native.create_pipeline_layout(bind_group_layouts=[self._layout]),
            compute={"module": module, "entry_point": "main"},
        )
        self._groups: dict[Any, BindGroup] = {}

    @staticmethod
    def get(device: Device, name: str, **defines: int) -> Kernel:
        """The kernel of this name and defines; compiled once a device."""
        if device.textures:
            defines["TEXTURES"] = 1
        key = (name, tuple(sorted(defines.items())))
        kernel = device.kernel_cache.get(key)
        if kernel is None:
            kernel = device.kernel_cache[key] = Kernel(device, name, defines)
        return kernel

    def uniform(self, struct_name: str, **values: object) -> bytes:
        """The bytes of one of the shader's structs, by member name."""
        return pack(self.source, struct_name, values)

    def parts(self, buffers: dict[str, Any]) -> dict[str, tuple[Buffer, int, int]]:
        """Buffers by name as (Buffer, offset, size), checked against what the shader declares."""
        if buffers.keys() != self.bindings.keys():
            missing, unknown = self.bindings.keys() - buffers.keys(), buffers.keys() - self.bindings.keys()
            raise ShaderError(
                f"shaders/{self.name}.wgsl: missing buffers {sorted(missing)}, unknown buffers {sorted(unknown)}"
            )
        parts = {}
        for name, given in buffers.items():
            part = given if isinstance(given, tuple) else (given, 0, getattr(given, "nbytes", 0))
            if not isinstance(part[0], Buffer):
                raise ShaderError(f"shaders/{self.name}.wgsl: {name} must be a Buffer, got {type(part[0]).__name__}")
            if part[2] > self.device.max_binding:
                raise DeviceMemoryError(
                    f"{name} of the pass {self.name} needs {part[2]} bytes in one binding, "
                    f"but {self.device.info.name} allows {self.device.max_binding}"
                )
            parts[name] = part
        return parts

    def bind(self, parts: dict[str, tuple[Buffer, int, int]], textures: dict[str, Any]) -> Any:
        """wgpu's bind group for parts of buffers, and for the textures that stand for some of them."""
        key = tuple((name, part[0].number, id(textures.get(name)), *part[1:]) for name, part in parts.items())
        group = self._groups.get(key)
        if group is None:
            entries = []
            for name, (buffer, offset, size) in parts.items():
                whole = {"buffer": buffer.wgpu_buffer, "offset": offset, "size": size}
                entries.append({"binding": self.bindings[name].number, "resource": textures.get(name, whole)})
            if len(self._groups) > 64:  # parts of other sizes leave groups behind
                self._groups.clear()
            native = self.device.wgpu_device.create_bind_group(layout=self._layout, entries=entries)
            group = self._groups[key] = BindGroup(native, textures, self._groups, key)
            for buffer, _, _ in parts.values():
                buffer.bound.add(group)
        return group.native


class Commands:
    """A list of dispatches, submitted when the `with` block ends without an error.

    profile: a Profile that takes the time of each dispatch (each then has a compute pass of its own).
    """

    def __init__(self, device: Device, profile: Any = None) -> None:
        self.device = device
        self._profile = profile
        self._encoder = device.wgpu_device.create_command_encoder()
        self._pass: Any = None
        self._copied: list[Buffer] = []

    def dispatch(self, kernel: Kernel, groups: int, **buffers: Any) -> None:
        """Run `groups` workgroups, folded into two dimensions where one does not hold them (see common/index)."""
        limit = self.device.limits["max-compute-workgroups-per-dimension"]
        rows = max(1, -(-groups // limit))
        self.dispatch_grid(kernel, (-(-groups // rows), rows), **buffers)

    def dispatch_grid(self, kernel: Kernel, groups: tuple[int, int], **buffers: Any) -> None:
        """Run columns x rows workgroups."""
        if min(groups) <= 0:
            return
        parts = kernel.parts(buffers)
        textures = {
            name: self._texture(parts[name], binding.type)
            for name, binding in kernel.bindings.items()
            if binding.kind == "texture"
        }
        if self._profile is not None:
            self._end_pass()
            self._pass = self._encoder.begin_compute_pass(timestamp_writes=self._profile.record(kernel.name))
        elif self._pass is None:
            self._pass = self._encoder.begin_compute_pass()
        self._pass.set_pipeline(kernel._pipeline)
        self._pass.set_bind_group(0, kernel.bind(parts, textures))
        self._pass.dispatch_workgroups(*groups, 1)
        for name, (buffer, _, _) in parts.items():
            if kernel.bindings[name].kind == "read_write":
                buffer.version += 1

    def _texture(self, part: tuple[Buffer, int, int], texel_format: str) -> Any:
        self._end_pass()  # for the copy
        self._copied.append(part[0])
        return part[0].texture(self._encoder, texel_format, *part[1:])

    def clear(self, buffer: Buffer, nbytes: int | None = None) -> None:
        """Set the first `nbytes` (a multiple of 4; all by default) to zero."""
        self._end_pass()
        buffer.version += 1
        self._encoder.clear_buffer(buffer.wgpu_buffer, 0, buffer.nbytes if nbytes is None else nbytes)

    def copy(self, source: Buffer, target: Buffer, nbytes: int) -> None:
        """Copy the first `nbytes` (a multiple of 4) of one buffer to the start of another."""
        self._end_pass()
        target.version += 1
        self._encoder.copy_buffer_to_buffer(source.wgpu_buffer, 0, target.wgpu_buffer, 0, nbytes)

    def _end_pass(self) -> None:
        if self._pass is not None:
            self._pass.end()
            self._pass = None

    def __enter__(self) -> Commands:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end_pass()
        if kind is None:
            if self._profile is not None:
                self._profile.resolve(self._encoder)
            with Guard(self.device, "commands"):
                self.device.queue.submit([self._encoder.finish()])
        else:
            for buffer in self._copied:  # the copies are never made
                buffer.version += 1
            Guard(self.device, "commands").__exit__(kind, error, at)
