"""Cached bind groups, which go when one of their buffers goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(eq=False)
class BindGroup:
    """What a kernel is given, in wgpu's form, and the kernel's store of such groups, where it has the key."""

    native: Any
    textures: dict[str, Any]  # kept, so that an id in the key cannot come to mean another view
    store: dict[Any, BindGroup]
    key: Any

    def drop(self) -> None:
        """One of its buffers is gone."""
        self.store.pop(self.key, None)
