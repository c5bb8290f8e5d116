// The passes that draw an image, in the order of splat/rasterizer.py in its shape for GPUs.
import { Commands, Pool, part } from "./gpu.js";
import { RadixSort } from "./radix_sort.js";
import { Refusal } from "./refusal.js";
import { Scan } from "./scan.js";

const LANES = 64;
const DEPTH_BITS = 32;
const SPLAT_BYTES = 48;
const RECORD_BYTES = 32; // of the desktop's backward pass: plans are made alike
const FIRST_CAPACITY = 1 << 16;
const BAND_CAPACITY = 1 << 24;

const roomy = intersections => Math.floor((Math.floor(5 * intersections / 4) + 4095) / 4096) * 4096;
const groups = count => Math.ceil(count / LANES);

export class Rasterizer {
    // tile: its width and height.
    constructor(gpu, tile) {
        this.gpu = gpu;
        this.tile = tile;
        this.rasterize = gpu.subgroups ? "rasterize SUBGROUPS" : "rasterize";
        this.pool = new Pool(gpu);
        this.plan = { capacity: FIRST_CAPACITY, bands: 1 };
        this.maxCapacity = Math.floor(gpu.maxBinding / RECORD_BYTES);
        this.size = "";
        this.flagsScan = new Scan(gpu, this.pool, "visible", "FLAGS");
        this.offsetScan = new Scan(gpu, this.pool, "offsets", "GATHER");
        this.depthSort = new RadixSort(gpu, this.pool, "depth sort");
        this.tileSort = new RadixSort(gpu, this.pool, "tile sort");
    }

    // Submit the passes that draw an image. It is valid once `valid` says so of what `counts` reads.
    // gaussians: {count, degree, antialiased, means, quats, scales, opacities, sh}. camera: see camera.js. depth: as a fifth plane.
    draw(gaussians, camera, background, depth = false) {
        if (this.size !== `${camera.width}x${camera.height}`) { // the bands of another size would slow this one down
            this.plan = { ...this.plan, bands: 1 };
            this.size = `${camera.width}x${camera.height}`;
        }
        const { bands } = this.plan;
        const drawing = {
            gaussians, camera, background, plan: this.plan, rasterize: depth ? "rasterize DEPTH" : this.rasterize,
            image: this.pool.array("image", (depth ? 20 : 16) * camera.width * camera.height),
            splats: this.pool.array("splats", SPLAT_BYTES * gaussians.count),
        };
        const counts = [];
        for (let band = 0; band < bands; band++) {
            const commands = new Commands(this.gpu);
            const { needed, flags } = this.drawBand(commands, drawing, band);
            counts.push(needed);
            if (band < bands - 1) commands.submit();
            else drawing.counts = commands.read([...counts, flags]).then(bytes => new Uint32Array(bytes));
        }
        return drawing;
    }

    // Whether the drawing is whole. If not it has to be drawn again, with larger buffers, more bands or without subgroups.
    valid(drawing, counts) {
        const { plan } = drawing;
        if (counts[3 * plan.bands + 2] && this.rasterize !== "rasterize") { // its workgroups are no subgroups
            this.rasterize = "rasterize";
            return false;
        }
        const totals = Array.from({ length: plan.bands }, (_, band) => counts[3 * band]);
        const most = Math.max(...totals);
        if (most <= plan.capacity) return true;
        let { bands } = plan;
        const [rows] = this.tiles(drawing.camera);
        const limit = bands < rows ? Math.min(this.maxCapacity, BAND_CAPACITY) : this.maxCapacity;
        if (most > limit) {
            if (bands >= rows) {
                throw new Refusal(`A row of the picture needs ${most} entries, but this adapter's buffers hold ${limit}: `
                    + "make the window smaller.");
            }
            const all = totals.reduce((sum, each) => sum + each, 0);
            bands = Math.min(rows, Math.max(bands + 1, Math.ceil(5 * all / (4 * limit))));
        }
        this.plan = { capacity: Math.min(limit, roomy(most)), bands };
        return false;
    }

    tiles(camera) {
        return [Math.ceil(camera.height / this.tile[1]), Math.ceil(camera.width / this.tile[0])];
    }

    drawBand(commands, { gaussians, camera, background, plan: { capacity, bands }, rasterize, image, splats }, band) {
        const { gpu, pool } = this;
        const { count: n, antialiased, means, quats, scales, opacities } = gaussians;
        const [rows, columns] = this.tiles(camera);
        const [top, bottom] = [Math.floor(rows * band / bands), Math.floor(rows * (band + 1) / bands)];
        const tiles = (bottom - top) * columns;
        const frame = pool.uniform(`frame ${band}`, gpu.kernel("compact"), "frame", {
            view: camera.view, focal: camera.focal, center: camera.center, position: camera.position, gaussians: n,
            background, capacity, size: [camera.width, camera.height], tiles: [columns, rows], band: [top, bottom],
            low_pass: antialiased && antialiased !== true ? antialiased : 0.3, antialiased: antialiased ? 1 : 0, near: camera.near,
        });
        const [counts, ids, keys, offsets] = ["tile counts", "ids", "depth keys", "offsets"].map(name => pool.array(name, 4 * n));
        const visible = pool.array("visible", 4);
        const ranges = pool.array("ranges", 16 * (tiles + 1));
        const needed = pool.array(`needed ${band}`, 12);
        const length = pool.uniform("gaussians", gpu.kernel("scan_reduce FLAGS"), "length", { value: n });
        commands.dispatch("project", groups(n), { frame, means, quats, scales, opacities, splats, tile_counts: counts });
        this.color(commands, gaussians, frame, counts, splats);
        this.flagsScan.record(commands, { length, capacity: n, values: counts, prefix: offsets, total: visible });
        commands.dispatch("compact", groups(n), { frame, splats, tile_counts: counts, prefix: offsets, keys, ids });
        const [, sorted] = this.depthSort.record(
            commands, { length: visible, capacity: n, bits: DEPTH_BITS, keys, payload: ids });
        this.offsetScan.record(
            commands, { length: visible, capacity: n, values: counts, indices: sorted, prefix: offsets, total: needed });
        const [tileKeys, slotIds] = ["tile keys", "slot ids"].map(name => pool.array(name, 4 * capacity));
        commands.dispatch("duplicate_with_keys", groups(n), {
            frame, visible, splats, ids: sorted, tile_counts: counts, offsets, tile_keys: tileKeys, slot_ids: slotIds,
        });
        const bits = Math.max(1, 32 - Math.clz32(tiles)); // one key more than there are tiles, for pads
        const [sortedKeys, slots] = this.tileSort.record(
            commands, { length: needed, capacity, bits, keys: tileKeys, payload: null });
        commands.clear(ranges);
        commands.dispatch("tile_ranges", groups(Math.ceil(capacity / 4)), { frame, needed, tile_keys: sortedKeys, ranges });
        commands.dispatch(rasterize, tiles, { frame, ranges, slots, slot_ids: slotIds, splats, image });
        return { needed, flags: part(ranges, 16 * tiles, 16) };
    }

    // By ranges of Gaussians whose harmonics fit into one binding.
    color(commands, { count, degree, means, sh }, frame, counts, splats) {
        const key = `color SH ${degree}`;
        const row = 12 * (degree + 1) ** 2;
        const most = Math.floor(this.gpu.maxBinding / row / 64) * 64;
        for (let first = 0; first < count; first += most) {
            const rows = Math.min(most, count - first);
            const range = this.pool.uniform(`part ${first}`, this.gpu.kernel(key), "part", { first, count: rows });
            const colors = part(sh, first * row, rows * row);
            commands.dispatch(key, groups(rows), { frame, part: range, colors, tile_counts: counts, splats, means });
        }
    }
}
