// Frames: drawn where something changed, at the resolution that keeps up, one at a time (viewer/viewport.py).
import { add } from "./camera.js";
import { Commands, part } from "./gpu.js";

const PIXEL_BYTES = 20; // of an image with depth, which lies in one binding

// Width and height of a canvas of CSS pixels: of the screen's pixels, unless a texture or a binding holds fewer.
export function canvasSize(width, height, density, { maxTextureDimension2D, maxStorageBufferBindingSize }) {
    const most = Math.floor(maxStorageBufferBindingSize / PIXEL_BYTES);
    const ratio = Math.min(density, maxTextureDimension2D / Math.max(width, height, 1), Math.sqrt(most / Math.max(width * height, 1)));
    return [width, height].map(length => Math.max(1, Math.floor(ratio * length)));
}

export class Viewport {
    // state: {camera, clock, background, antialiased}. numbers: settled and target seconds, smallest scale. signal: ends it.
    constructor(canvas, state, { playback, rasterizer, presenter, numbers, signal }) {
        Object.assign(this, { canvas, state, playback, rasterizer, presenter, signal, ...numbers });
        // frame: on show. scale: of it; 1 is the full resolution. time: of it, in the clip. seconds: that it took. drawn: all
        // that it depends on. held: how many wait for a picture.
        Object.assign(this, { frame: null, scale: 1, movingScale: 1, time: NaN, seconds: NaN, drawn: "", movedAt: 0 });
        Object.assign(this, { busy: false, held: 0 });
    }

    // Whether the picture on show is that of the state, in full resolution.
    get atRest() { return !this.busy && this.scale === 1 && this.drawn === this.key(); }

    // Whether the picture on show may be read: the final one, or any while the clip plays.
    get readable() { return this.state.clock.playing ? !this.busy && this.drawn !== "" : this.atRest; }

    key() {
        const { camera: { position, rotation, fovY }, clock, background, antialiased } = this.state;
        return [position, rotation, fovY, clock.time, background, antialiased, this.canvas.width, this.canvas.height].join();
    }

    // Draw where something changed; whether it did. now: milliseconds of performance.now().
    async draw(now) {
        if (this.busy || this.held && this.readable) return false;
        const key = this.key();
        const moving = key !== this.drawn && this.frame !== null;
        if (key !== this.drawn) this.movedAt = now;
        else if (this.scale === 1 || now - this.movedAt < 1000 * this.settled) return false;
        this.busy = true;
        try {
            const scale = moving ? this.movingScale : 1;
            const start = performance.now();
            const { time } = this.state.clock; // goes on meanwhile
            this.frame = await this.drawWhole(scale);
            this.presenter.present(this.frame);
            Object.assign(this, { scale, time, drawn: key });
            this.seconds = (performance.now() - start) / 1000;
            if (moving) {
                const ideal = 0.5 * (this.movingScale + scale * Math.sqrt(this.target / Math.max(this.seconds, 1e-4)));
                this.movingScale = Math.min(Math.max(Math.floor(16 * ideal) / 16, this.smallest), 1);
            }
            return true;
        } finally {
            this.busy = false;
        }
    }

    // An image whose lists all fitted.
    async drawWhole(scale, depth = false) {
        const { canvas, state, rasterizer } = this;
        const [width, height] = [canvas.width, canvas.height].map(size => Math.max(1, Math.round(scale * size)));
        const now = this.playback.at(state.clock.time);
        const gaussians = { ...now, antialiased: state.antialiased && (now.antialiased || true) };
        const camera = state.camera.camera(canvas.width, canvas.height);
        const image = { ...camera, width, height, focal: scaled(camera.focal, canvas, width, height),
            center: scaled(camera.center, canvas, width, height) };
        for (;;) {
            const drawing = rasterizer.draw(gaussians, image, state.background, depth);
            const counts = await drawing.counts;
            if (rasterizer.valid(drawing, counts)) return drawing;
        }
    }

    // Turn about the surface under a point of the canvas from now on; x and y are CSS pixels.
    async focus(x, y) {
        await this.until(() => !this.busy);
        if (!this.frame) return;
        this.busy = true;
        try {
            const { playback: { gpu }, rasterizer, canvas, state: { camera } } = this;
            await gpu.compile(["rasterize DEPTH"]);
            const { image, camera: { width, height, focal, center } } = await this.drawWhole(1, true);
            const [column, row] = [[x / canvas.clientWidth, width], [y / canvas.clientHeight, height]] // a drag may end outside
                .map(([share, size]) => Math.min(Math.max(Math.floor(share * size), 0), size - 1));
            const pixel = [3, 4].map(plane => part(image, 4 * ((plane * height + row) * width + column), 4));
            const [rest, depth] = new Float32Array(await new Commands(gpu).read(pixel));
            if (!(rest < 0.9)) return; // next to nothing is there
            const ray = [(column + 0.5 - center[0]) / focal[0], (row + 0.5 - center[1]) / focal[1], 1];
            const along = ray.reduce((sum, length, axis) => add(sum, camera.rotation[axis], length), [0, 0, 0]);
            camera.place({ focus: add(camera.position, along, depth / (1 - rest)) });
        } finally {
            this.drawn = ""; // the image's buffer holds the depth now
            this.busy = false;
        }
    }

    // Wait, while no other frame begins: while the clip plays there is no pause between them. Raises what ended it all.
    async until(done) {
        for (this.held++; !done() && !this.signal.aborted;) await new Promise(requestAnimationFrame);
        this.held--;
        this.signal.throwIfAborted();
    }

    // The picture on show as float planes: red, green, blue, transmittance, row by row.
    async planes() {
        await this.until(() => this.readable);
        const { time, frame: { image, camera: { width, height } } } = this;
        return { width, height, time, values: new Float32Array(await new Commands(this.playback.gpu).read([image])) };
    }
}

const scaled = ([x, y], canvas, width, height) => [x * width / canvas.width, y * height / canvas.height];
