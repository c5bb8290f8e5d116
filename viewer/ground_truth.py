"""The capture that a run was trained on: its cameras to stand at, and its pictures to compare with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.io.safe_json_toml import read_toml

if TYPE_CHECKING:
    from lapgs_wgpu.data import View


class GroundTruth:
    """The views of a capture, those held out first, then the training's."""

    def __init__(self, views: tuple[View, ...]) -> None:
        self.views = views
        self._pool: BufferPool | None = None
        self._held: Any = None

    def truth(self, view: int, background: tuple[float, float, float], device: Device) -> dict[str, Any]:
        """Return the fields `truth` and `truth_size` of `ImageLayout` for a view on a background."""
        key = (view, background)
        if self._held is None or self._held[0] != key:
            from lapgs_wgpu.data import composite

            pixels = composite(self.views[view].load(), np.asarray(background, np.float32))
            packed = np.zeros((*pixels.shape[:2], 4), np.uint8)
            packed[..., :3] = pixels
            self._pool = self._pool or BufferPool(device)
            truth = self._pool.upload("ground truth", packed.view(np.uint32)[..., 0])
            self._held = (key, {"truth": truth, "truth_size": (pixels.shape[1], pixels.shape[0])})
        return self._held[1]


def open_ground_truth(checkpoint: Path, metadata: Mapping[str, str]) -> GroundTruth | None:
    """Open the capture that the config.toml beside a checkpoint names; None where it is not here.

    metadata: of the checkpoint, empty for files of other projects; it tells whether the capture was normalized."""
    from lapgs_wgpu.data import load_dataset  # not before the first picture

    try:
        data = read_toml(checkpoint.parent / "config.toml")["data"]
        path, size = Path(data["path"]), int(data["size"])
        dataset = load_dataset(
            path,
            image_size=size or None,
            normalize=not metadata or "placement" in metadata,
            undistort=bool(data.get("undistort", True)),
        )
    except (OSError, ValueError, KeyError, TypeError, OverflowError):  # InputError is a ValueError
        return None
    return GroundTruth((*dataset.test, *dataset.train))
