"""Memory and waiting times of a training on many videos: python benchmarks/captures.py (its --help has the options).

Writes a capture in Neu3D's layout into a temporary folder (and the pictures that its videos are unpacked into), draws
pictures from it as a training does, at the pace of a fast device, or trains on it, and removes it all.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import av
import numpy as np


def write_capture(folder: Path, cameras: int, frames: int, width: int, height: int) -> None:
    """Cameras on an arc, and a video for each: gradients that move, under noise that compresses badly."""
    rng = np.random.default_rng(0)
    rows = []
    for turn in np.linspace(-0.5, 0.5, cameras):
        back = np.array([np.sin(turn), 0.0, np.cos(turn)])
        down, right = np.array([0.0, -1.0, 0.0]), np.array([np.cos(turn), 0.0, -np.sin(turn)])
        pose = np.stack([down, right, back, 4 * back, [height, width, 1.2 * width]], axis=1)
        rows.append([*pose.ravel(), 2.0, 8.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    y, x = np.mgrid[:height, :width]
    noise = rng.integers(-3, 4, (height, width + 64, 1))
    with av.open(str(folder / "cam00.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=30, options={"preset": "superfast", "crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for i in range(frames):
            waves = np.stack([np.sin(x / (40 + 20 * c) + i / 9) * np.cos(y / 70 - i / 20) for c in range(3)], axis=-1)
            shift = rng.integers(64)
            picture = np.clip(128 + 90 * waves + noise[:, shift : shift + width], 0, 255).astype(np.uint8)
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")):
                file.mux(packet)
        for packet in stream.encode():
            file.mux(packet)
    for camera in range(1, cameras):  # the time to decode and what it needs are the same for each
        shutil.copyfile(folder / "cam00.mp4", folder / f"cam{camera:02d}.mp4")


def megabytes(who: int = resource.RUSAGE_SELF) -> float:
    """Peak resident memory of this process, or of its largest child."""
    return resource.getrusage(who).ru_maxrss / 1e3


def unpack(folder: Path, films: int) -> None:
    """Unpack so many of the films, which are copies of one; the pictures of the others become links to the first's."""
    from lapgs_wgpu.data.video_frames import frames_folder, unpacked

    first, *others = sorted(folder.glob("*.mp4"))
    for film in others[: films - 1]:
        unpacked(film, None)
    size = unpacked(first, None)[0].size
    for film in others[films - 1 :]:
        copy = frames_folder(film, size)
        if not copy.is_dir():
            shutil.copytree(frames_folder(first, size), copy, copy_function=os.link)


def train(folder: Path, out: Path, preset: str, cache_gb: float, still: int, moving: int) -> dict[str, float]:
    """Peak memory of a training at full size: its first steps without motion, which are fast and fill the caches, then
    some with, and the evaluation."""
    schedule = ["--steps", str(still + moving), "--schedule.warm_up", str(still), "--cache-gb", str(cache_gb)]
    data = ["--data", str(folder), "--data.size", "0", "--out", str(out)]
    command = [sys.executable, "-m", "lapgs_wgpu.cli", preset, *data, *schedule]
    start = time.perf_counter()
    subprocess.run(command, check=True)
    metrics = json.loads((out / "metrics.json").read_text())
    return {
        "steps": still + moving,
        "test views": len(metrics["views"]),
        "Gaussians": metrics["gaussians"],
        "seconds": time.perf_counter() - start,
        "peak memory, MB": megabytes(resource.RUSAGE_CHILDREN),
    }


def draw(folder: Path, cache_gb: float, steps: int, step: float) -> dict[str, float]:
    """Draw `steps` pictures, each followed by `step` seconds of sleep for the training. Unpacks what is not yet."""
    import torch

    from lapgs_wgpu.data import load_dataset
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.train.ground_truth import Draws, GroundTruth

    start = time.perf_counter()
    data = load_dataset(folder)
    opening = time.perf_counter() - start
    start = time.perf_counter()
    for frame in data.train[:: len(data.times)]:
        frame.load()
    unpacking, after_unpacking = time.perf_counter() - start, megabytes()
    backgrounds = dict.fromkeys(data.train, torch.zeros(3))
    with closing(GroundTruth(open_device(), backgrounds, int(cache_gb * 1e9))) as truth:
        draws = Draws(data.train, torch.Generator().manual_seed(0), truth)
        waits = []
        for _ in range(steps):
            start = time.perf_counter()
            truth.on_device(draws.next())
            waits.append(1e3 * (time.perf_counter() - start))
            time.sleep(step)
    steady = np.sort(waits[len(waits) // 5 :])
    stored = sum(file.stat().st_size for file in Path(os.environ["XDG_CACHE_HOME"]).rglob("*.png"))
    return {
        "pictures": len(data.train),
        "opening, s": opening,
        "unpacking, s": unpacking,
        "unpacked, GB": stored / 1e9,
        "peak memory after unpacking, MB": after_unpacking,
        "peak memory, MB": megabytes(),
        "draw, median, ms": float(np.median(steady)),
        "draw, 95 %, ms": float(steady[int(0.95 * len(steady))]),
        "draw, largest, ms": float(steady[-1]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--size", type=int, nargs=2, default=(1352, 1014))
    parser.add_argument("--cache-gb", type=float, default=1.0)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--step", type=float, default=0.1, help="seconds that the device is busy in each step")
    parser.add_argument("--unpack", type=int, metavar="N", help="only so many films; they are copies of one")
    parser.add_argument("--train", type=int, nargs=2, metavar=("STILL", "MOVING"), help="train so many steps instead")
    parser.add_argument("--preset", default="neu3d", help="for --train")
    parser.add_argument("--keep", type=Path, help="a folder in which the capture is written, or is already, and stays")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        home = given.keep or Path(temporary)
        os.environ["XDG_CACHE_HOME"] = str(home / "cache")
        if not (home / "capture").is_dir():
            (home / "capture").mkdir(parents=True)
            write_capture(home / "capture", given.cameras, given.frames, *given.size)
        if given.unpack:
            unpack(home / "capture", given.unpack)
        if given.train:
            report = train(home / "capture", home / "run", given.preset, given.cache_gb, *given.train)
        else:
            report = draw(home / "capture", given.cache_gb, given.steps, given.step)
        print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
