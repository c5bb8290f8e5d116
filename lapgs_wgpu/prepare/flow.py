"""Where each place of an image is in the images before and after it, by optical flow at the film's own rate.

Flow: DIS (Kroeger et al., "Fast optical flow using dense inverse search", 2016) of OpenCV, between neighbouring frames,
chained from image to image. A place is lost where the flow forth and back do not meet.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Pixels
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.images import Picture
from lapgs_wgpu.prepare.poses import Plane, import_cv2
from lapgs_wgpu.progress import Progress

SIDE = 480  # longer side of the images that are followed, pixels
STEP = 4  # pixels between the places that are followed
REACH = 6  # images, to either side
MEET, MEET_SHARE = 1.5, 0.05  # pixels between a place and its way forth and back, and more by this share of the way


class Motion:
    """The flow of a film. names: of its pictures. images: (h, w, 3) RGB, SIDE pixels at most, one of each picture.
    flows: (h, w, 2) float16 pixels from each to the next one, and from the next one to each. grid: (rows, columns, 2)
    the places of an image that are followed, pixels. tracks: of each image, where its grid is in the images around it,
    by their offsets; NaN where it is lost."""

    def __init__(self, frames: Iterable[tuple[Pixels, bool]], names: Sequence[str]) -> None:
        """frames: small images of equal size in order, the first being a picture, and whether each is one."""
        cv2 = import_cv2()
        dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dis.setFinestScale(1)
        self.names = names
        self.images: list[Pixels] = []
        self.flows: list[list[NDArray[np.float16]]] = []
        before: Any = None
        flow: list[Plane] = []  # forth and back, from the last picture on
        with Progress(len(names), "images followed") as progress:
            for image, chosen in frames:
                gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
                if before is not None:
                    there, again = dis.calc(before, gray, None), dis.calc(gray, before, None)
                    if flow:
                        pixels = np.stack(np.meshgrid(*map(np.arange, gray.shape[::-1])), axis=-1).astype(np.float32)
                        there, again = flow[0] + _at(there, pixels + flow[0]), again + _at(flow[1], pixels + again)
                    flow = [there, again]
                before = gray
                if chosen:
                    if self.images:
                        self.flows.append([way.astype(np.float16) for way in flow])
                    self.images.append(image)
                    flow = []
                    progress.at(len(self.images))
        height, width = self.images[0].shape[:2]
        places = np.meshgrid(np.arange(STEP // 2, width, STEP), np.arange(STEP // 2, height, STEP))
        self.grid: Plane = np.stack(places, axis=-1).astype(np.float32)
        self.tracks = [self._tracks(image) for image in range(len(self.images))]

    def _tracks(self, image: int) -> dict[int, Plane]:
        found = {}
        before = [flow[::-1] for flow in self.flows[:image][::-1]]
        for way, flows in ((1, self.flows[image:]), (-1, before)):
            at = self.grid
            for offset, (there, again) in enumerate(flows[:REACH], start=1):
                step = _at(there.astype(np.float32), at)
                on = at + step
                apart = np.linalg.norm(step + _at(again.astype(np.float32), on), axis=-1)
                on[~(apart < MEET + MEET_SHARE * np.linalg.norm(step, axis=-1))] = np.nan
                found[way * offset] = at = on
        return found

    def on_grid(self, values: Plane, at: Plane) -> Plane:
        """Values (rows, columns) of a grid at places (rows, columns, 2) in pixels; NaN outside."""
        return _at(values, ((at - STEP // 2) / STEP).astype(np.float32))


def _at(values: Plane, at: Plane) -> Plane:
    cv2 = import_cv2()
    x, y = (np.ascontiguousarray(np.nan_to_num(at[..., i], nan=-9.0), dtype=np.float32) for i in (0, 1))
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 4)


def film_frames(film: Film, pictures: Sequence[Picture]) -> Iterator[tuple[Pixels, bool]]:
    """Small frames of a film from its first picture to its last, at most 4 steps from one to the next."""
    times = [picture.seconds for picture in pictures]
    number, last = 0, 0.0
    for frame in film.frames():
        chosen = abs(frame.seconds - times[number]) < 1e-6
        span = times[number] - times[number - 1] if number else 0.0
        if chosen or (number and frame.seconds - last >= span / 4 - 1e-6):
            yield np.ascontiguousarray(frame.pixels(SIDE)), chosen
            last = frame.seconds
        number += chosen
        if number == len(times):
            return
