// The temporal features of Gaussians at a time (motion/passes/hash_encoder_passes.py).
import { Pool } from "./gpu.js";

const LEVEL_WORDS = 16; // common/hashgrid.wgsl: struct Level

export class HashEncoder {
    // row, column: an encoding has `row` floats, in which the features of one grid lie behind those of the other from
    // `column` on.
    constructor(gpu, grids, bound, row, column) {
        Object.assign(this, { gpu, bound, row, pool: new Pool(gpu), cuts: [], sliceEntries: 0 });
        this.lookups = [];
        const slices = [];
        grids.forEach((grid, number) => {
            const records = grid.levels.map((level, i) => this.levelRecord(grid, level, column / 2 + i));
            const [cut, direct] = [true, false].map(sliced => records.filter((_, i) => grid.levels[i].sliced === sliced));
            if (cut.length) this.cuts.push(this.levels(`cut ${number}`, number, cut));
            if (direct.length) this.lookups.push(this.levels(`direct ${number}`, number, direct));
            slices.push(...cut);
            column += grid.features;
        });
        if (slices.length) this.lookups.unshift(this.levels("slices", null, slices));
    }

    // What the device knows of a level, and the number of cells of its plane.
    levelRecord(grid, level, number) {
        const words = new Uint32Array(LEVEL_WORDS);
        new Float32Array(words.buffer, 0, 3).set(level.scale);
        words.set([Number(level.dense), ...level.resolution, level.entries, ...grid.axes, number, level.first, this.sliceEntries], 3);
        const cells = level.resolution[0] * level.resolution[1];
        if (level.sliced) this.sliceEntries += cells;
        return { words, cells };
    }

    // grid: whose table is read; null for the slices of all grids.
    levels(name, grid, records) {
        const words = new Uint32Array(LEVEL_WORDS * records.length);
        records.forEach((record, i) => words.set(record.words, LEVEL_WORDS * i));
        const cells = Math.max(...records.map(record => record.cells));
        return { name, grid, cells, count: records.length, array: this.pool.upload(`levels ${name}`, words) };
    }

    // Encode n points. number: of the block, among those that are submitted together.
    record(commands, number, { points, encoding, tables, n, time }) {
        const grid = this.pool.uniform(`grid ${number} from 0`, this.gpu.kernel("hashgrid_slice"), "grid", {
            points: n, all_points: n, all_levels: this.row / 2, time, bound: this.bound,
        });
        const slices = this.pool.array("slices", 8 * this.sliceEntries);
        for (const cut of this.cuts) {
            commands.dispatchGrid("hashgrid_slice", Math.ceil(cut.cells / 64), cut.count, {
                grid, levels: cut.array, features: tables[cut.grid], slices,
            });
        }
        for (const levels of this.lookups) {
            const key = levels.grid === null ? "hashgrid SLICED" : "hashgrid";
            const features = levels.grid === null ? slices : tables[levels.grid];
            commands.dispatch(key, Math.ceil(n / 512) * levels.count, {
                grid, levels: levels.array, features, points, encoding,
            });
        }
    }
}
