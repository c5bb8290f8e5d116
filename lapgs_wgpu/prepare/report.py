"""report.html: a diagnosis as one page that needs no other file: measures, camera positions, images, masks."""

import base64
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import Pixels, decode, encode_jpeg
from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.data.readers.colmap import IMAGES
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.prepare.diagnosis import Diagnosis, diagnose

REPORT = "report.html"
IMAGES_SHOWN, WIDTH = 24, 220  # evenly chosen from those that were looked at; pixels of each
POINTS_DRAWN, DRAWING = 1200, 420  # of the cloud; pixels of the drawing
RED, STRENGTH = np.array([235.0, 60.0, 40.0]), 0.45  # over what moves
_MARK = ": diagnosis</title>"  # which tells the page from others
_STYLE = """
:root { color-scheme: light dark } body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto }
pre { white-space: pre-wrap } svg { max-width: 100%; height: auto }
.grid { display: grid; gap: .8rem; grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr)) }
figure { margin: 0; font-size: .8rem; overflow-wrap: anywhere } img { width: 100% }
"""


def write_report(folder: Path, diagnosis: Diagnosis) -> None:
    """Write the page of a capture. Atomic. Raises InputError where it cannot be written, or where a page of another
    program is there."""
    path = folder / REPORT
    if path.exists() and _MARK.encode() not in path.read_bytes():
        raise InputError(f"{path} is of another program and stays as it is; the report was not written.")
    _write(folder, _body(diagnosis))


def write_refusal(folder: Path, why: str) -> None:
    """Write the page of a capture that was refused: why, its images, and the cameras where some were placed."""
    try:
        body = _body(diagnose(folder))
    except InputError:
        files = evenly(sorted((folder / IMAGES).rglob("*.jpg")), IMAGES_SHOWN)
        body = "".join(_figure(decode(file), None, file.name) for file in files)
    _write(folder, f"<h2>Not finished</h2><p>{escape(why)}</p>{body}")


def _write(folder: Path, body: str) -> None:
    title = escape(folder.resolve().name)
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}{_MARK}<style>{_STYLE}</style>'
    with atomic_write(folder / REPORT) as file:
        file.write(f"{head}<h1>{title}</h1>{body}</html>\n".encode())


def _body(diagnosis: Diagnosis) -> str:
    images = []
    for view, image, mask in evenly(diagnosis.looks, IMAGES_SHOWN):
        source = Path(view.source)
        images.append(_figure(image, mask, f"{source.parent.name}/{source.name}, time {view.time:.3f}"))
    return (
        f"<pre>{escape(str(diagnosis))}</pre><h2>Where the cameras stood</h2>"
        "<p>From above, dark (first) to light (last), each with its viewing direction; gray: points of the scene.</p>"
        f"{_drawing(diagnosis.dataset)}<h2>Images, what moves in red</h2>"
        f'<div class="grid">{"".join(images)}</div>'
    )


def _figure(image: Pixels, mask: Mask | None, label: str) -> str:
    """An image, WIDTH pixels wide, with red over what moves."""
    size = (WIDTH, max(1, round(WIDTH * image.shape[0] / image.shape[1])))
    small = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX), dtype=np.float64)
    if mask is not None:
        over = np.asarray(Image.fromarray(mask.astype(np.uint8) * 255).resize(size, Image.Resampling.BILINEAR))
        small += STRENGTH * over[..., None] / 255 * (RED - small)
    source = base64.b64encode(encode_jpeg(small.round().astype(np.uint8))).decode()
    return f'<figure><img alt="" src="data:image/jpeg;base64,{source}">{escape(label)}</figure>'


def _drawing(dataset: Dataset) -> str:
    """Cameras, with the direction that each looks in, and points of the scene from above, as an SVG."""
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.time)
    views = list({id(view.camera): view for view in reversed(views)}.values())[::-1]  # each camera once
    plane = np.linalg.svd(dataset.up[None])[2][1:]  # two directions across `up`
    plane[1] *= np.sign(np.linalg.det([*plane, dataset.up]))
    centers = np.stack([view.camera.position for view in views]) @ plane.T
    ahead = np.stack([view.camera.T_cam_world[2, :3] for view in views]) @ plane.T
    points = centers if dataset.cloud is None else dataset.cloud.at_most(POINTS_DRAWN, 0).points @ plane.T
    shown = np.concatenate([centers, np.percentile(points, [2, 98], axis=0)])
    middle, length = (shown.max(axis=0) + shown.min(axis=0)) / 2, float(np.ptp(shown, axis=0).max()) or 1.0

    def at(places: NDArray[np.floating]) -> NDArray[np.float64]:
        """To the drawing's pixels, with a margin around what is shown."""
        return np.round(DRAWING * (0.5 + 0.8 * (places - middle) / length * [1, -1]), 1)

    shapes = [f'<circle cx="{x}" cy="{y}" r="1" fill="#999"/>' for x, y in at(points)]
    for view, (x, y), (x1, y1) in zip(views, at(centers), at(centers + 0.07 * length * ahead), strict=True):
        color = f"hsl(265 70% {35 + 40 * view.time:.0f}%)"
        shapes.append(
            f'<path d="M{x} {y}L{x1} {y1}" stroke="{color}"/><circle cx="{x}" cy="{y}" r="3" fill="{color}"/>'
        )
    return f'<svg width="{DRAWING}" height="{DRAWING}">{"".join(shapes)}</svg>'
