"""Names and shapes of the parameters of fields, in the order of the module's state_dict. Without torch."""

from lapgs_wgpu.motion.fields.config import GEOMETRY, TIME, FieldConfig, static_grid, temporal_grids

PLANES = ((0, 1), (0, 2), (1, 2), (0, TIME), (1, TIME), (2, TIME))  # of the field hexplane: pairs of x, y, z, t
HEXPLANE_HEADS = (3, 4, 3)  # outputs of the field hexplane's heads: shift, quaternion, scale
# Of the field mlp: octaves of its inputs; features of the time; number of layers, and of the one that also takes the
# inputs (skip connection); outputs: shift, quaternion, scale.
PLACE_OCTAVES, TIME_OCTAVES, TIME_FEATURES, MLP_LAYERS, MLP_SKIP, MLP_OUTPUTS = 10, 6, 30, 8, 4, (3, 4, 3)

Shapes = dict[str, tuple[int, ...]]


def parameter_shapes(config: FieldConfig) -> Shapes:
    """Return the shapes of the parameters of the field of this configuration; none for static scenes."""
    if config.kind == "mlp":
        return _mlp(config)
    if config.kind == "hexplane":
        return _hexplane(config)
    return _grid(config) if config.kind in ("grid4d", "laplacian") else {}


def _layer(name: str, outputs: int, inputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _grid(config: FieldConfig) -> Shapes:
    static, grids, width = static_grid(config), temporal_grids(config), config.width
    shapes: Shapes = {"static_grid.table": (static.entries, 2)}
    shapes |= {f"temporal_grids.{i}.table": (grid.entries, 2) for i, grid in enumerate(grids)}
    shapes |= _layer("spatial", width, static.features)
    shapes |= _layer("temporal", width, max(1, config.dynamics_size + sum(grid.features for grid in grids)))
    for i in range(config.depth):
        shapes |= _layer(f"hidden.{2 * i}", width, width)
    shapes |= _layer("heads", sum(GEOMETRY), width)
    if config.kind == "laplacian":
        spectrum, series = config.motion == "laplacian", (config.components, width)
        if spectrum:
            shapes |= {"motion.alpha": series, "motion.beta": series, "motion.frequencies": series[:1]}
        shapes |= _layer("motion.first", width, static.features + (0 if spectrum else 1))
        shapes |= _layer("motion.second", width, width)
    if config.appearance_size:
        shapes |= _layer("appearance", config.appearance_size, width)
    return shapes


def _hexplane(config: FieldConfig) -> Shapes:
    width = config.width
    shapes: Shapes = {}
    for level in range(config.planes.levels):
        sizes = [config.planes.space << level] * 3 + [config.planes.time]
        for a, b in PLANES:
            shapes[f"planes.{len(shapes)}"] = (1, config.planes.features, sizes[b], sizes[a])
    shapes |= _layer("trunk.0", width, config.planes.features * config.planes.levels)
    for i in range(config.depth):
        shapes |= _layer(f"trunk.{2 * i + 2}", width, width)
    for i, outputs in enumerate(HEXPLANE_HEADS):
        shapes |= _layer(f"heads.{i}.1", width, width) | _layer(f"heads.{i}.3", outputs, width)
    return shapes


def _mlp(config: FieldConfig) -> Shapes:
    width = config.width
    shapes = _layer("time.0", width, 1 + 2 * TIME_OCTAVES) | _layer("time.2", TIME_FEATURES, width)
    inputs = 3 + 6 * PLACE_OCTAVES + TIME_FEATURES
    for i in range(MLP_LAYERS):
        shapes |= _layer(f"layers.{i}", width, inputs if i == 0 else width + inputs if i == MLP_SKIP else width)
    return shapes | _layer("heads", sum(MLP_OUTPUTS), width)
