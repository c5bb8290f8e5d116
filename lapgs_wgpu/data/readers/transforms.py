"""What the D-NeRF and the nerfstudio formats share: a list of frames with optional times, and a lens for each."""

from __future__ import annotations

import math

from lapgs_wgpu.data.images import Size
from lapgs_wgpu.data.json_fields import LARGEST_INTRINSIC, LARGEST_SIDE, Fields, kind, number
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import intrinsics_of_fov

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
SIDE, FOCAL, ANY = (1, LARGEST_SIDE), (1e-9, LARGEST_INTRINSIC), (-LARGEST_INTRINSIC, LARGEST_INTRINSIC)
INTRINSICS = {  # bounds, in pixels of an image w x h
    "w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": ANY, "cy": ANY,
    "k1": ANY, "k2": ANY, "k3": ANY, "k4": (0, 0), "p1": ANY, "p2": ANY,
}  # fmt: skip


def timed_frames(data: Fields, field: str = "time") -> list[tuple[Fields, float | None]]:
    """Return each entry of `frames` and its time as stated; None if no frame has one.

    field: that states the time. Raises InputError, also if only some frames have a time.
    """
    frames = data.objects("frames", "frame")
    timed = sum(field in frame for frame in frames)
    if not timed:
        return [(frame, None) for frame in frames]
    for frame in frames:
        if field not in frame:
            raise InputError(
                f"{frame.where} has no field {field}, though {timed} of {len(frames)} frames have it; give it for all "
                "frames or for none."
            )
    return [(frame, number(frame.required(field), field, frame.where)) for frame in frames]


def read_lens(frame: Fields, shared: Fields, image: Size) -> Lens:
    """Return the lens of a frame: each value is the frame's own, else its file's (`shared`).

    The size is that of the image, (width, height), where none is stated, the focal length is that of camera_angle_x
    (radians) where fl_x is missing. Raises InputError, also for other lens models.
    """

    def source(name: str) -> Fields:
        return frame if name in frame else shared

    model = source("camera_model").values.get("camera_model", "OPENCV")
    if model not in MODELS or source("is_fisheye").values.get("is_fisheye"):
        named = kind(model) if model not in MODELS else "is_fisheye"
        raise InputError(
            f"{frame.where}: camera_model {named} is not among those that are read ({', '.join(MODELS)}); undistort "
            "the images first."
        )
    values = {
        name: source(name).number(name, least, most)
        for name, (least, most) in INTRINSICS.items()
        if source(name).values.get(name) is not None
    }
    width, height = int(values.get("w", image[0])), int(values.get("h", image[1]))
    if "fl_x" in values:
        fx = fy = values["fl_x"]
    else:
        angle = source("camera_angle_x")
        if "camera_angle_x" not in angle:
            raise InputError(f"{frame.where} and {shared.where} have neither the field fl_x nor camera_angle_x.")
        fov_x = angle.number("camera_angle_x")
        if not 1e-6 < fov_x < math.pi:
            raise InputError(f"{angle.where}: camera_angle_x must be radians between 0 and pi, got {fov_x:g}.")
        fx = fy = float(intrinsics_of_fov(fov_x, width, height)[0, 0])
    k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    return Lens(
        width, height, fx, values.get("fl_y", fy), values.get("cx", width / 2), values.get("cy", height / 2),
        radial=(k1, k2, k3), tangential=(p1, p2),
    )  # fmt: skip
