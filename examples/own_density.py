"""A density rule of one's own: the published one within a budget, which the most transparent Gaussians make room for.

python examples/own_density.py --budget 6000
"""

import argparse

import torch

from lapgs_wgpu import Change, DensityState, Parts, load_config, published_rule, start_training

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--data", default="synthetic", help="folder of a capture, or a built-in scene")
parser.add_argument("--steps", type=int, default=400)
parser.add_argument("--budget", type=int, default=6000, help="most Gaussians")


def within(budget: int, state: DensityState) -> Change:
    """The published rule's change; the most transparent of the old Gaussians go where more than the budget would be."""
    change = published_rule(state)
    excess = int(change.keep.sum()) + len(change.added["means"]) - budget
    if excess <= 0:
        return change
    logits = torch.where(change.keep, state.rows["opacity_logits"], torch.inf)
    keep = change.keep.clone()
    keep[logits.argsort(stable=True)[:excess]] = False
    return Change(keep, change.added)


def main() -> int:
    given = parser.parse_args()
    overrides = {"data.path": given.data, "schedule.steps": given.steps, "schedule.warm_up": 50, "density.start": 100}
    parts = Parts(density=lambda state: within(given.budget, state))
    with start_training(load_config("demo", overrides), parts=parts) as trainer:
        for result in trainer:
            if result.step % 100 == 0:
                print(f"step {result.step}: {result.psnr:.2f} dB, {len(trainer.scene)} Gaussians")
        print(f"{trainer.evaluate()['psnr']:.2f} dB on the test views")
        return len(trainer.scene)


if __name__ == "__main__":
    main()
