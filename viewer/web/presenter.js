// Puts a drawn image on the canvas (shaders/present.wgsl), enlarged where it was drawn smaller.
import { Pool, bindGroupLayout, resource } from "./gpu.js";

export class Presenter {
    constructor(gpu, canvas, shader) {
        Object.assign(this, { gpu, canvas, shader, pool: new Pool(gpu) });
        const { device } = gpu;
        this.context = canvas.getContext("webgpu");
        const format = navigator.gpu.getPreferredCanvasFormat();
        this.context.configure({ device, format, alphaMode: "opaque" });
        this.layout = bindGroupLayout(device, shader.bindings, GPUShaderStage.FRAGMENT);
        const module = device.createShaderModule({ code: shader.source });
        this.pipeline = device.createRenderPipeline({
            layout: device.createPipelineLayout({ bindGroupLayouts: [this.layout] }),
            vertex: { module, entryPoint: "vertex" },
            fragment: { module, entryPoint: "fragment", targets: [{ format }] },
        });
    }

    present({ image, camera }) {
        const { gpu, canvas, shader } = this;
        const size = [canvas.width, canvas.height];
        const black = [0, 0, 0, 1];
        const present = this.pool.uniform("present", { uniforms: shader.uniforms }, "present", {
            heat0: black, heat1: black, heat2: black, heat3: black, heat4: black, heat5: black, background: black,
            size, picture: [camera.width, camera.height], value: 0, low: 0, high: 1,
        });
        const arrays = { present, image };
        const entries = Object.entries(shader.bindings).map(([name, [binding]]) => ({ binding, resource: resource(arrays[name]) }));
        const encoder = gpu.device.createCommandEncoder();
        const view = this.context.getCurrentTexture().createView();
        const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
        pass.setPipeline(this.pipeline);
        pass.setBindGroup(0, gpu.device.createBindGroup({ layout: this.layout, entries }));
        pass.draw(3);
        pass.end();
        gpu.device.queue.submit([encoder.finish()]);
    }
}
