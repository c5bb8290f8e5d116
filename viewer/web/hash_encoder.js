// The temporal features of Gaussians at a time (motion/passes/hash_encoder_passes.py, of listed rows).
import { Pool } from "./gpu.js";
import { isSliced } from "./hash_grid.js";

const LEVEL_WORDS = 12; // common/hashgrid.wgsl: struct Level

export class HashEncoder {
    // row, column: an encoding has `row` floats, in which the features of one grid lie behind those of the other from
    // `column` on.
    constructor(gpu, grids, bound, row, column) {
        Object.assign(this, { gpu, grids, bound, row, pool: new Pool(gpu), parts: [] });
        grids.forEach((grid, number) => {
            for (const sliced of [true, false]) {
                const chosen = grid.levels.map((level, i) => [level, column / 2 + i])
                    .filter(([level]) => (isSliced(level) === sliced));
                if (chosen.length) this.parts.push(this.makePart(number, chosen, sliced));
            }
            column += grid.features;
        });
    }

    makePart(grid, chosen, sliced) {
        const words = new Uint32Array(LEVEL_WORDS * chosen.length);
        let [slices, cells] = [0, 0];
        chosen.forEach(([level, pair], i) => {
            new Float32Array(words.buffer, 4 * LEVEL_WORDS * i, 3).set(level.scale);
            words.set([...level.resolution, level.entries, level.first, slices, pair, Number(level.dense)], LEVEL_WORDS * i + 4);
            const plane = level.resolution[0] * level.resolution[1];
            cells = Math.max(cells, plane);
            slices += plane;
        });
        const levels = this.pool.upload(`levels ${grid} ${sliced ? "sliced" : "direct"}`, words);
        return { grid, sliced, cells, levels, count: chosen.length, entries: slices };
    }

    uniform(name, kernel, { grid, sliced, count }, points, all, time) {
        const axes = [...this.grids[grid].axes, 0];
        return this.pool.uniform(`grid ${grid} ${sliced} place ${name}`, this.gpu.kernel(kernel), "grid", {
            points, all_points: all, levels: count, all_levels: this.row / 2, axes, time, bound: this.bound,
        });
    }

    // Encode the n points that `rows` names. number: of the block, among those that are submitted together.
    record(commands, number, { points, rows, encoding, tables, n, time }) {
        const sources = this.parts.map(part => {
            if (!part.sliced) return tables[part.grid];
            const slices = this.pool.array(`slices ${part.grid}`, 8 * part.entries);
            commands.dispatchGrid("hashgrid_slice", Math.ceil(part.cells / 64), part.count, {
                grid: this.uniform(`${number}`, "hashgrid_slice", part, n, n, time),
                levels: part.levels, features: tables[part.grid], slices,
            });
            return slices;
        });
        this.parts.forEach((part, i) => {
            const key = part.sliced ? "hashgrid SLICED ROWS" : "hashgrid ROWS";
            commands.dispatch(key, Math.ceil(n / 512) * part.count, {
                grid: this.uniform(`${number} from 0`, key, part, n, n, time),
                levels: part.levels, features: sources[i], points, encoding, rows,
            });
        });
    }
}
