"""The field own: an nn.Module from outside the package, behind the interface of all fields (`deformation`)."""

import inspect
from collections import Counter

from torch import Tensor, nn

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby

_ROWS = {
    "rotation": (4,), "orientation": (4,), "translation": (3,), "d_quats": (4,), "d_scales": (3,), "d_dc": (3,),
    "d_opacity": (),
}  # fmt: skip


def check_own(config: FieldConfig, own: nn.Module | None) -> None:
    """Raises InputError where the field is own and no module is given, or the other way round."""
    if config.kind == "own" and own is None:
        raise InputError(
            "the field own needs a module, which only Python can give, such as Trainer(config, parts=Parts(field=...)) "
            "and load(path, field=...); docs/api.md says more."
        )
    if config.kind != "own" and own is not None:
        raise InputError(f"the scene has the field {config.kind}, so no module can be given; leave out field=...")


class OwnField(Field):
    """A deformation field of any module that answers time and means.

    module: called as module(means, t), with the arguments dynamics and nearby where its forward names them. It returns
    a translation (N, 3), or a Deformation. Its method parameter_groups(), if it has one, returns its parameters by
    learning rate; without it all of them learn at the rate "mlp". Raises InputError for what is no module.
    """

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        if not isinstance(module, nn.Module):
            raise InputError(f"a field must be an nn.Module, such as field=Drift() for a class Drift; got {module!r}.")
        self.module, self._name = module, type(module).__name__
        self._takes = inspect.signature(module.forward).parameters

    def forward(
        self, means: Tensor, t: float, dynamics: Tensor | None = None, nearby: Nearby | None = None
    ) -> Deformation:
        """See motion/fields/deformation.py. Raises InputError for results of another form."""
        beside = {"dynamics": dynamics, "nearby": nearby}
        move = self.module(means, t, **{name: value for name, value in beside.items() if name in self._takes})
        if isinstance(move, Tensor):
            move = Deformation(translation=move)
        if not isinstance(move, Deformation):
            raise InputError(f"the field {self._name} must return a Tensor or Deformation, got {type(move).__name__}.")
        for part, row in _ROWS.items():
            values, wanted = getattr(move, part), (len(means), *row)
            if values is not None and (not isinstance(values, Tensor) or values.shape != wanted):
                found = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
                raise InputError(f"the field {self._name} must return {part} as a Tensor {wanted}, got {found}.")
        return move

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """See motion/fields/deformation.py. Raises InputError where a parameter is not in one group."""
        grouped = getattr(self.module, "parameter_groups", None)
        given = grouped() if grouped else {"mlp": self.parameters()}
        groups: dict[str, list[nn.Parameter]] = {group: list(each) for group, each in given.items()}
        listed = Counter(id(parameter) for group in groups.values() for parameter in group)
        wrong = [name for name, each in self.module.named_parameters() if listed[id(each)] != 1]
        if wrong:
            raise InputError(f"parameter_groups() of {self._name} must list each parameter once: {', '.join(wrong)}.")
        return {name: group for name, group in groups.items() if group}
