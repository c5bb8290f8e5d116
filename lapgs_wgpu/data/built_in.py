"""The built-in moving scene: toys over a checkered table, in the D-NeRF layout; benchmarks/synthetic.py renders it."""

from importlib import resources
from pathlib import Path
from zipfile import ZipFile

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import new_folder

SYNTHETIC = "synthetic"  # in place of a capture's folder
RECORD = "synthetic.json"  # of the scene's parameters


def write_built_in(folder: Path) -> Path:
    """Unpack the scene into a folder, which appears whole; one that holds it already stays as it is. Returns it.

    Raises InputError where the folder holds anything else, or cannot be written.
    """
    with resources.files("lapgs_wgpu.data").joinpath("synthetic.zip").open("rb") as file, ZipFile(file) as scene:
        record = folder / RECORD
        if record.is_file() and record.read_bytes() == scene.read(RECORD):
            return folder
        if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise InputError(f"{folder} is not the built-in scene and is left alone; move it, or name another --out.")
        with new_folder(folder) as unfinished:
            scene.extractall(unfinished)
    return folder
