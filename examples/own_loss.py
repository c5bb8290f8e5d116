"""Loss terms of one's own: one of the image, one of the Gaussians.

python examples/own_loss.py
"""

import argparse

import torch
from torch import Tensor

from lapgs_wgpu import Gaussians, Parts, Regularizer, Scene4D, TorchLoss, load_config, start_training

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--data", default="synthetic", help="folder of a capture, or a built-in scene")
parser.add_argument("--steps", type=int, default=300)


def edges(image: Tensor, truth: Tensor) -> Tensor:
    """L1 of the differences between neighbouring pixels."""
    return torch.stack([(image.diff(dim=axis) - truth.diff(dim=axis)).abs().mean() for axis in (0, 1)]).sum()


def needles(scene: Scene4D, gaussians: Gaussians, t: float) -> Tensor:
    """How many times longer than their shortest axis the Gaussians are: the mean of the logarithm."""
    scales = gaussians.scales.clamp(min=1e-4).log()
    return (scales.amax(dim=1) - scales.amin(dim=1)).mean()


def main() -> dict[str, float]:
    given = parser.parse_args()
    config = load_config("demo", {"data.path": given.data, "schedule.steps": given.steps, "schedule.warm_up": 50})
    losses = [
        TorchLoss("edges", edges, weight=0.1),
        Regularizer("needles", needles, weight=lambda step: 0.01 if step > 50 else 0.0),  # from step 51 on
    ]
    with start_training(config, parts=Parts(losses=losses)) as trainer:
        for result in trainer:
            if result.step % 50 == 0:
                print(f"step {result.step}: {result.psnr:.2f} dB,", {n: round(v, 5) for n, v in result.terms.items()})
        print(f"{trainer.evaluate()['psnr']:.2f} dB on the test views")
    return dict(result.terms)


if __name__ == "__main__":
    main()
