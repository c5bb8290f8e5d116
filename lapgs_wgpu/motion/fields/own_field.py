"""The field own: an nn.Module from outside the package, behind the interface of all fields (`deformation`)."""

from __future__ import annotations

import inspect
from collections import Counter

from torch import Tensor, nn

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby

_ROWS = {
    "rotation": (4,), "orientation": (4,), "translation": (3,), "d_quats": (4,), "d_scales": (3,), "d_dc": (3,),
    "d_opacity": (),
}  # fmt: skip


class OwnField(Field):
    """A deformation field of any module that answers time and means.

    module: called as module(means, t), with the arguments dynamics and nearby where its forward names them. It returns
    a translation (N, 3), or a Deformation. Its method parameter_groups(), if it has one, returns its parameters by
    learning rate; without it all of them learn at the rate "mlp". Raises InputError for what is no module.
    """

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        if not isinstance(module, nn.Module):
            given = f"the class {module.__name__}" if isinstance(module, type) else f"a {type(module).__name__}"
            raise InputError(f"a field must be an nn.Module, such as field=Drift() for a class Drift; got {given}.")
        self.module = module
        named = inspect.signature(module.forward).parameters
        self._takes = [name for name in ("dynamics", "nearby") if name in named]

    def forward(
        self, means: Tensor, t: float, dynamics: Tensor | None = None, nearby: Nearby | None = None
    ) -> Deformation:
        """See motion/fields/deformation.py. Raises InputError for results of another form."""
        beside = {"dynamics": dynamics, "nearby": nearby}
        move = self.module(means, t, **{name: beside[name] for name in self._takes})
        if isinstance(move, Tensor):
            move = Deformation(translation=move)
        name = type(self.module).__name__
        if not isinstance(move, Deformation):
            raise InputError(
                f"the field {name} (means, t) must return a Tensor or a Deformation, got {type(move).__name__}."
            )
        for part, row in _ROWS.items():
            values = getattr(move, part)
            if values is not None and not isinstance(values, Tensor):
                raise InputError(f"the field {name} must return a Tensor as {part}, got {type(values).__name__}.")
            if values is not None and tuple(values.shape) != (len(means), *row):
                raise InputError(f"the field {name} returned {part} {tuple(values.shape)}, not {(len(means), *row)}.")
        return move

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """See motion/fields/deformation.py. Raises InputError where a parameter is not in one group."""
        grouped, name = getattr(self.module, "parameter_groups", None), type(self.module).__name__
        given = grouped() if grouped else {"mlp": self.parameters()}
        groups: dict[str, list[nn.Parameter]] = {group: list(each) for group, each in given.items()}
        listed = Counter(id(parameter) for group in groups.values() for parameter in group)
        missing = [name for name, each in self.module.named_parameters() if listed[id(each)] == 0]
        repeated = [name for name, each in self.module.named_parameters() if listed[id(each)] > 1]
        for fault, names in (("lacks", missing), ("lists more than once:", repeated)):
            if names:
                raise InputError(f"parameter_groups() of {name} {fault} {', '.join(names)}.")
        return {name: group for name, group in groups.items() if group}
