"""Several processes that train one model together (torchrun). Each looks at some of a step's views; what they found is
put together in the order of their numbers, so that all take the same step, and the same one on every run."""

from __future__ import annotations

import atexit
import functools
import importlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
from torch import Tensor, distributed

from lapgs_wgpu.errors import InputError

T = TypeVar("T")
PATIENCE = timedelta(days=1)  # of ranks with one that is busy: the first one alone searches for what moves


@dataclass(frozen=True)
class Ranks:
    """This process is number `rank` of `count`, and number `local_rank` of those on its machine."""

    rank: int = 0
    count: int = 1
    local_rank: int = 0

    def all_reduce_sum(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """For each tensor, which every rank has in the same shape and type, the sum over the ranks in their order."""
        return [functools.reduce(torch.add, parts) for parts in self.all_gather(tensors)]

    def all_gather(self, tensors: Sequence[Tensor]) -> list[list[Tensor]]:
        """For each tensor, which every rank has in the same shape and type, those of all ranks in their order."""
        if self.count == 1:
            return [[tensor] for tensor in tensors]
        found = []
        for tensor in tensors:
            parts = [torch.empty_like(tensor, memory_format=torch.contiguous_format) for _ in range(self.count)]
            distributed.all_gather(parts, tensor.contiguous())
            found.append(parts)
        return found

    def of_first(self, value: T) -> T:
        """The first rank's value, on all ranks: devices of different makers do not compute the same bits."""
        values = [value]
        if self.count > 1:
            distributed.broadcast_object_list(values)
        return values[0]

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and tells of the progress."""
        return self.rank == 0

    def barrier(self) -> None:
        """Wait for all ranks."""
        self.any_rank(False)

    def any_rank(self, here: bool) -> bool:
        """Whether it is so on any rank."""
        if self.count == 1:
            return here
        flag = torch.tensor(int(here))
        distributed.all_reduce(flag, distributed.ReduceOp.MAX)
        return bool(flag)


SINGLE_PROCESS = Ranks()


def join_ranks() -> Ranks:
    """What torchrun says of this process, connected with the others; one rank where it was not started by torchrun."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return SINGLE_PROCESS
    if not distributed.is_available():
        raise InputError("this torch lacks torch.distributed, so several processes cannot train together.")
    if not distributed.is_initialized():
        # The group of the time when this module is first imported stays in defaults of its functions, and so would
        # outlive its end. Optimizers import it.
        importlib.import_module("torch.distributed.nn.functional")
        distributed.init_process_group("gloo", timeout=PATIENCE)
        # Otherwise gloo's threads may still run when Python ends, and abort the process.
        atexit.register(distributed.destroy_process_group)
    return Ranks(distributed.get_rank(), distributed.get_world_size(), int(os.environ["LOCAL_RANK"]))
