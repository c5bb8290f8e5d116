"""report.html: a diagnosis as one page that needs no other file: measures, camera positions, thumbnails, masks."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data import Dataset, View
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import Pixels, decode
from lapgs_wgpu.data.readers.colmap import IMAGES
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.prepare.capture_folder import REFUSED, REPORT
from lapgs_wgpu.prepare.diagnosis import Diagnosis, diagnose
from lapgs_wgpu.prepare.masks import Mask
from lapgs_wgpu.prepare.measures import Measure

THUMBNAILS = 24  # evenly chosen from the views that were looked at
_WIDTH = 220  # pixels of a thumbnail
_MOST_POINTS = 1200  # of the cloud, in the drawing
_DRAWING = 420  # pixels: width of the drawing
_TINT, _STRENGTH = np.array([235.0, 60.0, 40.0]), 0.45  # color over what moves

_MARK = b": diagnosis</title>"  # which tells the page from others

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --good: #1a7f37; --poor: #c9372c; --soft: #777; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.1rem; margin-top: 2rem; }
.soft, figcaption { color: var(--soft); } .scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; } th { text-align: left; font-weight: 600; }
td, th { padding: .45rem .8rem .45rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
.mark { font-weight: 700; white-space: nowrap; } .good .mark { color: var(--good); } .poor .mark { color: var(--poor); }
.grid { display: grid; gap: .8rem; grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr)); }
figure { margin: 0; } figure img { width: 100%; display: block; border-radius: 4px; }
figcaption { font-size: .8rem; overflow-wrap: anywhere; }
svg { max-width: 100%; height: auto; }
@media (prefers-color-scheme: dark) { :root { --good: #56d364; --poor: #ff7b72; --soft: #aaa; } }
"""


def write_report(diagnosis: Diagnosis, path: Path, title: str) -> None:
    """Write the page. title: name of the capture. Atomic. Raises InputError where it cannot be written, or where a page
    of another program is there."""
    if path.exists() and _MARK not in path.read_bytes():
        raise InputError(f"{path} is of another program and stays as it is; the report was not written.")
    with atomic_write(path) as file:
        file.write(_page(_body(diagnosis), title).encode())


def write_refusal(folder: Path) -> None:
    """Write the page of a capture that was refused: why, its images, and the cameras where some were placed."""
    why = f"<p>{escape((folder / REFUSED).read_text(encoding='utf-8'))}</p>"
    try:
        body = _body(diagnose(folder))
    except InputError:
        files = evenly(sorted((folder / IMAGES).rglob("*.jpg")), THUMBNAILS)
        images = "".join(_figure(decode(file), None, file.name) for file in files)
        body = f'<h2>Images</h2><div class="grid">{images}</div>'
    with atomic_write(folder / REPORT) as file:
        file.write(_page(f"<h2>Not finished</h2>{why}{body}", folder.resolve().name).encode())


def _body(diagnosis: Diagnosis) -> str:
    dataset = diagnosis.dataset
    poor = [measure for measure in diagnosis.measures if measure.good is False]
    verdict = f"{len(poor)} of {len(diagnosis.measures)} properties are poor" if poor else "nothing speaks against it"
    chosen = evenly(diagnosis.looks, THUMBNAILS)
    masked = any(look.mask is not None and look.mask.any() for look in chosen)
    count = len(dataset.train) + len(dataset.test)
    layout = "cameras that stand still" if diagnosis.still else "one camera that moves"
    cameras = "Cameras" if diagnosis.still else "Cameras, dark (first) to light (last),"
    notes = "".join(f"<li>{escape(note)}</li>" for note in dataset.warnings)
    names = [Path(look.view.source) for look in chosen]
    labels = [f"{p.parent.name}/{p.name}, time {v.view.time:.3f}" for p, v in zip(names, chosen, strict=True)]
    images = "".join(_figure(v.image, v.mask, label) for v, label in zip(chosen, labels, strict=True))
    parts = [
        f'<p class="soft">{count} images, {layout}; {verdict}.</p>',
        '<div class="scroll"><table><tr><th></th><th>property</th><th>measured</th><th>wanted</th>'
        f"<th>what to film differently</th></tr>{''.join(map(_row, diagnosis.measures))}</table></div>",
        f"<h2>Also noticed</h2><ul>{notes}</ul>" if notes else "",
        "<h2>Where the cameras stood</h2>",
        f'<p class="soft">{cameras} from above, each with its viewing direction; gray: points of the scene.</p>',
        _drawing(dataset),
        f"<h2>Images{', what moves in red' if masked else ''}</h2>",
        f'<div class="grid">{images}</div>',
    ]
    return "".join(parts)


def _page(body: str, title: str) -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}{_MARK.decode()}<style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>{body}"
        "</body></html>\n"
    )


def _row(measure: Measure) -> str:
    name, mark = {True: ("good", "good"), False: ("poor", "poor"), None: ("", "not known")}[measure.good]
    advice = "" if measure.good else escape(measure.advice)
    cells = (escape(measure.name), escape(measure.value), escape(measure.threshold), advice)
    return f'<tr class="{name}"><td class="mark">{mark}</td>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'


def _figure(image: Pixels, mask: Mask | None, label: str) -> str:
    source = base64.b64encode(_jpeg(image, mask)).decode()
    return (
        f'<figure><img alt="{escape(label)}" src="data:image/jpeg;base64,{source}">'
        f"<figcaption>{escape(label)}</figcaption></figure>"
    )


def _jpeg(image: Pixels, mask: Mask | None) -> bytes:
    """A thumbnail, with a tint over what moves."""
    height, width = image.shape[:2]
    size = (_WIDTH, max(1, round(_WIDTH * height / width)))
    small = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX), dtype=np.float64)
    if mask is not None:
        over = Image.fromarray(mask.astype(np.uint8) * 255).resize(size, Image.Resampling.BILINEAR)
        weight = _STRENGTH * np.asarray(over, dtype=np.float64)[..., None] / 255
        small = (1 - weight) * small + weight * _TINT
    file = io.BytesIO()
    Image.fromarray(small.round().astype(np.uint8)).save(file, "JPEG", quality=80)
    return file.getvalue()


def _drawing(dataset: Dataset) -> str:
    """Cameras, with the direction that each looks in, and points of the scene from above, as an SVG."""
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.time)
    views = list({id(view.camera): view for view in reversed(views)}.values())[::-1]  # each camera once
    plane = _ground(dataset.up, views)
    centers = np.stack([view.camera.position for view in views]) @ plane
    ahead = np.stack([view.camera.T_cam_world[2, :3] for view in views]) @ plane
    points = centers if dataset.cloud is None else dataset.cloud.at_most(_MOST_POINTS, 0).points @ plane
    shown = np.concatenate([centers, np.percentile(points, [2, 98], axis=0)])
    middle, length = (shown.max(axis=0) + shown.min(axis=0)) / 2, float(np.ptp(shown, axis=0).max()) or 1.0

    def at(places: NDArray[np.floating]) -> NDArray[np.float64]:
        """To the drawing's pixels, with a margin around what is shown."""
        return np.round(_DRAWING * (0.5 + 0.8 * (places - middle) / length * [1, -1]), 1)

    dots = "".join(f'<circle cx="{x}" cy="{y}" r="1"/>' for x, y in at(points))
    cameras = []
    for view, (x, y), (x1, y1) in zip(views, at(centers), at(centers + 0.07 * length * ahead), strict=True):
        color = f"hsl(265 70% {35 + 40 * view.time:.0f}%)"
        cameras.append(
            f'<g stroke="{color}" fill="{color}"><line x1="{x}" y1="{y}" x2="{x1}" y2="{y1}" stroke-width="1.5"/>'
            f'<circle cx="{x}" cy="{y}" r="3"/></g>'
        )
    return (
        f'<svg width="{_DRAWING}" height="{_DRAWING}" viewBox="0 0 {_DRAWING} {_DRAWING}" role="img" '
        f'aria-label="cameras from above"><g fill="#999" opacity="0.6">{dots}</g>{"".join(cameras)}</svg>'
    )


def _ground(up: NDArray[np.float64], views: Sequence[View]) -> NDArray[np.float64]:
    """(3, 2) unit vectors across `up`: to the right of the cameras' mean, and forward."""
    right = np.cross(np.mean([view.camera.T_cam_world[2, :3] for view in views], axis=0), up)
    if np.linalg.norm(right) < 1e-6:  # cameras that look all around, or straight down
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)], axis=1)
