// The adapter, buffers by name that grow and never shrink, kernels that take arrays by name, and lists of dispatches.
// An array is {buffer, offset, bytes}: a part of a buffer. Kernels travel as data (viewer/web_page.py).
import { Refusal } from "./refusal.js";

const RAISED = ["maxStorageBufferBindingSize", "maxBufferSize"];
const KINDS = { uniform: "uniform", read: "read-only-storage", read_write: "storage" };

export async function openGpu(kernels) {
    if (!isSecureContext) throw new Refusal("WebGPU needs a page that came by https, from this machine, or as a file.");
    if (!navigator.gpu) throw new Refusal(`This browser shows no WebGPU. ${advice()}`);
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) throw new Refusal(`This browser knows WebGPU, but offers no graphics adapter for it: switch on graphics acceleration in its settings`
        + `${/Chrom/.test(navigator.userAgent) ? ", or chrome://flags/#enable-unsafe-webgpu" : ""}, or install a newer graphics driver.`);
    const requiredLimits = Object.fromEntries(RAISED.map(name => [name, adapter.limits[name]]));
    // Where a workgroup of 32 lanes is one subgroup; the raster pass says whether it is so indeed.
    const shuffles = adapter.features.has("subgroups") && adapter.info?.subgroupMinSize >= 32;
    const device = await adapter.requestDevice({ requiredFeatures: shuffles ? ["subgroups"] : [], requiredLimits });
    const { description, vendor = "", architecture = "" } = adapter.info ?? {};
    return new Gpu(device, kernels, device.features.has("subgroups"), description || `${vendor} ${architecture}`);
}

function advice() {
    const agent = navigator.userAgent;
    if (/Firefox/.test(agent)) return "Firefox has it from 141 on Windows and 145 on macOS; elsewhere set dom.webgpu.enabled in about:config.";
    if (/Chrom/.test(agent)) return "Chrome and Edge have it from 113 (Android 121, Linux 144); before, switch on chrome://flags/#enable-unsafe-webgpu.";
    if (/Safari/.test(agent)) return "Safari has it from version 26; before, switch on WebGPU under Settings, Feature Flags.";
    return "Chrome, Edge, Firefox and Safari have it in their present versions.";
}

class Gpu {
    // kernelData: sources and bindings by key. name: of the adapter. pools: how many there are.
    constructor(device, kernelData, subgroups, name) {
        Object.assign(this, { device, kernelData, subgroups, name, kernels: new Map(), pools: 0 });
        this.maxBinding = device.limits.maxStorageBufferBindingSize;
    }

    // Compile kernels that are not there yet, side by side. step: called after each.
    async compile(keys, step = () => {}) {
        await Promise.all(keys.filter(key => !this.kernels.has(key)).map(async key => {
            const kernel = new Kernel(this, key, this.kernelData[key]);
            await kernel.compile();
            this.kernels.set(key, kernel);
            step();
        }));
    }

    kernel(key) { return this.kernels.get(key); }
}

class Kernel {
    constructor(gpu, key, { source, bindings, uniforms }) {
        Object.assign(this, { gpu, key, source, bindings, uniforms });
        this.groups = new Map();
    }

    async compile() {
        const { device } = this.gpu;
        this.layout = bindGroupLayout(device, this.bindings, GPUShaderStage.COMPUTE);
        this.pipeline = await device.createComputePipelineAsync({
            label: this.key,
            layout: device.createPipelineLayout({ bindGroupLayouts: [this.layout] }),
            compute: { module: device.createShaderModule({ label: this.key, code: this.source }), entryPoint: "main" },
        });
    }

    bind(arrays) {
        const names = Object.keys(this.bindings);
        const key = names.map(name => `${arrays[name].buffer.label} ${arrays[name].offset} ${arrays[name].bytes}`).join("|");
        let group = this.groups.get(key);
        if (!group) {
            for (const name of names) {
                if (arrays[name].bytes > this.gpu.maxBinding) {
                    throw new Refusal(`The scene needs ${arrays[name].bytes} bytes of ${name} in one binding, but this `
                        + `adapter allows ${this.gpu.maxBinding}: export fewer Gaussians.`);
                }
            }
            const entries = names.map(name => ({ binding: this.bindings[name][0], resource: resource(arrays[name]) }));
            group = this.gpu.device.createBindGroup({ layout: this.layout, entries });
            if (this.groups.size > 64) this.groups.clear(); // arrays of other sizes leave groups behind
            this.groups.set(key, group);
        }
        return group;
    }
}

export function bindGroupLayout(device, bindings, visibility) {
    return device.createBindGroupLayout({ entries: Object.values(bindings).map(([binding, kind]) => (
        { binding, visibility, buffer: { type: KINDS[kind] } })) });
}

const bound = bytes => Math.max(16, Math.ceil(bytes / 16) * 16); // of an array of so many bytes
export const resource = array => ({ buffer: array.buffer, offset: array.offset, size: bound(array.bytes) });
export const part = (array, offset, bytes) => ({ buffer: array.buffer, offset: array.offset + offset, bytes });

// The bytes of a uniform, each member from `values` by name.
export function pack({ size, members }, values) {
    const view = new DataView(new ArrayBuffer(size));
    for (const [name, [offset, type, count]] of Object.entries(members)) {
        const numbers = count === 1 ? [values[name]] : values[name];
        for (let i = 0; i < count; i++) {
            if (type === "f") view.setFloat32(offset + 4 * i, numbers[i], true);
            else view.setUint32(offset + 4 * i, numbers[i], true);
        }
    }
    return new Uint8Array(view.buffer);
}

// Buffers by name; a name means one thing, in the module that owns the pool.
export class Pool {
    constructor(gpu) {
        this.gpu = gpu;
        this.number = gpu.pools++;
        this.buffers = new Map();
        this.contents = new Map();
    }

    array(name, bytes) {
        let buffer = this.buffers.get(name);
        if (!buffer || buffer.size < bytes) {
            const { limits } = this.gpu.device;
            if (bytes > limits.maxBufferSize) {
                throw new Refusal(`The scene needs ${bytes} bytes for its ${name}, but a buffer of this adapter holds `
                    + `${limits.maxBufferSize}: export fewer Gaussians.`);
            }
            buffer?.destroy();
            const usage = GPUBufferUsage.STORAGE | GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST;
            const label = `${this.number} ${name} ${bytes}`;
            buffer = this.gpu.device.createBuffer({ label, size: bound(bytes), usage });
            this.buffers.set(name, buffer);
        }
        return { buffer, offset: 0, bytes };
    }

    upload(name, values) {
        const array = this.array(name, values.byteLength);
        this.gpu.device.queue.writeBuffer(array.buffer, 0, values);
        return array;
    }

    // A uniform of a kernel, written only when its content changes.
    uniform(name, kernel, binding, values) {
        const content = pack(kernel.uniforms[binding], values);
        const array = this.array(`constant ${name}`, content.length);
        const known = this.contents.get(name);
        if (!known || known.length !== content.length || !known.every((byte, i) => byte === content[i])) {
            this.gpu.device.queue.writeBuffer(array.buffer, 0, content);
            this.contents.set(name, content);
        }
        return array;
    }
}

// A list of dispatches.
export class Commands {
    constructor(gpu) {
        this.gpu = gpu;
        this.encoder = gpu.device.createCommandEncoder();
        this.pass = null;
    }

    // Run workgroups, folded into two dimensions where one does not hold them.
    dispatch(key, groups, arrays) {
        const rows = Math.max(1, Math.ceil(groups / this.gpu.device.limits.maxComputeWorkgroupsPerDimension));
        this.dispatchGrid(key, Math.ceil(groups / rows), rows, arrays);
    }

    dispatchGrid(key, columns, rows, arrays) {
        if (Math.min(columns, rows) <= 0) return;
        const kernel = this.gpu.kernel(key);
        this.pass ??= this.encoder.beginComputePass();
        this.pass.setPipeline(kernel.pipeline);
        this.pass.setBindGroup(0, kernel.bind(arrays));
        this.pass.dispatchWorkgroups(columns, rows);
    }

    clear(array) {
        this.endPass();
        this.encoder.clearBuffer(array.buffer, array.offset, array.bytes);
    }

    // Submit, and what arrays then hold, one after another.
    async read(arrays) {
        const size = arrays.reduce((sum, { bytes }) => sum + bytes, 0);
        const staging = this.gpu.device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
        this.endPass();
        let at = 0;
        for (const { buffer, offset, bytes } of arrays) {
            this.encoder.copyBufferToBuffer(buffer, offset, staging, at, bytes);
            at += bytes;
        }
        this.submit();
        // Firefox looks only every 100 ms whether a buffer is mapped, unless something is submitted (bug 1870699).
        const nudge = setInterval(() => this.gpu.device.queue.submit([]), 2);
        await staging.mapAsync(GPUMapMode.READ).finally(() => clearInterval(nudge));
        const content = staging.getMappedRange().slice(0);
        staging.destroy();
        return content;
    }

    endPass() {
        this.pass?.end();
        this.pass = null;
    }

    submit() {
        this.endPass();
        this.gpu.device.queue.submit([this.encoder.finish()]);
    }
}
