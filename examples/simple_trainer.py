"""A static training written for gsplat, with its call imported from here: on any Vulkan device.

python examples/simple_trainer.py --data CAPTURE
"""

import argparse

import torch

from lapgs_wgpu import load_dataset, rasterization  # instead of: from gsplat import rasterization

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--data", required=True, help="folder of a capture")
parser.add_argument("--steps", type=int, default=500)
parser.add_argument("--gaussians", type=int, default=2000, help="to begin with")
RATES = {"means": 2e-3, "scales": 1e-2, "quats": 2e-3, "opacities": 5e-2, "sh0": 1e-2, "shN": 5e-4}


def main() -> float:
    given = parser.parse_args()
    torch.manual_seed(0)
    views = load_dataset(given.data).train
    n = given.gaussians
    splats = {"means": torch.rand(n, 3) * 2 - 1, "scales": torch.full((n, 3), -3.0), "quats": torch.rand(n, 4)}
    splats |= {"opacities": torch.full((n,), -2.0), "sh0": torch.zeros(n, 1, 3), "shN": torch.zeros(n, 15, 3)}
    optimizers = {k: torch.optim.Adam([splats[k].requires_grad_()], lr=rate) for k, rate in RATES.items()}
    moved, psnr = torch.zeros(n), 0.0
    for step in range(1, given.steps + 1):
        view = views[int(torch.randint(len(views), ()))]
        background = torch.rand(1, 3)
        pixels = torch.from_numpy(view.load() / 255).float()
        if pixels.shape[-1] == 4:
            pixels = pixels[..., :3] * pixels[..., 3:] + background * (1 - pixels[..., 3:])
        renders, alphas, info = rasterization(
            means=splats["means"],
            quats=splats["quats"],
            scales=splats["scales"].exp(),
            opacities=splats["opacities"].sigmoid(),
            colors=torch.cat([splats["sh0"], splats["shN"]], 1),
            viewmats=torch.from_numpy(view.camera.T_cam_world)[None].float(),
            Ks=torch.from_numpy(view.camera.K)[None].float(),
            width=view.camera.width,
            height=view.camera.height,
            sh_degree=min(step // 200, 3),
            packed=True,
            render_mode="RGB",
        )
        colors = renders + background * (1 - alphas)
        info["means2d"].retain_grad()
        loss = (colors[0] - pixels).abs().mean() + 0.01 * splats["opacities"].sigmoid().mean()
        loss.backward()
        moved.index_add_(0, info["gaussian_ids"], info["means2d"].grad.norm(dim=-1))
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        if step % 50 == 0:  # what pulls most is drawn twice
            chosen = moved.topk(len(moved) // 10).indices
            for name, optimizer in optimizers.items():
                value = torch.cat([splats[name].detach(), splats[name].detach()[chosen]]).requires_grad_()
                state = {
                    k: torch.cat([v, 0 * v[chosen]]) if v.ndim else v for k, v in optimizer.state.popitem()[1].items()
                }
                optimizer.param_groups[0]["params"], optimizer.state[value], splats[name] = [value], state, value
            moved = torch.zeros(len(splats["means"]))
            psnr = -10 * float((colors[0].detach() - pixels).square().mean().log10())
            print(f"step {step}: {psnr:.2f} dB, {len(moved)} Gaussians")
    return psnr


if __name__ == "__main__":
    main()
