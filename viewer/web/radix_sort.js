// A stable sort of u32 keys with a payload, least significant digit first (gpu/radix_sort.py in its shape for GPUs).
import { Scan } from "./scan.js";

const BLOCK_ITEMS = 2048; // common/sort.wgsl: 128 lanes x 16 elements
const WIDTH = 4; // bits of a digit
const DIGITS = 1 << WIDTH;

export class RadixSort {
    constructor(gpu, pool, name) {
        Object.assign(this, { gpu, pool, name });
        this.scan = new Scan(gpu, pool, name);
    }

    // Sort the first length[0] <= capacity elements by the lowest bits of their keys; payload null stands for 0, 1, 2, ...
    // Returns the arrays of sorted keys and payload; those that were given lose their content.
    record(commands, { length, capacity, bits, keys, payload }) {
        const { gpu, pool, name } = this;
        const owners = Math.ceil(capacity / BLOCK_ITEMS);
        const counters = pool.array(`${name} counters`, 4 * DIGITS * owners);
        const places = pool.array(`${name} places`, 4 * DIGITS * owners);
        const count = gpu.kernel("sort_count");
        const size = pool.uniform(`${name} counter count`, gpu.kernel("scan_reduce"), "length", { value: DIGITS * owners });
        const total = pool.array(`${name} total`, 4);
        let keysOut = pool.array(`${name} keys`, 4 * capacity);
        let payloadOut = pool.array(`${name} payload`, 4 * capacity);
        let payloadIn = payload ?? pool.array(`${name} second payload`, 4 * capacity);
        for (let step = 0; step < Math.ceil(bits / WIDTH); step++) {
            const values = { shift: step * WIDTH, digits: DIGITS, owners, capacity };
            const sort = pool.uniform(`${name} pass ${step}`, count, "sort", values);
            commands.dispatch("sort_count", owners, { sort, length, keys, counters });
            this.scan.record(commands, { length: size, capacity: DIGITS * owners, values: counters, prefix: places, total });
            const iota = step === 0 && payload === null;
            commands.dispatch(iota ? "sort_scatter IOTA" : "sort_scatter", owners, {
                sort, length, keys, counters: places, keys_out: keysOut, payload_out: payloadOut, payload: payloadIn,
            });
            [keys, keysOut] = [keysOut, keys];
            [payloadIn, payloadOut] = [payloadOut, payloadIn];
        }
        return [keys, payloadIn];
    }
}
