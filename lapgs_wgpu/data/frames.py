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
from lapgs_wgpu.data.poses import place_of
from lapgs_wgpu.data.stamps import ImageName

Split = Literal["train", "val", "test"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a capture, as the files describe it.

    image: its header was checked.
    lens: at the size that the files state; the image may have another size.
    T_cam_world: (4, 4) pose, OpenCV axes, the capture's coordinates.
    where: the description of camera and lens: file and entry, for errors.
    name: file name and camera, for rules on own footage.
    states_size: whether the files state the size or the center of the lens; else they are those of the image.
    time: in any unit; None if the files state none. Either all frames of a capture have a time, or none.
    split: None to apply the rule for own footage (`timestamps.held_out`), for all frames of a capture or for none.
    label: suffix of the view's name; None to number the views.
    depths: nearest and furthest depth, the capture's units.
    mask: image, of any size, of what the training leaves out, in the color that mask_kind says.
    moving: the same of what moves, white.
    """

    image: ImageFile
    lens: Lens
    T_cam_world: NDArray[np.float64]
    where: str
    name: ImageName
    time: float | None = None
    split: Split | None = None
    label: str | None = None
    depths: tuple[float, float] | None = None
    mask: Path | None = None
    mask_kind: MaskKind = "white"
    moving: Path | None = None
    states_size: bool = True

    @property
    def place(self) -> NDArray[np.float64]:
        """(3,) the place of the camera."""
        return place_of(self.T_cam_world)


@dataclass(frozen=True, eq=False)
class Capture:
    """Frames and cloud of a capture.

    frames: at least one. The order is that of the views.
    source: file of the cloud or, without a cloud, of the cameras, for errors.
    cloud: in the coordinates of the frames.
    time_source: file and field of the times, for errors.
    time_range: times that become 0 and 1; None for the first and the last time of the frames.
    warnings: what the reader left out, one sentence each.
    left_out: how many images, for the summary.
    moved: the transform from the files' coordinates to those of frames and cloud, if the files ask for one.
    keeps_coordinates: the files may already use the presets' coordinates (D-NeRF); they are kept if the scene fits.
    shares_cameras: frames of equal lens and pose are of one camera that stands still.
    own_footage: poses and cloud come from structure from motion. Then `load` orders the frames by camera and time,
        checks the images and the poses for what goes wrong with own footage, and fills up a sparse cloud.
    """

    frames: Sequence[Frame]
    source: Path
    cloud: Cloud | None = None
    time_source: str = ""
    time_range: tuple[float, float] | None = None
    warnings: Sequence[str] = ()
    left_out: int = 0
    moved: Normalization | None = None
    keeps_coordinates: bool = False
    shares_cameras: bool = False
    own_footage: bool = False


class Reader(NamedTuple):
    """A capture format.

    name: of the format. files: what identifies it, for errors. matches: whether a folder holds it. read: reads a
    folder; the second argument is the wanted longer side in pixels, for formats that store images of several sizes, or
    None. Raises InputError.
    """

    name: str
    files: str
    matches: Callable[[Path], bool]
    read: Callable[[Path, int | None], Capture]
