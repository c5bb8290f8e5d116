"""The rasterizer alone: Gaussians before a camera that stands still learn an image.

python examples/fit_image.py --image docs/pictures/modes.png --out fitted.png
"""

import argparse

import numpy as np
import torch
from PIL import Image

from lapgs_wgpu import Camera, rasterize

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--image", required=True)
parser.add_argument("--size", type=int, default=128, help="pixels of the longer side")
parser.add_argument("--gaussians", type=int, default=2000)
parser.add_argument("--steps", type=int, default=300)
parser.add_argument("--out", default="fitted.png")


def main() -> float:
    given = parser.parse_args()
    picture = Image.open(given.image).convert("RGB")
    picture.thumbnail((given.size, given.size))
    truth = torch.from_numpy(np.asarray(picture, np.float32) / 255)
    height, width, _ = truth.shape
    camera = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.5, width=width, height=height)

    torch.manual_seed(0)
    n = given.gaussians
    parameters = {
        "means": torch.rand(n, 3) * 2 - 1,
        "quats": torch.randn(n, 4),
        "log_scales": torch.full((n, 3), -3.5),
        "opacity_logits": torch.zeros(n),
        "colors": torch.rand(n, 3),
    }
    for parameter in parameters.values():
        parameter.requires_grad_()
    optimizer = torch.optim.Adam(parameters.values(), lr=0.02)
    psnr = 0.0
    for step in range(1, given.steps + 1):
        image = rasterize(
            parameters["means"],
            parameters["quats"],
            parameters["log_scales"].exp(),
            parameters["opacity_logits"].sigmoid(),
            parameters["colors"],
            camera,
            depth=False,
        ).image
        loss = (image - truth).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        psnr = -10 * float(loss.detach().log10())
        if step % 50 == 0:
            print(f"step {step}: {psnr:.2f} dB")
    Image.fromarray((255 * image.detach().clamp(0, 1)).round().byte().numpy()).save(given.out)
    return psnr


if __name__ == "__main__":
    main()
