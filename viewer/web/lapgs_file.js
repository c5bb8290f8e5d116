// The container of a compact scene (docs/format.md): a header, then a deflated safetensors file. Nothing in it is trusted.
import { Refusal, quoted } from "./refusal.js";

const MAGIC = "lapgs4d\n";
const HEADER = 20; // magic, version, bytes once unpacked
const VERSION = 2;
const MOST_BYTES = 2 ** 30; // once unpacked
const MOST_RATIO = 64; // of unpacked bytes to packed ones
const MOST_TABLE = 2 ** 20; // of the safetensors file's table
const ARRAYS = { F32: Float32Array, F16: Uint16Array, U32: Uint32Array, U16: Uint16Array, U8: Uint8Array };

const damaged = reason => new Refusal(`The scene cannot be read: ${reason}; the file is damaged, or not a scene.lapgs.`);

// The bytes of a stream that is a scene, which has `length` bytes or more. What cannot be one is not read on. Raises Refusal.
export async function readStream(stream, length, progress) {
    let head = new Uint8Array(0);
    return collect(stream, (size, chunk) => {
        if (head.length < HEADER) head = Uint8Array.of(...head, ...chunk.subarray(0, HEADER - head.length));
        if (head.length === HEADER) unpackedSize(head, Math.max(size, length));
        progress(size);
    });
}

// All bytes of a stream. check: called with their number so far and each chunk; ends the stream where it throws.
async function collect(stream, check) {
    const reader = stream.getReader();
    const chunks = [];
    let size = 0;
    try {
        for (let next; !(next = await reader.read()).done;) {
            chunks.push(next.value);
            size += next.value.length;
            check(size, next.value);
        }
    } finally {
        reader.cancel().catch(() => {});
    }
    const bytes = new Uint8Array(size);
    for (const chunk of chunks.reverse()) bytes.set(chunk, size -= chunk.length);
    return bytes;
}

// What the header declares, of a file of `length` bytes. Raises Refusal.
function unpackedSize(head, length) {
    const view = new DataView(head.buffer, head.byteOffset, head.byteLength);
    if (head.length < HEADER || String.fromCharCode(...head.subarray(0, MAGIC.length)) !== MAGIC) {
        throw damaged(`its ${length} bytes do not begin as a scene does`);
    }
    const version = view.getUint32(8, true);
    if (version < 1 || version > VERSION) {
        throw new Refusal(`The scene has version ${version} of its format, and this page reads versions 1 to ${VERSION}: `
            + "export the page again with a newer lapgs-view.");
    }
    const size = Number(view.getBigUint64(12, true));
    if (size > MOST_BYTES) throw new Refusal(`The scene unpacks to ${size} bytes, and a page takes ${MOST_BYTES} at most: export fewer Gaussians.`);
    if (length > HEADER + 1.01 * size + 1024) throw damaged(`it has ${length} bytes, more than the ${size} that it declares are packed into`);
    return size;
}

// {tensors: name -> {dtype, shape, data}, metadata: name -> text}. Raises Refusal.
export async function readContainer(bytes) {
    const size = unpackedSize(bytes, bytes.length);
    const packed = bytes.subarray(HEADER);
    if (size > MOST_RATIO * packed.length) {
        throw damaged(`it declares ${size} bytes in ${packed.length} packed ones, which hold ${MOST_RATIO} times their number at most`);
    }
    const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const content = await collect(unpacked, at => {
        if (at > size) throw damaged(`it unpacks to more than the ${size} bytes that it declares`);
    }).catch(error => {
        throw error instanceof Refusal ? error : damaged("it cannot be unpacked");
    });
    if (content.length !== size) throw damaged(`it unpacks to ${content.length} of the ${size} bytes that it declares`);
    return readTensors(content);
}

function readTensors(content) {
    const length = content.length < 8 ? Infinity : Number(new DataView(content.buffer).getBigUint64(0, true));
    if (length > Math.min(content.length - 8, MOST_TABLE)) throw damaged(`its table of ${length} bytes does not fit`);
    let table;
    try {
        table = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(content.subarray(8, 8 + length)));
    } catch {
        throw damaged("its table is not JSON");
    }
    if (!isTable(table)) throw damaged("its table is not a JSON object");
    const { __metadata__: metadata = {}, ...entries } = table;
    if (!isTable(metadata) || !Object.values(metadata).every(text => typeof text === "string")) {
        throw damaged("its metadata are not texts");
    }
    const tensors = new Map();
    let end = 0;
    for (const [name, entry] of Object.entries(entries).sort(byBegin)) {
        const type = isTable(entry) && Object.hasOwn(ARRAYS, entry.dtype) ? ARRAYS[entry.dtype] : undefined;
        if (!type || !areSizes(entry.shape) || !areSizes(entry.data_offsets)) {
            throw damaged(`its tensor ${quoted(name)} is not declared as known`);
        }
        const count = entry.shape.reduce((all, each) => all * each, 1);
        const [begin, last] = entry.data_offsets;
        if (begin !== end || last - begin !== count * type.BYTES_PER_ELEMENT) {
            throw damaged(`its tensor ${quoted(name)} of ${count} values lies at bytes ${begin} to ${last}, after ${end}`);
        }
        end = last;
        if (8 + length + end > content.length) throw damaged(`its tensor ${quoted(name)} ends beyond the file`);
        const data = new type(content.slice(8 + length + begin, 8 + length + end).buffer);
        tensors.set(name, { dtype: entry.dtype, shape: entry.shape, data });
    }
    if (8 + length + end !== content.length) throw damaged(`its tensors end at ${end} of ${content.length - 8 - length} bytes`);
    return { tensors, metadata };
}

const isTable = value => typeof value === "object" && value !== null && !Array.isArray(value);
const areSizes = value => Array.isArray(value) && value.length <= 8 && value.every(n => Number.isSafeInteger(n) && n >= 0);
const byBegin = ([, a], [, b]) => (a?.data_offsets?.[0] ?? 0) - (b?.data_offsets?.[0] ?? 0)
    || (a?.data_offsets?.[1] ?? 0) - (b?.data_offsets?.[1] ?? 0);
