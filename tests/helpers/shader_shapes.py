"""Every shape in which a shader of the package is composed: the defines that its host call can give it."""

from collections.abc import Iterator
from itertools import product

Defines = dict[str, int]
Choices = list[Defines]

_TILES: Choices = [{"TILE_W": 8, "TILE_H": 8}, {"TILE_W": 16, "TILE_H": 8}]
_SH: Choices = [{"SH": 1, "SH_COUNT": (n + 1) ** 2} | {f"SH_{d}": 1 for d in range(1, n + 1)} for n in range(4)]
_LOSS_LANES: Choices = [{"LANES": 8}, {"LANES": 64}]
_SCAN_LANES: Choices = [{"SCAN_LANES": 8}, {"SCAN_LANES": 256}]
_CORNERS: Choices = [{"SLICED": 1, "CORNERS": 4}, {"CORNERS": 8}]


def _flags(*names: str) -> list[Choices]:
    return [[{}, {name: 1}] for name in names]


def _all(*choices: Choices) -> Choices:
    """One of each, in every combination."""
    return [{name: value for part in parts for name, value in part.items()} for parts in product(*choices)]


def _raster() -> Choices:
    """Of rasterize and rasterize_bwd: splat/raster_config.py."""
    cpu = [{"TILE_W": 8, "TILE_H": 8, "LANES": n, "ROWS": 64 // n, "POLYNOMIAL_EXP2": 1} for n in (8, 16)]
    rounds = {"ROUND_SPLATS": 2048}
    gpu = [{"TILE_W": 16, "TILE_H": 8, "LANES": n, "ROWS": 128 // n} for n in (16, 32)]
    lanes = [
        shape | ({"LANES_16": 1} if shape["LANES"] > 8 else {}) | ({"LANES_32": 1} if shape["LANES"] > 16 else {})
        for shape in _all(cpu, [rounds]) + gpu
    ]
    return _all(lanes, *_flags("SUBGROUPS", "DEPTH"))


def _with_rounds(*names: str) -> Choices:
    """What is drawn in rounds has these flags, too."""
    return [
        shape | extra for shape in _raster() for extra in (_all(*_flags(*names)) if "ROUND_SPLATS" in shape else [{}])
    ]


SHAPES: dict[str, Choices] = {
    "acceleration": [{}],
    "acceleration_bwd": [{}],
    "accumulate_statistics": [{}],
    "activate": [{}, {"MOVING": 1}, {"MOVING": 1, "OPACITY": 1}],
    "activate_bwd": [{}, {"MOVING": 1}, {"MOVING": 1, "OPACITY": 1}],
    "activate_sh": _all(*_flags("BACK", "COLOR")),
    "adam": [{}],
    "adam_frequencies": [{}],
    "camera_bwd": _all(*_flags("FORCE")),
    "camera_step": [{}],
    "check_finite": [{}],
    "close_guard": [{}],
    "color": [{}, *_SH],
    "color_bwd": _SH,
    "compact": [{}],
    "deform": _all(
        [{"POINTS": 4, "QUADS": 2}, {"POINTS": 2, "QUADS": 1}],
        [{"HEADS": 4}, {"HEADS": 4, "MOTION": 1}, {"HEADS": 5, "MOTION": 1, "COLOR": 1}],
    ),
    "duplicate_with_keys": _TILES,
    "dynamics_bwd": [{"GROUPS": 64}],
    "dynamics_deviation": [{"GROUPS": 64}],
    "dynamics_distances": [{"GROUPS": 64}],
    "dynamics_mean": [{"GROUPS": 64}],
    "exposure": _LOSS_LANES,
    "exposure_bwd": _LOSS_LANES,
    "exposure_step": [{}],
    "fold_motion": _all(*_flags("MOTION")),
    "fold_motion_bwd": _all(*_flags("MOTION")),
    "gate": _all(*_flags("MOTION")),
    "gate_bwd": _all(*_flags("MOTION")),
    "gather_gradients": _all(*_flags("DEPTH")),
    "hashgrid": _all(_CORNERS, *_flags("LONG_LANES")),
    "hashgrid_bwd": _all(_CORNERS, *_flags("LANE_LEVELS")),
    "hashgrid_largest": [{}],
    "hashgrid_slice": _all(*_flags("LONG_LANES")),
    "hashgrid_slice_bwd": _all(*_flags("LONG_LANES")),
    "hashgrid_unfix": [{}],
    "image_motion": [{}],
    "loss_gradient": _all(_LOSS_LANES, *_flags("SSIM", "NCC", "PYRAMID")),
    "loss_ncc_across": _LOSS_LANES,
    "loss_ncc_down": _LOSS_LANES,
    "loss_ncc_up": _LOSS_LANES,
    "loss_pixels": _LOSS_LANES,
    "loss_pyramid_band": _all(_LOSS_LANES, *_flags("FINEST", "RESIDUAL")),
    "loss_pyramid_bwd": _all(_LOSS_LANES, *_flags("RESIDUAL")),
    "loss_pyramid_finest": _all(_LOSS_LANES, [{"FINEST": 1}]),
    "loss_pyramid_reduce": _all(_LOSS_LANES, *_flags("FINEST")),
    "loss_ssim_across": _LOSS_LANES,
    "loss_ssim_down": _LOSS_LANES,
    "loss_sums": _LOSS_LANES,
    "matmul": _all(*_flags("A_INNER", "B_INNER", "ADD")),
    "matmul_sum": _all(*_flags("ADD")),
    "move_camera": [{}],
    "place_points": [{}, {"SAMPLED": 1}, {"SAMPLED": 1, "OFFSET": 1}],
    "present": [{}],
    "probe_subgroup": [{}],
    "project": _TILES,
    "project_bwd": [{}],
    "rasterize": _with_rounds("CONTINUED", "LAST_ROUND"),
    "rasterize_bwd": _with_rounds("ROUNDS"),
    "sample_rows": _all(*_flags("BACK")),
    "scan_apply": _all(_SCAN_LANES, [{}, {"FLAGS": 1}, {"GATHER": 1}]),
    "scan_reduce": _all(_SCAN_LANES, [{}, {"FLAGS": 1}, {"GATHER": 1}]),
    "smoothness": [{}],
    "smoothness_bwd": [{}],
    "sort_count": _all(*_flags("LANE_RUNS")),
    "sort_scatter": _all(*_flags("LANE_RUNS", "UNSUMMED", "IOTA")),
    "spectrum": [{}],
    "spectrum_bwd": [{}],
    "sum_values": [{}],
    "tile_ranges": [{}],
}


def all_shapes() -> Iterator[tuple[str, Defines]]:
    """(shader, defines), with tables in buffers and, except where triangles are drawn, in textures."""
    for name, choices in SHAPES.items():
        for defines in choices:
            yield name, defines
            if name != "present":
                yield name, defines | {"TEXTURES": 1}


def described(name: str, defines: Defines) -> str:
    """For messages: the shader with its defines."""
    return " ".join([name, *(f"{key}={value}" for key, value in sorted(defines.items()))])
