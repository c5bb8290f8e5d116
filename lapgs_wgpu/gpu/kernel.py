"""Compute kernels, whose arrays are bound by name; commands that run them, their recordings and their results."""

import itertools
import re
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu import native
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.driver_errors import check_not_lost, translated_errors
from lapgs_wgpu.gpu.shader import Defines, ShaderError, compose, enabled, pack, reflect

_APART = 256  # bytes: bindings of uniforms may begin at its multiples
_ROOM = 128 * _APART  # of a recording's uniforms
T = TypeVar("T")


class Kernel:
    """shaders/<name>.wgsl with some defines, compiled for a device."""

    def __init__(self, device: Device, name: str, defines: Defines) -> None:
        self.device = device
        self.name = name
        self.source = compose(name, defines)
        self.bindings = reflect(self.source)
        try:
            with translated_errors(device, "a shader"):
                module = device.wgpu_device.create_shader_module(label=name, code=self.source)
                self.pipeline = device.wgpu_device.create_compute_pipeline(
                    label=name, layout="auto", compute={"module": module, "entry_point": "main"}
                )
        except wgpu.GPUError as error:
            raise ShaderError(f"shaders/{name}.wgsl does not compile:\n{error}") from error
        self._layout = self.pipeline.get_bind_group_layout(0)
        self._groups: dict[Any, tuple[Any, ...]] = {}
        self.textures = {name: binding.type for name, binding in self.bindings.items() if binding.kind == "texture"}
        self.written = [name for name, binding in self.bindings.items() if binding.kind == "read_write"]

    @staticmethod
    def get(device: Device, name: str, **defines: int) -> "Kernel":
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

    def bind(self, arrays: dict[str, DeviceArray], textures: dict[str, Any]) -> Any:
        """Return wgpu's bind group for arrays, of which `textures` replace some.

        Raises ShaderError for another dtype than the shader's, DeviceMemoryError for an array too large for a binding.
        """
        key = tuple((name, array.key, id(textures.get(name))) for name, array in arrays.items())
        found = self._groups.get(key)
        if found is None:
            entries = []
            for name, array in arrays.items():
                self._check(name, array)
                resource = textures.get(name, array.resource)
                entries.append({"binding": self.bindings[name].number, "resource": resource})
            if len(self._groups) > 64:  # groups of earlier array sizes accumulate
                self._groups.clear()
            group = self.device.wgpu_device.create_bind_group(layout=self._layout, entries=entries)
            # A group keeps device memory alive: it is dropped with the first of its buffers. The key has textures' ids.
            buffers = [weakref.ref(array.buffer, lambda _: self._groups.pop(key, None)) for array in arrays.values()]
            found = self._groups[key] = group, textures, buffers
        return found[0]

    def _check(self, name: str, array: DeviceArray) -> None:
        binding = self.bindings[name]
        declared = re.search(r"(f32|float)|u32|i32|uint", binding.type)
        if binding.kind != "uniform" and declared and bool(declared[1]) != (array.dtype == "float32"):
            raise ShaderError(f"shaders/{self.name}.wgsl: {name} holds {binding.type}, got {array.dtype}")
        if array.bound_bytes > self.device.max_binding:
            raise DeviceMemoryError(
                f"{name} of the pass {self.name} needs {array.bound_bytes} bytes in one binding, "
                f"but {self.device.info.name} allows {self.device.max_binding}"
            )


class Commands:
    """A list of dispatches, clears and copies, submitted when the `with` block ends without an error.

    whole: submit all at once, whatever `flush` asks for.
    """

    def __init__(self, device: Device, *, whole: bool = False) -> None:
        self.device, self._whole = device, whole
        self._list: list[native.Command] = []

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
        if arrays.keys() != kernel.bindings.keys():
            difference = sorted(arrays.keys() ^ kernel.bindings.keys())
            raise ShaderError(f"shaders/{kernel.name}.wgsl: arrays that only one side has: {difference}")
        textures = {name: self._texture(arrays[name], texels) for name, texels in kernel.textures.items()}
        self._list.append(("dispatch", kernel, kernel.bind(arrays, textures), *groups))
        for name in kernel.written:
            arrays[name].buffer.version += 1

    def _texture(self, array: DeviceArray, texel_format: str) -> Any:
        view, copies = array.buffer.texture(texel_format, array.offset, array.bound_bytes)
        if copies is not None:
            self._list.append(("texture", copies, array.buffer))
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

    def flush(self) -> None:
        """Submit what was recorded so far, where a watchdog ends long submissions, and go on. It runs even where the
        `with` block fails later."""
        if self.device.watchdog and not self._whole:
            self._submit()

    def _submit(self) -> None:
        with translated_errors(self.device, "commands"):
            encoder = self.device.wgpu_device.create_command_encoder()
            with native.raising("commands"):
                native.play(encoder, self._list)
            self.device.queue.submit([encoder.finish()])
        self._list = []

    def __enter__(self) -> "Commands":
        return self

    def __exit__(self, kind: object, error: BaseException | None, at: object) -> None:
        if error is None:
            self._submit()
            return
        for what, *values in self._list:
            if what == "texture":  # the copies are never made
                values[1].version += 1
        with translated_errors(self.device, "commands"):
            raise error


class Recording(Generic[T]):
    """What a function recorded in `Commands`, to be submitted again: a dispatch then takes its host a few microseconds.

    result: what the function returned.
    """

    def __init__(self, commands: Commands, record: Callable[[], T]) -> None:
        device = self._device = commands.device
        self._uniforms, self._used = DeviceArray.empty(device, "uniforms", (_ROOM,), "uint8"), 0
        self._varying: dict[object, tuple[DeviceArray, Callable[[], bytes]]] = {}
        first, device.recording = len(commands._list), self
        try:
            self.result = record()
        finally:
            device.recording = None
        self._commands, self._generation = commands._list[first:], device.generation
        self._renew()

    @property
    def holds(self) -> bool:
        """Whether it may be done again: no array that it uses was made anew."""
        return self._generation == self._device.generation

    def replay(self, commands: Commands) -> None:
        """Record it again, with uniforms that are written anew."""
        self._renew()
        commands._list += self._commands

    def varying(self, key: object, write: Callable[[], bytes]) -> DeviceArray:
        """A uniform that `write` gives anew before each replay; the one that it was where the key is known."""
        if key not in self._varying:
            place = self._uniforms.rows(self._used, len(write()))
            self._used += -(-place.nbytes // _APART) * _APART
            if self._used > _ROOM:
                raise ValueError(f"the varying uniforms of a recording need more than {_ROOM} bytes")
            self._varying[key] = place, write
        return self._varying[key][0]

    def _renew(self) -> None:
        """Write what varies, at once."""
        content = np.zeros(self._used, np.uint8)
        for place, write in self._varying.values():
            content[place.offset : place.offset + place.nbytes] = np.frombuffer(write(), np.uint8)
        self._uniforms.rows(0, self._used).write(content)


class Later:
    """Copies of small arrays, which commands make, and which `read` gives without a wait for what was submitted since.

    The arrays' sizes are multiples of 4 bytes. ring: buffers that earlier ones have read, and that are used again.
    """

    def __init__(self, commands: Commands, arrays: Sequence[DeviceArray], ring: list[Any]) -> None:
        self._device, self._arrays, self._ring = commands.device, arrays, ring
        *self._starts, self._nbytes = itertools.accumulate((array.nbytes for array in arrays), initial=0)
        self._buffer = next((buffer for buffer in ring if buffer.size >= self._nbytes), None)
        if self._buffer is not None:
            ring.remove(self._buffer)
        else:
            with translated_errors(self._device, "what is read later", self._nbytes):
                self._buffer = self._device.wgpu_device.create_buffer(
                    label="later", size=self._nbytes, usage=wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
                )
        for array, start in zip(arrays, self._starts, strict=True):
            commands.copy_out(array, self._buffer, start)
        self._mapping: native.Mapping

    def submitted(self) -> None:
        """Ask for the copies, after the submission that makes them."""
        with translated_errors(self._device, "what is read later"):
            self._mapping = native.Mapping(self._device, self._buffer, 0, self._nbytes)

    def read(self) -> list[NDArray[Any]]:
        """The arrays' contents. Raises DeviceError where the device does not give them."""
        with translated_errors(self._device, "what is read later"):
            self._mapping.wait()
            check_not_lost(self._device)  # the native library would end the process
            with self._mapping as mapped:
                parts = np.split(mapped.copy(), self._starts[1:])
        self._ring.append(self._buffer)
        return [part.view(array.dtype).reshape(array.shape) for part, array in zip(parts, self._arrays, strict=True)]
