// Shapes of hash grids, as motion/fields/config.py makes them.
const TIME = 3; // the axis number of time
const SLICE_CELLS = 1 << 14;
const TEMPORAL_AXES = [[0, 1, TIME], [1, 2, TIME], [0, 2, TIME]];

// Levels of a grid: the resolution grows geometrically along each axis.
function makeLevels(config) {
    const levels = [];
    let first = 0;
    for (let number = 0; number < config.levels; number++) {
        const share = number / Math.max(1, config.levels - 1);
        const exact = config.base.map((a, axis) => a * (config.finest[axis] / a) ** share);
        const resolution = exact.map(size => Math.ceil(size - 1e-9));
        const all = resolution[0] * resolution[1] * resolution[2];
        const entries = Math.min(2 ** config.table_log2, all);
        const dense = all <= entries;
        // Whether it is cut at the time that is shown, instead of looked up at each point.
        const sliced = dense && resolution[0] * resolution[1] <= SLICE_CELLS;
        levels.push({ scale: exact.map(size => size - 1), resolution, entries, first, dense, sliced });
        first += entries;
    }
    return levels;
}

// The temporal grids of a field; none where it has no use for them.
export function temporalGrids(config) {
    if (!config.temporal_hash) return [];
    const levels = makeLevels(config.temporal);
    const last = levels.at(-1);
    return TEMPORAL_AXES.map(axes => ({ axes, levels, entries: last.first + last.entries, features: 2 * levels.length }));
}
