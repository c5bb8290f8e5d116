// A compact scene, checked and expanded to the arrays that its desktop twin motion/compact_scene.py gives, to the bit.
import { temporalGrids } from "./hash_grid.js";
import { readContainer } from "./lapgs_file.js";
import { Refusal, quoted } from "./refusal.js";

const EXACT = "motion.frequencies"; // float32, the other weights are float16
const GEOMETRY_OUTPUTS = 14;
const APPEARANCES = new Map([["none", 0], ["color", 3], ["color+opacity", 4]]); // outputs of the head

const damaged = reason => new Refusal(`The scene cannot be read: ${reason}; the file is damaged.`);

// {count, shDegree, antialiased, timing, field, gaussians, parameters, metadata}; field is null where nothing moves, timing
// where each time is its own moment. Raises Refusal.
export async function readScene(bytes) {
    const { tensors, metadata } = await readContainer(bytes);
    const shDegree = whole(Number(metadata.sh_degree ?? NaN), "sh_degree", 0, 3);
    const antialiased = readAntialiased(metadata.antialiased ?? "false"); // older files lack it
    const timing = metadata.timing === undefined ? null : readTiming(metadata.timing);
    const field = readField(metadata.field);
    const means = tensors.get("gaussians.means");
    const count = means?.shape.length === 2 ? means.shape[1] : 0;
    if (!count) throw damaged("it holds no Gaussians");
    const columns = { means: 3, log_scales: 3, quats: 4, opacity_logits: 1, sh_dc: 3 };
    if (shDegree) columns.sh_rest = 3 * ((shDegree + 1) ** 2 - 1);
    if (field?.dynamics) columns.dynamics = field.dynamics;
    if (field) columns.static_features = field.staticFeatures;
    const gaussians = {};
    for (const [name, width] of Object.entries(columns)) {
        gaussians[name] = dequantize(tensors, `gaussians.${name}`, count, width, [0]);
    }
    const parameters = field ? readParameters(tensors, field) : {};
    return { count, shDegree, antialiased, timing, field, gaussians, parameters, metadata };
}

// A number is the variance of the low-pass filter, px^2.
function readAntialiased(text) {
    const value = new Map([["true", true], ["false", false]]).get(text) ?? Number(text);
    if (!(value >= 0 && value < 1e6)) throw damaged(`its antialiased is ${quoted(text)}`);
    return value;
}

function whole(value, name, low, high) {
    if (!Number.isInteger(value) || value < low || value > high) {
        throw damaged(`its ${name} is ${quoted(value)}, where ${low} to ${high} are possible`);
    }
    return value;
}

function real(value, name, high) {
    if (typeof value !== "number" || !(value > 0 && value <= high)) {
        throw damaged(`its ${name} is ${quoted(value)}, where numbers above 0 and up to ${high} are possible`);
    }
    return value;
}

function readTable(text, of) {
    try {
        return JSON.parse(text);
    } catch {
        throw damaged(`${of} is not JSON`);
    }
}

function readTiming(text) {
    const timing = readTable(text, "its timing");
    const rises = (list, least) => Array.isArray(list) && list.length > 0
        && list.every((x, i) => typeof x === "number" && x >= 0 && x <= 1 && !(x - list[i - 1] < least));
    if (!rises(timing?.times, Number.MIN_VALUE) || !rises(timing.moments, 0) || timing.times.length !== timing.moments.length) {
        throw damaged("its timing is not of times and moments that rise from 0 to 1");
    }
    return timing;
}

// What playback needs of FieldConfig (motion/fields/config.py).
function readField(text) {
    const field = readTable(text, "the description of its field");
    const kind = field?.kind;
    if (kind === "static") return null;
    const laplacian = kind === "laplacian";
    const appearance = laplacian ? APPEARANCES.get(field.appearance) : 0;
    if (!(laplacian || kind === "grid4d") || field.depth !== 0 || (laplacian && field.motion !== "laplacian")
        || appearance === undefined || typeof field.temporal_hash !== "boolean"
        || !["floor", "mirror", undefined].includes(field.negative_scales)) {
        throw damaged(`its field ${quoted(kind)} is none that this page can evaluate`);
    }
    const temporal = field.temporal;
    whole(temporal?.levels, "temporal.levels", 1, 64);
    whole(temporal.table_log2, "temporal.table_log2", 1, 24);
    for (const name of ["base", "finest"]) {
        if (!Array.isArray(temporal[name]) || temporal[name].length !== 3) throw damaged(`its temporal.${name} is no list of 3`);
        for (const resolution of temporal[name]) whole(resolution, `temporal.${name}`, 2, 65536);
    }
    return {
        laplacian,
        appearance,
        temporal,
        temporal_hash: field.temporal_hash,
        mirrorsScales: field.negative_scales === "mirror", // older files lack it
        bound: real(field.bound, "bound", 1e6),
        unit: real(field.unit ?? 1, "unit", 1e6), // older files lack it
        timeScale: real(field.time_scale, "time_scale", 1),
        width: whole(field.width, "width", 1, 4096),
        staticFeatures: 2 * whole(field.static?.levels, "static.levels", 1, 64),
        components: laplacian ? whole(field.components, "components", 1, 256) : 0,
        dynamics: laplacian ? whole(field.dynamics, "dynamics", 0, 256) : 0,
    };
}

function readParameters(tensors, field) {
    const parameters = {};
    const grids = temporalGrids(field);
    const starts = grids.length ? grids[0].levels.map(level => level.first) : [0];
    grids.forEach((grid, i) => {
        const name = `temporal_grids.${i}.table`;
        parameters[name] = dequantize(tensors, `field.${name}`, grid.entries, 2, starts);
    });
    const { width, staticFeatures, components } = field;
    const moving = Math.max(1, field.dynamics + grids.reduce((all, grid) => all + grid.features, 0));
    const layers = { spatial: [width, staticFeatures], temporal: [width, moving], heads: [GEOMETRY_OUTPUTS, width] };
    if (field.laplacian) Object.assign(layers, { "motion.first": [width, staticFeatures], "motion.second": [width, width] });
    if (field.appearance) layers.appearance = [field.appearance, width];
    const shapes = field.laplacian
        ? { "motion.alpha": [components, width], "motion.beta": [components, width], [EXACT]: [components] } : {};
    for (const [name, shape] of Object.entries(layers)) {
        Object.assign(shapes, { [`${name}.weight`]: shape, [`${name}.bias`]: [shape[0]] });
    }
    for (const [name, shape] of Object.entries(shapes)) {
        const { data } = find(tensors, `field.${name}`, shape, name === EXACT ? ["F32"] : ["F16"]);
        parameters[name] = name === EXACT ? data : Float32Array.from(data, half);
        if (!parameters[name].every(Number.isFinite)) throw damaged(`its tensor ${quoted(name)} holds NaN or infinity`);
    }
    return parameters;
}

// The value of a float16.
function half(bits) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    if (exponent === 31) return NaN;
    return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
}

function find(tensors, name, shape, types) {
    const tensor = tensors.get(name);
    if (!tensor) throw damaged(`it has no tensor ${quoted(name)}`);
    if (!types.includes(tensor.dtype) || String(tensor.shape) !== String(shape)) {
        throw damaged(`its tensor ${quoted(name)} is ${tensor.dtype} of ${quoted(tensor.shape)}, not ${types} of [${shape}]`);
    }
    return tensor;
}

// Values row by row; starts: first rows of the parts that have ranges of their own. Outliers are counted column by column.
function dequantize(tensors, name, rows, columns, starts) {
    const { data } = find(tensors, name, [columns, rows], ["U8", "U16", "F32"]);
    const ranges = find(tensors, `${name}.range`, [starts.length, columns, 2], ["F32"]).data;
    const values = new Float32Array(rows * columns);
    for (let part = 0; part < starts.length; part++) {
        const end = starts[part + 1] ?? rows;
        for (let column = 0; column < columns; column++) {
            const low = ranges[2 * (part * columns + column)];
            const step = ranges[2 * (part * columns + column) + 1];
            for (let row = starts[part]; row < end; row++) {
                values[row * columns + column] = low + step * data[column * rows + row];
            }
        }
    }
    const places = tensors.get(`${name}.outliers`);
    if (places) {
        const count = places.data.length;
        const { data: at } = find(tensors, `${name}.outliers`, [count], ["U32"]);
        const { data: exact } = find(tensors, `${name}.exact`, [count], ["F32"]);
        if (!at.every((place, i) => place < rows * columns && (i === 0 || place > at[i - 1]))) {
            throw damaged(`its tensor ${quoted(`${name}.outliers`)} does not count places in ascending order`);
        }
        at.forEach((place, i) => (values[place % rows * columns + Math.floor(place / rows)] = exact[i]));
    }
    if (!values.every(Number.isFinite)) throw damaged(`its tensor ${quoted(name)} has a range beyond float32`);
    return values;
}
