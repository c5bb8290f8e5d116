"""What a training moves, in device arrays: values, gradients and Adam's moments; torch's tensors follow when asked.

Between two looks of the host the device has the newest values. Whoever reads torch's tensors pulls them first, and the
next step pushes what the host may have changed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.motion.fields.laplacian import VARIANCE_FLOOR, VARIANCE_SPREAD
from lapgs_wgpu.motion.passes.activation_passes import GEOMETRY_FLOATS, SH_FLOATS
from lapgs_wgpu.motion.passes.grid_field_passes import FieldArrays, GridFieldPasses
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.optimizer import LARGEST_FREQUENCY_STEP

MOMENTS = ("exp_avg", "exp_avg_sq")  # as torch's Adam names them
KINDS = ("value", "gradient", *MOMENTS)
PARTS = ("gaussians", "field")  # of a scene, which go between host and device by themselves
FREQUENCIES = "motion.frequencies"
Place = tuple[slice, slice]  # rows and columns of an array


@dataclass
class Block:
    """A matrix (rows, columns) on the device in which torch's tensors lie.

    group: of the optimizer that all values belong to; None where each tensor is a group of its own. parts: by name of a
    tensor its place. ones: whether the last column holds ones, which no step changes. moving: whether only steps with
    motion move them. arrays: by kind.
    """

    name: str
    shape: tuple[int, int]
    group: str | None
    parts: dict[str, Place]
    ones: bool = False
    moving: bool = True
    arrays: dict[str, DeviceArray] = field(default_factory=dict)

    def gather(self, tensors: Mapping[str, Tensor | None]) -> NDArray[np.float32]:
        """The content for the device; tensors that are None are zeros."""
        out = np.zeros(self.shape, np.float32)
        if self.ones:
            out[:, -1] = 1.0
        for name, place in self.parts.items():
            if (tensor := tensors[name]) is not None:
                target = out[place]
                target[...] = tensor.detach().numpy(force=True).reshape(target.shape)
        return out

    def scatter(self, content: NDArray[np.float32], tensors: Mapping[str, Tensor]) -> None:
        """Copy the device's content into tensors."""
        for name, place in self.parts.items():
            tensors[name].copy_(torch.from_numpy(np.ascontiguousarray(content[place])).reshape(tensors[name].shape))


class ResidentParameters:
    """The Gaussians and the field of a scene, and the optimizers' state, on a device.

    steps: by name of a tensor, how many steps have moved it.
    """

    def __init__(self, learners: Learners, weights: GridFieldPasses | None) -> None:
        scene = learners.scene
        self._device, self._pool, self._weights = scene.device, BufferPool(scene.device), weights
        self._states, self._frequencies = learners.optimizer.states, learners.frequencies
        tensors = dict(scene.field.named_parameters()) if scene.field is not None else {}
        self._tensors: dict[str, Mapping[str, Tensor]] = {"gaussians": scene.parameters, "field": tensors}  # by part
        self._blocks_of: dict[str, list[Block]] = {}  # by part
        self.steps: dict[str, int] = {}
        # The parts that the host may have changed since they were pushed: their values, the optimizers' state of them.
        self.values_on_host, self.state_on_host = set(PARTS), set(PARTS)

    # The host's tensors and the device's arrays ----------------------------------------------------------------------

    def _write(self, part: str, kind: str, tensors: Mapping[str, Tensor | None]) -> None:
        """Upload all of a kind; tensors that are None are zeros."""
        for block in self._blocks_of[part]:
            block.arrays[kind].write(block.gather(tensors))

    def _read(self, part: str, kind: str, into: Mapping[str, Tensor]) -> None:
        """Copy all of a kind into tensors."""
        blocks = self._blocks_of[part]
        for block, content in zip(blocks, read_all([block.arrays[kind] for block in blocks]), strict=True):
            block.scatter(content, into)

    def _gaussians_layout(self) -> list[Block]:
        gaussians = self._tensors["gaussians"]
        n = len(gaussians["means"])
        geometry = {"means": np.s_[:, :3], "opacity_logits": np.s_[:, 3:4]}
        geometry |= {"quats": np.s_[:, 4:8], "log_scales": np.s_[:, 8:11]}
        colors = {"sh_dc": np.s_[:, :3], "sh_rest": np.s_[:, 3:]}
        blocks = [
            Block("geometry", (n, GEOMETRY_FLOATS), None, geometry, moving=False),
            Block("sh", (n, SH_FLOATS), None, colors, moving=False),
        ]
        if self._weights is not None:
            size = self._weights.dynamics
            dynamics = {"dynamics": np.s_[:, :size]} if "dynamics" in gaussians else {}
            blocks.append(Block("beside", (n, size + 1), None, dynamics, ones=True))
        return blocks

    def _field_layout(self) -> list[Block]:
        if self._weights is None:
            return []
        tensors = self._tensors["field"]
        blocks = [
            Block(name, (table.shape[0], 2), "hash", {name: np.s_[:, :]})
            for name, table in tensors.items()
            if name.endswith(".table")
        ]
        places = self._weights.places.items()
        rows = {name: np.s_[first : first + tensors[name].numel(), :] for name, first in places}
        return [*blocks, Block("weights", (self._weights.count, 1), "mlp", rows)]

    def push_values(self) -> None:
        """Upload the values that the host may have changed."""
        for part in self.values_on_host:
            self._blocks_of[part] = self._gaussians_layout() if part == "gaussians" else self._field_layout()
            for block in self._blocks_of[part]:
                block.arrays = {kind: self._pool.array(f"{block.name} {kind}", block.shape) for kind in KINDS}
            self._write(part, "value", self._tensors[part])

    def push(self) -> None:
        """Upload what the host may have changed; from now on the device has the newest."""
        self.push_values()
        for part in self.state_on_host:
            state = {name: self._states.get(tensor, {}) for name, tensor in self._tensors[part].items()}
            self.steps |= {name: int(each.get("step", 0)) for name, each in state.items()}
            for kind in MOMENTS:
                self._write(part, kind, {name: each.get(kind) for name, each in state.items()})
            if part == "field" and self._frequencies is not None:
                own = self._frequencies.state()
                self.steps[FREQUENCIES] = int(own["steps"])
                moments = np.append(own["mean"].numpy(), np.float32(own["square"]))
                self._frequency_state = self._pool.upload("frequencies", moments)
        self.values_on_host, self.state_on_host = set(), set()

    @torch.no_grad()
    def pull(self, parts: Sequence[str], *, state: bool) -> None:
        """Make torch's tensors of these parts the newest ones. state: and the optimizers'."""
        for part in set(parts) - self.values_on_host:
            self._read(part, "value", self._tensors[part])
            self.values_on_host.add(part)
        for part in set(parts) - self.state_on_host if state else ():
            tensors = self._tensors[part]
            adam = {name: {kind: torch.zeros_like(each) for kind in MOMENTS} for name, each in tensors.items()}
            for kind in MOMENTS:
                self._read(part, kind, {name: each[kind] for name, each in adam.items()})
            for name, tensor in tensors.items():
                if self.steps[name] and name != FREQUENCIES:
                    self._states[tensor] = {"step": torch.tensor(float(self.steps[name])), **adam[name]}
            if part == "field" and self._frequencies is not None:
                moments, own = self._frequency_state.read(), self._frequencies.state()
                own["mean"].copy_(torch.from_numpy(moments[:-1]))
                own["square"].fill_(float(moments[-1]))
                own["steps"].fill_(self.steps[FREQUENCIES])
            self.state_on_host.add(part)

    @property
    def blocks(self) -> dict[str, Block]:
        """Of the Gaussians and the field, by name."""
        return {block.name: block for part in PARTS for block in self._blocks_of[part]}

    def arrays(self, kind: str) -> FieldArrays:
        """What the field computes with (kind "value"), or its gradients; without one all but `sh` are `geometry`."""
        found = {name: block.arrays[kind] for name, block in self.blocks.items()}
        geometry, tables = found["geometry"], [array for name, array in found.items() if name.endswith(".table")]
        beside, weights = found.get("beside", geometry), found.get("weights", geometry)
        return FieldArrays(geometry, found["sh"], beside, tables, weights)

    # Passes ----------------------------------------------------------------------------------------------------------

    def begin(self, rates: Mapping[str, float], *, moving: bool) -> None:
        """Say what is recorded or replayed next: a step at these rates of the optimizer's groups and of FREQUENCIES."""
        self._rates = rates
        self._moved = [block for block in self.blocks.values() if moving or not block.moving]
        for block in self._moved:
            for name in block.parts:
                self.steps[name] += 1

    def gradients(self) -> list[DeviceArray]:
        """Of all that the step moves."""
        return [block.arrays["gradient"] for block in self._moved]

    def _rates_of(self, block: Block) -> bytes:
        """The corrected rates of a step, a pair for each column."""
        table = np.zeros((block.shape[1], 2), np.float32)
        for name, (_, columns) in block.parts.items():
            if name != FREQUENCIES:
                table[columns] = _corrected(self._rates[block.group or name], self.steps[name])
        return table.tobytes()

    def record_adam(self, commands: Commands, guard: DeviceArray) -> None:
        """Record a step of the optimizers."""
        kernel = Kernel.get(self._device, "adam")
        for block in self._moved:
            written = self._pool.varying(f"rates {block.name}", partial(self._rates_of, block))
            rates = DeviceArray(written.buffer, (block.shape[1], 2), offset=written.offset)
            frequencies, _ = block.parts.get(FREQUENCIES, (None, None))  # the last values, which Adam leaves alone
            count = frequencies.start if frequencies else block.arrays["value"].size
            adam = self._pool.constant(kernel.uniform("Adam", count=count, columns=block.shape[1], first=0))
            arrays = dict(zip(("values", "gradients", "means", "squares"), block.arrays.values(), strict=True))
            commands.dispatch(kernel, -(-count // 256), adam=adam, guard=guard, rates=rates, **arrays)
            if frequencies:
                self._record_frequencies(commands, guard)

    def _record_frequencies(self, commands: Commands, guard: DeviceArray) -> None:
        assert self._weights is not None
        assert self._frequencies is not None
        kernel, config = Kernel.get(self._device, "adam_frequencies"), self._weights.config
        given = {name: self._weights.places[f"motion.{name}"] for name in ("alpha", "beta", "frequencies")}
        given |= {"width": config.width, "components": config.components}
        bounds = {"limit": self._frequencies.limit, "largest": LARGEST_FREQUENCY_STEP}
        bounds |= {"floor": VARIANCE_FLOOR, "spread": VARIANCE_SPREAD}

        def write() -> bytes:
            corrected, factor = _corrected(self._rates[FREQUENCIES], self.steps[FREQUENCIES])
            return kernel.uniform("Frequencies", rate=corrected, square_factor=factor, **given, **bounds)

        spectrum = self._pool.varying("frequencies uniform", write)
        weights = {"weights": self.arrays("value").weights, "d_weights": self.arrays("gradient").weights}
        commands.dispatch(kernel, 1, spectrum=spectrum, guard=guard, state=self._frequency_state, **weights)


def check_finite(commands: Commands, pool: BufferPool, values: DeviceArray, bad: DeviceArray) -> None:
    """Record that `bad` becomes odd where a value is not finite."""
    kernel, most = Kernel.get(commands.device, "check_finite"), commands.device.max_binding // 1024 * 256
    for first in range(0, values.size, most):
        part = DeviceArray(values.buffer, (min(most, values.size - first),), offset=values.offset + 4 * first)
        uniform = pool.constant(kernel.uniform("Check", count=part.size))
        commands.dispatch(kernel, -(-part.size // 1024), check=uniform, values=part, bad=bad)


def _corrected(rate: float, steps: int) -> tuple[float, float]:
    """A rate of Adam and the factor of the root of its second moment, with both moments' bias corrected."""
    return rate / (1 - 0.9**steps), (1 - 0.999**steps) ** -0.5
