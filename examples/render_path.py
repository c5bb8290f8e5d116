"""A camera path: once around the scene while the clip plays, as an animated WebP.

python examples/render_path.py runs/demo/checkpoint.ply --out path.webp
"""

import argparse
import math

import torch
from PIL import Image

from lapgs_wgpu import Camera, load

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("checkpoint")
parser.add_argument("--frames", type=int, default=90)
parser.add_argument("--size", type=int, default=256, help="pixels")
parser.add_argument("--out", default="path.webp")


def main() -> list[Image.Image]:
    given = parser.parse_args()
    scene = load(given.checkpoint)
    frames = []
    for number in range(given.frames):
        part = number / given.frames
        position = [4 * math.sin(2 * math.pi * part), -4 * math.cos(2 * math.pi * part), 1.5]  # world units
        camera = Camera.looking_at(position, [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=given.size, height=given.size)
        with torch.no_grad():
            image = scene.render(camera, t=part, depth=False).image
        frames.append(Image.fromarray((255 * image.clamp(0, 1)).round().byte().numpy()))
    frames[0].save(given.out, save_all=True, append_images=frames[1:], duration=1000 // 30, loop=0)
    print(f"{given.out}: {len(frames)} frames")
    return frames


if __name__ == "__main__":
    main()
