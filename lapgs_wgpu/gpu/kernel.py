"""Compute kernels, whose arrays are bound by name, and lists of commands that run them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import wgpu

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.bind_group import BindGroup
from lapgs_wgpu.gpu.buffer import Buffer
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.native import Encoder, raising
from lapgs_wgpu.gpu.profile import Profile
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
        native = device.wgpu_device
        try:
            module = native.create_shader_module(label=name, code=self.source)
        except wgpu.GPUError as error:
            if is_lost(native):
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
        self._layout = native.create_bind_group_layout(entries=entries)
        self.pipeline = native.create_compute_pipeline(
            label=name,
            layout=native.create_pipeline_layout(bind_group_layouts=[self._layout]),
            compute={"module": module, "entry_point": "main"},
        )
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
            raise ShaderError(
                f"shaders/{self.name}.wgsl: missing arrays {sorted(missing)}, unknown arrays {sorted(unknown)}"
            )
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

    def bind(self, arrays: dict[str, DeviceArray], textures: dict[str, Any]) -> Any:
        """Return wgpu's bind group for arrays; `textures` replace some of them. Raises as `check` does."""
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
            native = self.device.wgpu_device.create_bind_group(layout=self._layout, entries=entries)
            group = self._groups[key] = BindGroup(native, textures, self._groups, key)
            for array in arrays.values():
                array.buffer.bound.add(group)
        return group.native


def _scalar(binding: Binding) -> str | None:
    """Return the scalar type of a binding's elements, f32, u32 or i32; None for structs."""
    if binding.kind == "uniform":
        return None
    if binding.kind == "texture":
        return "f32" if binding.type.endswith("float") else "u32"
    names = re.findall(r"\w+", binding.type)
    return names[-1] if names[-1] in ("f32", "u32", "i32") else None


class Commands:
    """A list of dispatches, submitted when the `with` block ends without an error.

    profile: measures the time of each dispatch, which then gets a compute pass of its own. whole: submit all at once,
    whatever `flush` asks for.
    """

    def __init__(
        self,
        device: Device,
        profile: Profile | None = None,
        *,
        whole: bool = False,
    ) -> None:
        self.device = device
        self._whole = whole
        self._profile = profile
        self._encoder = Encoder(device.wgpu_device)
        self._raising = raising("commands")
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
        group = kernel.bind(arrays, textures)
        self._encoder.begin_pass(None if self._profile is None else self._profile.record(kernel.name))
        self._encoder.dispatch(kernel.pipeline, group, *groups)
        self._record("dispatch", (kernel.pipeline, group), *groups)
        for name in kernel.written:
            arrays[name].buffer.version += 1

    def _texture(self, array: DeviceArray, texel_format: str) -> Any:
        self._copied.append(array.buffer)
        return array.buffer.texture(self._encoder, texel_format, array.offset, array.bound_bytes)

    def clear(self, array: DeviceArray) -> None:
        """Set an array, rounded up to 4 bytes, to zero."""
        if array.nbytes == 0:
            return
        array.buffer.version += 1
        place = array.offset, (array.nbytes + 3) & ~3
        self._encoder.clear(array.buffer.wgpu_buffer, *place)
        self._record("clear", (array.buffer.wgpu_buffer,), *place)

    def copy(self, source: DeviceArray, target: DeviceArray) -> None:
        """Copy an array to another of the same size in bytes."""
        if source.nbytes != target.nbytes:
            raise ValueError(f"{target.buffer.label}: {source.nbytes} bytes are copied to {target.nbytes}")
        target.buffer.version += 1
        self._encoder.copy(
            source.buffer.wgpu_buffer, source.offset, target.buffer.wgpu_buffer, target.offset, source.nbytes
        )
        if self.device.recording is not None:
            raise ValueError("copies are not recorded")

    def copy_out(self, source: DeviceArray, target: Any, offset: int) -> None:
        """Copy an array to a wgpu buffer, `offset` bytes from its start."""
        self._encoder.copy(source.buffer.wgpu_buffer, source.offset, target, offset, source.nbytes)

    def varying(self, write: Callable[[], DeviceArray]) -> DeviceArray:
        """A uniform whose content differs from one replay to the next: `write` writes it, and is called before each."""
        recording = self.device.recording
        varied: DeviceArray = write() if recording is None else recording.vary(write)
        return varied

    @contextmanager
    def taken_down(self, recording: Recording | None) -> Iterator[None]:
        """Take down in a recording what is done within, for `replay`."""
        self.device.recording = recording
        try:
            yield
        finally:
            self.device.recording = None

    def _record(self, kind: str, objects: tuple[Any, ...], *numbers: int) -> None:
        if (recording := self.device.recording) is not None:
            recording.kept.append(objects)
            recording.commands.append((kind, *(each._internal for each in objects), *numbers))

    def replay(self, recording: Recording) -> None:
        """Do what was recorded, after its uniforms were written."""
        for (pool, name), content in recording.constants.items():
            pool.refresh(name, content)
        for write in recording.writers:
            write()
        self._encoder.replay(recording.commands)

    def flush(self) -> None:
        """Submit what was recorded so far, where a watchdog ends long submissions, and go on. It runs even where the
        `with` block fails later."""
        if self._whole or not self.device.watchdog:
            return
        with TranslatedErrors(self.device, "commands"):
            self._submit()
        self._encoder = Encoder(self.device.wgpu_device)
        self._raising = raising("commands")
        self._raising.__enter__()
        self._copied.clear()

    def _submit(self) -> None:
        self._encoder.end_pass()
        self._raising.__exit__(None, None, None)
        self._encoder.submit(self.device.queue)

    def __enter__(self) -> Commands:
        self._raising.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        translated = TranslatedErrors(self.device, "commands")
        if kind is not None:
            for buffer in self._copied:  # the copies are never made
                buffer.version += 1
            self._encoder.end_pass()
            self._raising.__exit__(kind, error, at)
            translated.__exit__(kind, error, at)
            return
        with translated:
            self._encoder.end_pass()
            if self._profile is not None:
                self._profile.resolve(self._encoder.wgpu_encoder)
            self._submit()
