"""Small images first, larger ones from a step on: the same training goes on, with all that its optimizer knows.

python examples/growing_images.py --data DIR --preset dnerf-400 --small 400 --until 8000
"""

import argparse

from lapgs_wgpu import StepResult, Trainer, load_config, start_training

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", default="synthetic", help="folder of a capture, or a built-in scene")
parser.add_argument("--preset", default="demo")
parser.add_argument("--small", type=int, default=64, help="width of the first steps' images, pixels")
parser.add_argument("--large", type=int, default=0, help="width of the others', 0: as they are")
parser.add_argument("--until", type=int, default=200, help="number of steps on small images")
parser.add_argument("--steps", type=int, default=300, help="number of all steps")
parser.add_argument("--out", default="scene.ply")


def report(trainer: Trainer, result: StepResult) -> None:
    """A callback: called after each step."""
    if result.step % 100 == 0:
        width = trainer.dataset.train[0].camera.width
        print(f"step {result.step}: {result.psnr:.2f} dB, {len(trainer.scene)} Gaussians, {width} pixels wide")


def main() -> float:
    given = parser.parse_args()
    known = {"data.path": given.data, "schedule.steps": given.steps, "schedule.warm_up": given.steps // 20}
    for name in ("means", "hash", "mlp", "frequencies"):
        known[f"rates.{name}.steps"] = given.steps
    with start_training(load_config(given.preset, {**known, "data.size": given.small})) as small:
        small.callbacks.append(report)
        while small.done < given.until:
            small.step()
        state = small.state()
    with Trainer(load_config(given.preset, {**known, "data.size": given.large})) as large:
        large.restore(state)
        large.callbacks.append(report)
        for _ in large:
            pass
        psnr: float = large.evaluate()["psnr"]
        large.save(given.out)
    print(f"{given.out}: {psnr:.2f} dB on the test views")
    return psnr


if __name__ == "__main__":
    main()
