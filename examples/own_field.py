"""A field of one's own: each Gaussian follows a polynomial of time, whose coefficients a network reads off its place
and its learned code.

    python examples/own_field.py --out own.ply
"""

import argparse

import torch
from torch import Tensor, nn

from lapgs_wgpu import Deformation, Parts, load, load_config, start_training

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--data", default="synthetic", help="folder of a capture, or a built-in scene")
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--out", default="own.ply")


class Polynomial(nn.Module):
    """Translation and change of the quaternion, polynomials of (t - 1/2) without constant part."""

    def __init__(self, codes: int, degree: int = 3, width: int = 64) -> None:
        super().__init__()
        self.degree = degree
        self.trunk = nn.Sequential(nn.Linear(3 + 30 + codes, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.coefficients = nn.Linear(width, 7 * degree)
        nn.init.zeros_(self.coefficients.weight)  # the identity at first
        nn.init.zeros_(self.coefficients.bias)

    def forward(self, means: Tensor, t: float, dynamics: Tensor) -> Deformation:
        place = means.detach()
        waves = [wave(place * torch.pi * 2.0**k) for k in range(5) for wave in (torch.sin, torch.cos)]
        features = self.trunk(torch.cat([place, *waves, dynamics], dim=1))
        powers = torch.tensor([(t - 0.5) ** k for k in range(1, self.degree + 1)])
        shift = (self.coefficients(features).view(-1, 7, self.degree) * powers).sum(dim=2)
        return Deformation(translation=shift[:, :3], d_quats=shift[:, 3:])

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"mlp": list(self.trunk.parameters()), "coefficients": list(self.coefficients.parameters())}


def main() -> float:
    given = parser.parse_args()
    overrides = {"data.path": given.data, "schedule.steps": given.steps, "schedule.warm_up": given.steps // 4}
    config = load_config("demo", overrides)
    torch.manual_seed(config.seed)
    parts = Parts(field=Polynomial(config.field.dynamics), rates={"coefficients": 1e-3})
    with start_training(config, parts=parts) as trainer:
        for result in trainer:
            if result.step % 100 == 0:
                print(f"step {result.step}: {result.psnr:.2f} dB, {len(trainer.scene)} Gaussians")
        psnr = trainer.evaluate()["psnr"]
        trainer.save(given.out)
    scene = load(given.out, field=Polynomial(config.field.dynamics))
    with torch.no_grad():
        moved = (scene.at(1.0).means - scene.at(0.0).means).norm(dim=1).max()
    print(f"{given.out}: {psnr:.2f} dB on the test views; the fastest Gaussian moves by {float(moved):.2f} world units")
    return psnr


if __name__ == "__main__":
    main()
