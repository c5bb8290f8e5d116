"""A checkpoint as a web page, or as the compact scene that such a page carries.

python examples/export_web.py runs/demo/checkpoint.ply --out scene.html
python examples/export_web.py runs/demo/checkpoint.ply --out scene.lapgs
"""

import argparse
from pathlib import Path

from lapgs_wgpu import open_device
from lapgs_wgpu.viewer.export import export_compact
from lapgs_wgpu.viewer.loaded_scene import load_scene

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("checkpoint", type=Path)
parser.add_argument("--out", type=Path, default=Path("scene.html"))


def main() -> None:
    given = parser.parse_args()
    scene = load_scene(given.checkpoint, open_device)
    export_compact(scene, given.out)
    print(f"{given.out}: {scene.playback.count} Gaussians, {given.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
