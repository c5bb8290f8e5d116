"""Captures: readers that turn what lies on disk into views, and a scene of our own."""

from __future__ import annotations

from pathlib import Path

from lapgs_wgpu.data.colmap import is_colmap, load_colmap
from lapgs_wgpu.data.dnerf import is_dnerf, load_dnerf
from lapgs_wgpu.data.hypernerf import is_hypernerf, load_hypernerf
from lapgs_wgpu.data.nerfstudio import is_nerfstudio, load_nerfstudio
from lapgs_wgpu.data.neu3d import is_neu3d, load_neu3d
from lapgs_wgpu.data.views import Dataset, ImageCache, View, composite
from lapgs_wgpu.errors import InputError

__all__ = ["Dataset", "ImageCache", "View", "composite", "load_dataset"]

FORMATS = (
    ("D-NeRF", "transforms_train.json and transforms_test.json", is_dnerf, load_dnerf),
    ("HyperNeRF", "dataset.json beside camera/ and rgb/", is_hypernerf, load_hypernerf),
    ("Neu3D", "poses_bounds.npy beside cam00.mp4, ... or cam00/images/, ...", is_neu3d, load_neu3d),
    ("nerfstudio", "transforms.json", is_nerfstudio, load_nerfstudio),
    ("COLMAP", "sparse/0/cameras.bin or .txt beside images/", is_colmap, load_colmap),
)


def load_dataset(folder: str | Path, *, image_size: int | None = None, normalize: bool = True) -> Dataset:
    """Open a capture, its format (docs/data.md) told by the files it holds.

    image_size: longer side in pixels, 1 or more, to which larger pictures are shrunk; None keeps all as they are.
    normalize: False keeps the coordinates of a D-NeRF scene, whatever its size; other formats are always normalized.
    Raises InputError.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {problem}; give the folder of a scene.")
    fitting = [entry for entry in FORMATS if entry[2](folder)]
    if len(fitting) == 1:
        load = fitting[0][3]
        if load is load_dnerf:
            return load_dnerf(folder, image_size=image_size, normalize=normalize)
        return load(folder, image_size=image_size)
    if fitting:
        both = " and of ".join(f"{name} ({files})" for name, files, _, _ in fitting)
        raise InputError(f"{folder} holds the files of {both}; keep one format's in it.")
    children = sorted(child for child in folder.iterdir() if child.is_dir())
    scenes = [child.name for child in children if any(is_format(child) for _, _, is_format, _ in FORMATS)]
    inside = f"; it holds the scenes {', '.join(scenes[:8])}: name one of them" if scenes else ""
    expected = ", or ".join(f"{files} ({name})" for name, files, _, _ in FORMATS)
    raise InputError(f"{folder} is no scene in a known format: expected {expected}{inside}.")
