// Opens the scene that the page carries, that ?src=URL names, or that is dropped on it, and shows it.
import { applyAddress, makeApi } from "./api.js";
import { ViewCamera, firstView } from "./camera.js";
import { Clock } from "./clock.js";
import { Controls } from "./controls.js";
import { Playback } from "./field.js";
import { openGpu } from "./gpu.js";
import { readStream } from "./lapgs_file.js";
import { Presenter } from "./presenter.js";
import { Rasterizer } from "./rasterizer.js";
import { Refusal } from "./refusal.js";
import { readScene } from "./scene.js";
import { Transport } from "./transport.js";
import { Viewport, canvasSize } from "./viewport.js";

const find = name => document.getElementById(name);
const LONGEST_STEP = 0.25; // seconds that the clock goes on at once, after a tab was in the background
const OPENING = "Opening the graphics adapter";
let shown = null; // ends what is on the page
const STEADY = 10_000; // milliseconds on show, after which a scene whose device is lost is opened again
let wanted = 0; // number of the scene that was asked for last
let newest = 0; // number of the scene on show

// Say one sentence over the picture; an empty one goes away.
function say(text) {
    find("note").textContent = text;
    find("note").hidden = !text;
}

// What went wrong while the page did what: one sentence over the picture, and a message to the page around it.
function report(error, doing) {
    const graphics = doing === OPENING || /^GPU/.test(error.constructor.name);
    const reason = error instanceof Refusal ? error.message : `${doing} failed (${String(error.message).split("\n")[0].slice(0, 200)}): `
        + (graphics ? "try another browser or a newer driver." : "load the page again, or report this error.");
    say(reason);
    tell({ lapgs: "failed", reason });
}

// The page in whose frame this one is.
const tell = message => parent !== window && parent.postMessage(message, "*");

async function embedded() {
    const text = find("scene").textContent.trim();
    const letters = atob(text);
    const bytes = Uint8Array.from({ length: letters.length }, (_, i) => letters.charCodeAt(i));
    if (!bytes.length) throw new Refusal("This page carries no scene: drop a scene.lapgs on it.");
    return bytes;
}

async function fetched(address, progress) {
    const answer = await fetch(address).catch(() => {
        throw new Refusal(`${address} cannot be fetched: only files beside this page on its own server can, and none from file://.`);
    });
    if (!answer.ok) throw new Refusal(`${address} cannot be fetched: the server says ${answer.status}; check the address.`);
    return streamed(answer.body, Number(answer.headers.get("Content-Length")) || 0, progress);
}

function streamed(stream, length, progress) {
    const total = length ? ` of ${(length / 1e6).toFixed(1)}` : "";
    return readStream(stream, length, size => progress(`Loading ${(size / 1e6).toFixed(1)}${total} MB`));
}

// Show the scene whose bytes `load` gives, in place of the present one; where it fails the present one stays. Of several
// that are opened at once the last one stays. state: to go on in.
async function open(load, data, state = null) {
    const number = ++wanted;
    const progress = text => number === wanted && say(text);
    let gpu;
    let doing = OPENING;
    try {
        progress("Loading");
        gpu = await openGpu(data.kernels); // first: without WebGPU there is nothing to wait for
        doing = "Reading the scene";
        const scene = await readScene(await load(progress));
        doing = "Preparing the scene";
        const next = await prepare(gpu, scene, data, state, progress);
        if (number < newest) return gpu.device.destroy();
        newest = number;
        shown?.();
        const { api, stop } = next(present => open(load, data, present));
        shown = stop;
        window.lapgs = api;
        say("");
        tell({ lapgs: "ready" });
    } catch (error) {
        gpu?.device.destroy();
        if (number > newest) report(error, doing);
    }
}

async function prepare(gpu, scene, data, former, progress) {
    const rasterizer = new Rasterizer(gpu, data.tile);
    const keys = [...data.always, "rasterize", rasterizer.rasterize, `color SH ${scene.shDegree}`];
    gpu.device.pushErrorScope("out-of-memory");
    const playback = new Playback(gpu, scene, data.minScale);
    if (await gpu.device.popErrorScope()) {
        throw new Refusal(`The adapter has not enough memory for ${scene.count} Gaussians: close other pages, or export fewer.`);
    }
    if (scene.field) keys.push(...data.field, playback.deform);
    let compiled = 0;
    await gpu.compile([...new Set(keys)], () => progress(`Compiling ${++compiled} of ${new Set(keys).size} passes`));
    const first = firstView(scene.metadata.view, scene.gaussians.means);
    const clock = new Clock(scene.field ? first.frames : 1, data.loops, data.speeds);
    const trained = scene.metadata.background; // on it
    const background = data.backgrounds[Object.hasOwn(data.backgrounds, trained) ? trained : "black"];
    delete scene.gaussians; // the device has them now
    const antialiased = Boolean(scene.antialiased);
    const state = former ?? { camera: new ViewCamera(first), clock, background, antialiased, fresh: true };
    return reopen => start(gpu, { scene, playback, rasterizer }, state, data, reopen);
}

function start(gpu, { scene, playback, rasterizer }, state, data, reopen) {
    const canvas = find("canvas");
    const ended = new AbortController();
    const { signal } = ended;
    const { clock, camera } = state;
    const begun = performance.now();
    let last = begun;
    const wake = () => transport.update();
    const stop = reason => {
        ended.abort(reason);
        gpu.device.destroy();
    };
    const fail = error => {
        if (signal.aborted) return;
        stop(error);
        find("poster").hidden = false;
        report(error, "Drawing the scene");
    };
    const toggle = name => (find(name).hidden = !find(name).hidden);
    const setBackground = color => (state.background = color);
    const actions = {
        toggle_playing: () => clock.toggle(),
        previous_frame: () => clock.step(-1),
        next_frame: () => clock.step(1),
        first_frame: () => clock.seek(0),
        last_frame: () => clock.seek(1),
        slower: () => clock.slower(),
        faster: () => clock.faster(),
        next_loop: () => clock.nextLoop(),
        next_background: () => setBackground(after(Object.values(data.backgrounds), state.background)),
        antialiased: () => (state.antialiased = !state.antialiased),
        focus: (x, y) => viewport.focus(x, y).catch(fail),
        reset_camera: () => camera.reset(),
        show_overlay: () => toggle("overlay"),
        show_transport: () => scene.field && toggle("bar"),
        show_panels: () => toggle("panels"),
        show_help: () => toggle("help"),
    };
    const transport = new Transport(document, state, { actions, wake, signal });
    new Controls(canvas, state, data.controls, actions, wake, signal);
    transport.bar.hidden = !scene.field;
    const address = () => {
        applyAddress(location.hash, { clock, backgrounds: data.backgrounds, setBackground });
        wake();
    };
    if (state.fresh) address();
    state.fresh = false;
    addEventListener("hashchange", address, { signal });

    const resize = () => {
        const size = canvasSize(canvas.clientWidth, canvas.clientHeight, devicePixelRatio, gpu.device.limits);
        if (size[0] !== canvas.width || size[1] !== canvas.height) [canvas.width, canvas.height] = size;
    };
    const presenter = new Presenter(gpu, canvas, data.present);
    const viewport = new Viewport(canvas, state, { playback, rasterizer, presenter, numbers: data.viewport, signal });
    const api = makeApi(state, viewport, wake);
    gpu.device.lost.then(({ message }) => {
        const again = !signal.aborted && performance.now() - begun > STEADY;
        fail(new Refusal(
            `The graphics device was lost (${message.split("\n")[0].slice(0, 120) || "no reason given"}): load the page again.`));
        if (again) reopen(state); // phones take it from pages that are out of sight
    });
    gpu.device.addEventListener("uncapturederror", ({ error }) => fail(error), { signal });

    async function tick(now) {
        if (signal.aborted) return;
        const seconds = Math.min(Math.max(now - last, 0) / 1000, LONGEST_STEP); // the first frame may have begun earlier
        last = now;
        try {
            if (clock.playing) {
                clock.advance(seconds);
                wake();
            }
            resize();
            if (!await viewport.draw(now)) return;
        } catch (error) {
            return fail(error);
        }
        find("poster").hidden = true;
        const { width, height } = viewport.frame.camera;
        find("overlay").textContent = `${(1 / viewport.seconds).toFixed(1)} frames a second\n${Math.round(1000 * viewport.seconds)} ms `
            + `a frame\n${scene.count} Gaussians\n${width}x${height}\n${gpu.name}`;
        api.onframe?.(viewport.time);
    }
    (function loop(now) {
        if (signal.aborted) return;
        tick(now);
        requestAnimationFrame(loop);
    })(last);
    return { api, stop };
}

const after = (choices, present) => choices[(choices.findIndex(each => String(each) === String(present)) + 1) % choices.length];

const data = JSON.parse(find("player").textContent);
const source = new URLSearchParams(location.search).get("src");
addEventListener("dragover", event => event.preventDefault());
addEventListener("drop", event => {
    event.preventDefault();
    const [file] = event.dataTransfer.files;
    if (file) open(progress => streamed(file.stream(), file.size, progress), data);
});
open(source ? progress => fetched(source, progress) : embedded, data);
