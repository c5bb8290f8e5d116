"""Cached bind groups, which are dropped together with any of their buffers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(eq=False)
class BindGroup:
    """A wgpu bind group, and its entry in the kernel's cache."""

    native: Any
    textures: dict[str, Any]  # kept alive: their ids are part of the key
    store: dict[Any, BindGroup]
    key: Any

    def drop(self) -> None:
        """Remove it from the cache, since one of its buffers was freed."""
        self.store.pop(self.key, None)
