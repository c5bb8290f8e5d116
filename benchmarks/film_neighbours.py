"""What a film's own images say of its held-out ones: python benchmarks/film_neighbours.py DAVIS FILM[/N] ...

Every 8th image of DAVIS 2016 (each Nth of the film's) is guessed from those before and after it, at 240x135 pixels, and
compared inside the annotated masks: PSNR of the image before it, of the mean of both, of both moved halfway along DIS'
flow between them, and, which looks at the answer, of the image before it moved along the flow from the held-out one.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from lapgs_wgpu.prepare.poses import import_cv2

cv2 = import_cv2()
Picture = np.ndarray
SIZE = 240, 135
FINER = 3  # times: of the images between which flow is looked for


def flow(first: Picture, second: Picture) -> Picture:
    """(H, W, 2) pixels, from the first to the second."""
    grays = [cv2.cvtColor((255 * image).astype(np.uint8), cv2.COLOR_RGB2GRAY) for image in (first, second)]
    grays = [cv2.resize(gray, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_CUBIC) for gray in grays]
    found = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*grays, None)
    return cv2.resize(found, SIZE, interpolation=cv2.INTER_AREA) / FINER


def moved(image: Picture, ways: Picture) -> Picture:
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    x, y = columns + ways[..., 0], rows + ways[..., 1]
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def guesses(before: Picture, truth: Picture, after: Picture) -> list[Picture]:
    there, again = flow(before, after), flow(after, before)
    halfway = (moved(before, again / 2) + moved(after, there / 2)) / 2
    return [before, (before + after) / 2, halfway, moved(before, flow(truth, before))]


def small(file: Path) -> Picture:
    """(H, W, 3) in [0, 1]."""
    with Image.open(file) as image:
        return np.asarray(image.convert("RGB").resize(SIZE, Image.Resampling.BOX), np.float32) / 255


def main(davis: Path, films: list[str]) -> None:
    print(
        "| film | image before | mean of both | flow between them | flow from the answer |\n|---|---:|---:|---:|---:|"
    )
    for name in films:
        film, _, every = name.partition("/")
        folders = (davis / kind / "480p" / film for kind in ("JPEGImages", "Annotations"))
        files = list(zip(*(sorted(folder.iterdir())[:: int(every or 1)] for folder in folders), strict=True))
        images, masks = (np.stack([small(pair[i]) for pair in files]) for i in (0, 1))
        rows = []
        for i in range(8, len(images) - 1, 8):
            inside = masks[i].max(axis=2) > 0.5
            errors = (np.square(guess - images[i])[inside].mean() for guess in guesses(*images[i - 1 : i + 2]))
            rows.append([-10 * np.log10(error) for error in errors])
        print(f"| {name} | " + " | ".join(f"{each:.2f}" for each in np.mean(rows, axis=0)) + " |", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
