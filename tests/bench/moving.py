"""PSNR of finished runs where the scene moves: python tests/bench/moving.py RUN [RUN ...]

For captures whose held-out camera stands still. A pixel moves at a time where the ground truth, as eval/ has it, is
further than THRESHOLD levels in a channel from its median over the clip.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

THRESHOLD = 16  # levels of 255: above the noise of a compressed film


def report(run: Path) -> str:
    """The mean over the views of the PSNR of moving and of other pixels, in dB."""
    pictures = np.stack([np.asarray(Image.open(file)) for file in sorted((run / "eval").glob("*.png"))])
    truth, drawn, _ = np.split(pictures.astype(np.int32), 3, axis=2)
    moving = (np.abs(truth - np.median(truth, axis=0)) > THRESHOLD).any(axis=3)
    errors = np.square(truth - drawn).mean(axis=3) / 255**2

    def psnr(mask: np.ndarray) -> float:
        means = [error[chosen].mean() for error, chosen in zip(errors, mask, strict=True) if chosen.any()]
        return float(np.mean(-10 * np.log10(means)))

    share = 100 * moving.mean()
    return (
        f"{run}: {psnr(moving):.2f} dB where it moves ({share:.0f} % of the pixels), {psnr(~moving):.2f} dB elsewhere"
    )


if __name__ == "__main__":
    for run in sys.argv[1:]:
        print(report(Path(run)))
