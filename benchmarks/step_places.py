"""How trainings end with each place of the step: python benchmarks/step_places.py OUT CAPTURE... [KEY=VALUE...].

Preset tiny without discovery, in the shape that graphics cards get, whatever the adapter is: PSNR of the test views of
five seeds, dB. A run that OUT already has is not made again.
"""

import sys
from pathlib import Path

from host import null_device

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.io.safe_json_toml import read_json
from lapgs_wgpu.run import train
from lapgs_wgpu.train.presets import load_config

KEYS = {"discovery.enabled": "false", "data.size": "100", "schedule.steps": "300", "schedule.warm_up": "60"}
SEEDS = range(5)


def main(out: Path, captures: list[Path], keys: dict[str, str]) -> None:
    device = null_device()  # with workgroups, nothing is null about it
    for capture in captures:
        dataset = load_dataset(capture, image_size=int(keys["data.size"]))
        for place in ("exchange", "resident"):
            found = []
            for seed in SEEDS:
                run = out / f"{capture.name}-{place}-{seed}"
                if not (run / "metrics.json").is_file():
                    given = keys | {"data.path": str(capture), "seed": str(seed), "step_place": place}
                    train(load_config("tiny", given), dataset, run, device=device, overwrite=True)
                found.append(read_json(run / "metrics.json")["psnr"])
            print(f"{capture.name:24s} {place:10s}", *(f"{psnr:.2f}" for psnr in found), flush=True)


if __name__ == "__main__":
    given = [word.partition("=") for word in sys.argv[2:] if "=" in word and not Path(word).is_dir()]
    folders = [Path(word) for word in sys.argv[2:] if Path(word).is_dir()]
    main(Path(sys.argv[1]), folders, KEYS | {key: value for key, _, value in given})
