"""Films of DAVIS 2016, trained: python benchmarks/film_quality.py DAVIS CAPTURES STEPS FILM[:SEED] ... prints a table.

CAPTURES/FILM is what lapgs-prepare makes of the film at 24 frames a second. The preset film trains on it as
lapgs-prepare --train does, with all schedules scaled to STEPS, in CAPTURES/runs/FILM[:SEED], and is measured inside and
outside the annotated masks.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from lapgs_wgpu import load, open_device
from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.images import encode_png
from lapgs_wgpu.run import train
from lapgs_wgpu.train.camera_refinement import corrected_views
from lapgs_wgpu.train.evaluate import evaluate
from lapgs_wgpu.train.plan import scale_schedule
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import open_data

RATE = 24  # frames a second
LIMIT = "36000"  # Gaussians


def write_true_masks(annotations: Path, capture: Path) -> Path:
    """Write the annotated masks under the names of a capture's images, which are milliseconds; returns their folder."""
    truth = sorted(annotations.glob("*.png"))
    folder = capture / "true"
    folder.mkdir(exist_ok=True)
    for file in (capture / "images").iterdir():
        with Image.open(truth[round(int(file.stem) * RATE / 1000)]) as image:
            (folder / f"{file.stem}.png").write_bytes(encode_png((np.asarray(image) > 0).astype(np.uint8) * 255))
    return folder


def main(davis: Path, captures: Path, steps: int, films: list[str]) -> None:
    print("| film | PSNR | SSIM | where it moves | elsewhere | explained | Gaussians | seconds |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|", flush=True)
    device = open_device()
    for name in films:
        film, _, seed = name.partition(":")
        capture, run, started = captures / film, captures / "runs" / name, time.perf_counter()
        config = load_config("film", {"data.path": str(capture), "density.limit": LIMIT, "seed": seed or "0"})
        if not (run / "metrics.json").exists():
            train(*open_data(scale_schedule(config, steps)), run, device=device, overwrite=True)
        seconds = time.perf_counter() - started
        scene = load(run / "checkpoint.ply", device)
        true = write_true_masks(davis / "Annotations/480p" / film, capture)
        found, given = (load_dataset(capture, image_size=config.data.size, movers=masks) for masks in ("masks", true))
        pairs = zip(found.test, given.test, strict=True)  # the world's coordinates follow the masks that were found
        measured = json.loads((run / "metrics.json").read_text())["training"].get("cameras", {})
        views = [dataclasses.replace(view, moving=other.moving) for view, other in pairs]
        m = evaluate(scene, corrected_views(views, measured.get("test_views", {})), "black")
        print(
            f"| {name} | {m['psnr']:.2f} | {m['ssim']:.3f} | {m['psnr_moving']:.2f} | {m['psnr_still']:.2f} | "
            f"{m['explained']:.0%} | {m['gaussians']:,} | {seconds:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
