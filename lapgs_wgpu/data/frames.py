"""What a reader returns: the frames of a capture and, if the files have one, its cloud, all in the files' coordinates.

`load` does everything else: it undistorts, normalizes, splits and validates.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.images import ImageFile
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.masks import MaskKind
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.data.stamps import ImageName

Split = Literal["train", "val", "test"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a capture, as the files describe it."""

    image: ImageFile  # its header was checked
    lens: Lens  # at the size that the files state; the image may have another size
    T_cam_world: NDArray[np.float64]  # (4, 4) pose, OpenCV axes, the capture's coordinates
    where: str  # the description of camera and lens: file and entry, for errors
    name: ImageName  # file name and camera, for rules on own footage
    time: float | None = None  # in any unit; all frames of a capture have one, or none, where the files state none
    split: Split | None = None  # of all frames or none; None to apply `timestamps.held_out`, the rule for own footage
    label: str | None = None  # suffix of the view's name; None to number the views
    depths: tuple[float, float] | None = None  # nearest and furthest depth, the capture's units
    mask: Path | None = None  # image, of any size, of what the training leaves out, in the color that mask_kind says
    mask_kind: MaskKind = "white"
    moving: Path | None = None  # the same of what moves, white
    states_size: bool = True  # whether the files state size or center of the lens; else they are those of the image


@dataclass(frozen=True, eq=False)
class Capture:
    """Frames and cloud of a capture."""

    frames: Sequence[Frame]  # at least one; their order is that of the views
    source: Path  # file of the cloud or, without a cloud, of the cameras, for errors
    cloud: Cloud | None = None  # in the coordinates of the frames
    time_source: str = ""  # file and field of the times, for errors
    time_range: tuple[float, float] | None = None  # becomes 0 to 1; None for the first and the last time of the frames
    warnings: Sequence[str] = ()  # what the reader left out, one sentence each
    left_out: int = 0  # how many images, for the summary
    moved: Normalization | None = None  # from the files' coordinates to those of frames and cloud, if the files ask
    keeps_coordinates: bool = False  # may already use the presets' (D-NeRF); they are kept if the scene fits
    shares_cameras: bool = False  # frames of equal lens and pose are of one camera that stands still
    # Poses and cloud come from structure from motion. Then `load` orders the frames by camera and time, checks the
    # images and the poses for what goes wrong with own footage, and fills up a sparse cloud.
    own_footage: bool = False


class Reader(NamedTuple):
    """A capture format."""

    name: str
    files: str  # what identifies it, for errors
    matches: Callable[[Path], bool]  # whether a folder holds it
    # Reads a folder. The second argument is the wanted longer side in pixels, for formats that store images of several
    # sizes, or None. Raises InputError.
    read: Callable[[Path, int | None], Capture]
