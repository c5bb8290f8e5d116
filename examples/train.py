"""A training, step by step: a callback that prints, a look in between, a checkpoint.

python examples/train.py --out scene.ply
lapgs-view scene.ply
"""

import argparse

from lapgs_wgpu import StepResult, Trainer, load_config, start_training

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--data", default="synthetic", help="folder of a capture, or a built-in scene")
parser.add_argument("--steps", type=int, default=300)
parser.add_argument("--out", default="scene.ply")


def report(trainer: Trainer, result: StepResult) -> None:
    """A callback: called after each step."""
    if result.step % 50 == 0:
        terms = ", ".join(f"{name} {value:.4f}" for name, value in result.terms.items())
        print(f"step {result.step}: {result.psnr:.2f} dB, {len(trainer.scene)} Gaussians; {terms}")


def main() -> dict[str, object]:
    given = parser.parse_args()
    config = load_config("demo", {"data.path": given.data, "schedule.steps": given.steps, "schedule.warm_up": 50})
    with start_training(config) as trainer:
        trainer.callbacks.append(report)
        first = trainer.step()  # one step by hand ...
        for _ in trainer:  # ... and those that are left
            pass
        print(f"the first view had {first.psnr:.2f} dB")
        metrics = trainer.evaluate()  # of the test views
        trainer.save(given.out)
    print(f"{given.out}: {metrics['psnr']:.2f} dB on {len(metrics['views'])} test views")
    return metrics


if __name__ == "__main__":
    main()
