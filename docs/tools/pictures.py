"""The pictures of the README and of docs/, one of them a page with the scene: `make pictures`, of the built-in scene.

python docs/tools/pictures.py RUN DIR
"""

import io
import math
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pass_pictures import SIZE, blending, discovery, motion, projected, tiles
from PIL import Image

from lapgs_wgpu import load
from lapgs_wgpu.gpu.device import open_device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.app import App
from lapgs_wgpu.viewer.export import export_compact
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, load_scene
from lapgs_wgpu.viewer.offscreen import OffscreenRenderer, framed
from lapgs_wgpu.viewer.render_modes import Mode
from lapgs_wgpu.viewer.viewport import SETTLED

Picture = NDArray[np.uint8]

MOVING_SIZE, FRAMES, FPS = (400, 300), 96, 16
FIRST = 24  # frame of the moving picture, all that some programs show: not at the clip's ends, its weakest moments
SWING = math.radians(40)  # of the camera, to each side
DISTANCE = 1.1  # in distances from which the viewer begins
MOST_BYTES = 2_000_000  # of the moving picture
MODES: tuple[Mode, ...] = ("rgb", "depth", "motion")
WINDOW = (1000, 640)


def camera_at(scene: LoadedScene, azimuth: float, size: tuple[int, int]) -> Camera:
    """The camera from which the viewer begins, a little farther away and turned about the focus by radians."""
    view = scene.camera()
    view.position = view.focus + DISTANCE * (view.position - view.focus)
    view.orbit(azimuth, 0.0)
    return framed(view.camera(*size), *size)


def moving(scene: LoadedScene) -> bytes:
    """An animated WebP without an end: clip and camera go there and back."""
    render, frames = OffscreenRenderer(scene), []
    for number in range(FRAMES):
        angle = 2 * math.pi * (FIRST + number) / FRAMES
        camera = camera_at(scene, SWING * math.sin(angle), MOVING_SIZE)
        frames.append(Image.fromarray(render(camera, 0.5 - 0.5 * math.cos(angle))))
        print(f"\rframe {number + 1} of {FRAMES}", end="", file=sys.stderr)
    print(file=sys.stderr)
    for quality in (75, 50, 25):
        file = io.BytesIO()
        options = {"duration": 1000 // FPS, "loop": 0, "quality": quality, "method": 2}
        frames[0].save(file, "WEBP", save_all=True, append_images=frames[1:], **options)
        if file.tell() <= MOST_BYTES:
            return file.getvalue()
    raise SystemExit(f"the moving picture has {file.tell()} bytes at the lowest quality; {MOST_BYTES} are allowed")


def modes(scene: LoadedScene) -> Picture:
    """One moment in several modes of the viewer, side by side."""
    camera = camera_at(scene, 0.0, (300, 300))
    return np.concatenate([OffscreenRenderer(scene, mode)(camera, 0.3) for mode in MODES], axis=1)


def window(scene: LoadedScene) -> Picture:
    """The viewer's window, drawn without a screen."""
    from rendercanvas.offscreen import OffscreenRenderCanvas, loop

    canvas = OffscreenRenderCanvas(size=WINDOW, pixel_ratio=1)
    app = App(canvas, loop, scene)
    app.state.clock.seek(0.3)
    for _ in range(6):  # until the panels have found their sizes, and the image its full resolution
        drawn = canvas.draw()
        time.sleep(2 * SETTLED)
    return np.ascontiguousarray(np.asarray(drawn)[..., :3])


def main(run: Path, folder: Path) -> None:
    scene = load_scene(run / "checkpoint.ply", open_device)
    folder.mkdir(parents=True, exist_ok=True)
    trained, camera = load(run / "checkpoint.ply"), camera_at(scene, 0.0, (SIZE, SIZE))
    stills = {"modes.png": modes(scene), "viewer.png": window(scene), "discovery.png": discovery(run.parent)}
    stills |= {f"{draw.__name__}.png": draw(trained, camera) for draw in (projected, tiles, blending, motion)}
    for name, picture in stills.items():
        Image.fromarray(picture).save(folder / name, optimize=True)
    with atomic_write(folder / "demo.webp") as file:
        file.write(moving(scene))
    export_compact(scene, folder / "demo.html")
    for path in sorted(folder.iterdir()):
        print(f"{path}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
