// Exclusive prefix sums of u32, with a length that only the device knows (gpu/scan.py).
const BLOCK_ITEMS = 2048; // common/block.wgsl

export class Scan {
    // source: "" for the values, "FLAGS" adds 1 for each that is not zero, "GATHER" adds values[indices[i]].
    constructor(gpu, pool, name, source = "") {
        Object.assign(this, { gpu, pool, name });
        const suffix = source && ` ${source}`;
        this.reduce = `scan_reduce${suffix}`;
        this.apply = `scan_apply${suffix}`;
    }

    // prefix[i] = sum of the first i elements, total[0] = sum of all; elements = length[0] <= capacity.
    record(commands, { length, capacity, values, prefix, total, indices }) {
        const count = Math.max(1, Math.ceil(capacity / BLOCK_ITEMS));
        const sums = this.pool.array(`${this.name} block sums`, 4 * count);
        commands.dispatch(this.reduce, count, { length, values, indices, block_sums: sums });
        commands.dispatch(this.apply, count, { length, values, indices, block_sums: sums, prefix, total });
    }
}
