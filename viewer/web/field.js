// The Gaussians of a scene at a time: motion/playback/playback.py on the page, and its activations.
import { Commands, Pool, part } from "./gpu.js";
import { HashEncoder } from "./hash_encoder.js";
import { temporalGrids } from "./hash_grid.js";

const LANES = 64;
const POINTS = 2; // Gaussians of a lane, deform.wgsl
const CANONICAL = 16; // floats of a Gaussian before its still features, deform.wgsl
const BLOCK_BYTES = 128 * 2 ** 20;
const APPEARANCE_SCALE = 0.1; // motion/fields/config.py
const GEOMETRY = [[4, 0, false], [3, 2, true], [4, 1, false], [3, 3, true]]; // outputs of a head, the quad that takes them, and whether they are lengths

export class Playback {
    constructor(gpu, scene, minScale) {
        Object.assign(this, { gpu, scene, time: NaN });
        const { count, shDegree, antialiased } = scene;
        const pool = this.pool = new Pool(gpu);
        const active = activate(scene, minScale);
        this.gaussians = { count, degree: shDegree, antialiased };
        for (const name of ["means", "quats", "scales", "opacities", "sh"]) {
            this.gaussians[name] = pool.upload(name, active[name]);
        }
        if (scene.field) this.prepare(active);
    }

    prepare(active) {
        const { gpu, scene: { count, field, parameters }, pool } = this;
        const grids = temporalGrids(field);
        this.heads = field.appearance ? 5 : 4;
        this.deform = field.appearance ? "deform COLOR MOTION" : field.laplacian ? "deform MOTION" : "deform";
        this.rounds = Math.ceil(field.width / 4);
        this.firstTemporal = field.dynamics + field.dynamics % 2; // features come in pairs
        const features = grids.reduce((all, grid) => all + grid.features, 0);
        this.stillQuads = Math.ceil(field.staticFeatures / 4);
        this.movingQuads = Math.ceil((this.firstTemporal + features) / 4);
        const row = Math.max(CANONICAL + 4 * this.stillQuads, 4 * this.movingQuads);
        const size = Math.floor(BLOCK_BYTES / (4 * row) / LANES) * LANES;
        this.blocks = [];
        for (let first = 0; first < count; first += size) {
            this.blocks.push(this.block(active, first, Math.min(size, count - first)));
        }
        this.encoder = new HashEncoder(gpu, grids, field.bound, 4 * this.movingQuads, this.firstTemporal);
        this.tables = grids.map((_, i) => pool.upload(`table ${i}`, parameters[`temporal_grids.${i}.table`]));
        const stream = this.stream(features);
        this.streamAt = this.headsAt(0).length / 4;
        this.weights = pool.array("weights", 16 * this.streamAt + 4 * stream.length);
        gpu.device.queue.writeBuffer(this.weights.buffer, 16 * this.streamAt, stream);
    }

    block(active, first, count) {
        const { field, gaussians } = this.scene;
        const points = new Float32Array(4 * count);
        const stillRow = CANONICAL + 4 * this.stillQuads;
        const still = new Float32Array(stillRow * count);
        const movingRow = 4 * this.movingQuads;
        const moving = new Float32Array(Math.max(4, movingRow) * count);
        const coefficients = (this.scene.shDegree + 1) ** 2;
        const copy = (to, at, from, i, width) => to.set(from.subarray(i * width, (i + 1) * width), at);
        for (let n = 0; n < count; n++) {
            const i = first + n;
            copy(points, 4 * n, active.means, i, 3);
            const at = stillRow * n;
            copy(still, at, active.means, i, 3);
            still[at + 3] = gaussians.opacity_logits[i];
            copy(still, at + 4, active.quats, i, 4);
            copy(still, at + 8, active.scales, i, 3);
            still[at + 11] = field.mirrorsScales ? 1 : 0;
            still.set(active.sh.subarray(3 * coefficients * i, 3 * coefficients * i + 3), at + 12);
            copy(still, at + CANONICAL, gaussians.static_features, i, field.staticFeatures);
            if (field.dynamics) copy(moving, movingRow * n, gaussians.dynamics, i, field.dynamics);
        }
        const upload = (name, values) => this.pool.upload(`${name} from ${first}`, values);
        return { first, count, points: upload("points", points), still: upload("still", still), moving: upload("moving", moving) };
    }

    // Biases and layers of the decoder, four outputs at a time, in the order in which the pass reads them.
    stream(features) {
        const { field: { width, dynamics, staticFeatures, laplacian }, parameters } = this.scene;
        const halved = name => parameters[name].map(value => 0.5 * value); // see common/gate.wgsl
        const layer = (weight, inputs) => (output, input) => (output < width && input < inputs ? weight[output * inputs + input] : 0);
        const biases = [halved("spatial.bias"), parameters["temporal.bias"]];
        const spatial = [layer(halved("spatial.weight"), staticFeatures)];
        if (laplacian) {
            biases.push(parameters["motion.first.bias"]);
            spatial.push(layer(parameters["motion.first.weight"], staticFeatures));
        }
        const temporal = layer(parameters["temporal.weight"], dynamics + features);
        const gap = this.firstTemporal - dynamics; // behind the dynamics
        const out = [];
        for (let round = 0; round < this.rounds; round++) {
            const put = value => {
                for (let output = 4 * round; output < 4 * round + 4; output++) out.push(value(output));
            };
            for (const bias of biases) put(output => bias[output] ?? 0);
            for (let input = 0; input < 4 * this.stillQuads; input++) {
                for (const weight of spatial) put(output => weight(output, input));
            }
            for (let input = 0; input < 4 * this.movingQuads; input++) {
                const inGap = input >= dynamics && input < dynamics + gap;
                put(output => (inGap ? 0 : temporal(output, input < dynamics ? input : input - gap)));
            }
        }
        return new Float32Array(out);
    }

    // Biases and, by channel, weights of the heads; with the Laplacian motion at a time folded in.
    headsAt(t) {
        const { heads, scene: { field: { width, laplacian, appearance, unit }, parameters: p } } = this;
        const row = laplacian ? heads + 4 : heads;
        const out = new Float32Array(4 * (heads + 4 * this.rounds * row));
        const column = channel => 4 * (heads + channel * row);
        const outputs = GEOMETRY.flatMap(([count, quad, length]) =>
            Array.from({ length: count }, (_, i) => [4 * quad + i, length ? unit : 1]));
        const series = laplacian ? this.series(t) : null;
        outputs.forEach(([place, factor], output) => {
            const weight = p["heads.weight"].subarray(output * width, (output + 1) * width).map(value => factor * value);
            let bias = factor * p["heads.bias"][output];
            const folded = new Float64Array(width);
            for (let k = 0; k < width; k++) {
                out[column(k) + place] = weight[k];
                if (!laplacian) continue;
                const scaled = weight[k] * series[k];
                bias += scaled * p["motion.second.bias"][k];
                for (let j = 0; j < width; j++) folded[j] += scaled * p["motion.second.weight"][k * width + j];
            }
            out[place] = bias;
            if (laplacian) folded.forEach((value, j) => (out[column(j) + 4 * heads + place] = value));
        });
        for (let output = 0; output < appearance; output++) {
            const place = output < 3 ? 16 + output : 11; // of the color's quad; the opacity's, behind the shift
            out[place] = APPEARANCE_SCALE * p["appearance.bias"][output];
            for (let k = 0; k < width; k++) out[column(k) + place] = APPEARANCE_SCALE * p["appearance.weight"][output * width + k];
        }
        return out;
    }

    // L(t), the sum of the spectrum's components.
    series(t) {
        const { field: { width, components }, parameters: p } = this.scene;
        const sum = new Float64Array(width);
        for (let k = 0; k < components; k++) {
            const phase = 2 * Math.PI * t * p["motion.frequencies"][k];
            const [cos, sin] = [Math.cos(phase), Math.sin(phase)];
            for (let j = 0; j < width; j++) {
                sum[j] += cos * p["motion.alpha"][k * width + j] + sin * p["motion.beta"][k * width + j];
            }
        }
        return sum;
    }

    // The Gaussians at a time in [0, 1]: submitted, not waited for.
    at(t) {
        if (this.scene.field && t !== this.time) this.move(momentAt(this.scene.timing, t));
        this.time = t;
        return this.gaussians;
    }

    move(t) {
        const { gpu, pool, gaussians: out, scene: { field, shDegree } } = this;
        gpu.device.queue.writeBuffer(this.weights.buffer, 0, this.headsAt(t));
        const time = 0.5 * ((2 * t - 1) * field.timeScale + 1);
        const coefficients = (shDegree + 1) ** 2;
        this.blocks.forEach(({ first, count, points, still, moving }, number) => {
            const commands = new Commands(gpu); // a submission each: all together may take longer than watchdogs allow
            this.encoder.record(commands, number, { points, encoding: moving, tables: this.tables, n: count, time });
            const deform = pool.uniform(`deform ${number}`, gpu.kernel(this.deform), "deform", {
                gaussians: count, rounds: this.rounds, still_quads: this.stillQuads,
                moving_quads: this.movingQuads, stream: this.streamAt, sh_stored: coefficients,
            });
            const range = (array, row) => part(array, row * first, row * count);
            commands.dispatch(this.deform, Math.ceil(count / (LANES * POINTS)), {
                deform, still, moving, weights: this.weights, means: range(out.means, 12), quats: range(out.quats, 16),
                scales: range(out.scales, 12), opacities: range(out.opacities, 4), colors: range(out.sh, 12 * coefficients),
            });
            commands.submit();
        });
    }
}

// The Gaussians after their activations.
function activate({ count, shDegree, gaussians: g }, minScale) {
    const rest = (shDegree + 1) ** 2 - 1;
    const sh = new Float32Array(3 * count * (rest + 1));
    const quats = new Float32Array(4 * count);
    for (let i = 0; i < count; i++) {
        sh.set(g.sh_dc.subarray(3 * i, 3 * i + 3), 3 * i * (rest + 1));
        if (rest) sh.set(g.sh_rest.subarray(3 * rest * i, 3 * rest * (i + 1)), 3 * i * (rest + 1) + 3);
        const q = g.quats.subarray(4 * i, 4 * i + 4);
        const length = Math.max(Math.hypot(...q), 1e-12);
        for (let k = 0; k < 4; k++) quats[4 * i + k] = q[k] / length;
    }
    const scales = g.log_scales.map(value => Math.max(Math.exp(value), minScale));
    const opacities = g.opacity_logits.map(value => 0.5 + 0.5 * Math.tanh(0.5 * value));
    return { means: g.means, quats, scales, opacities, sh };
}

// The time of the motion at a time of the capture (motion/timing.py), both in [0, 1]; of no timing (null) the time itself.
function momentAt(timing, t) {
    if (!timing) return t;
    const { times, moments } = timing;
    const after = times.findIndex(time => time > t), before = after < 0 ? times.length - 1 : Math.max(0, after - 1);
    const late = i => moments[i] - times[i];
    const share = after > 0 ? (t - times[before]) / (times[after] - times[before]) : 0;
    const shift = share ? late(before) + share * (late(after) - late(before)) : late(before);
    return Math.min(Math.max(t + shift, 0), 1);
}
