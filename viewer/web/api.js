// How other pages drive this one: the address's part behind # (#t=0.3&play), and window.lapgs for scripts.
export function applyAddress(hash, { clock, backgrounds, setBackground }) {
    const given = new URLSearchParams(hash.replace(/^#/, ""));
    const number = (name, low, high) => {
        const value = given.get(name) ? Number(given.get(name)) : NaN;
        return value >= low && value <= high ? value : null;
    };
    clock.seek(number("t", 0, 1) ?? clock.time);
    clock.speed = number("speed", 0.01, 100) ?? clock.speed;
    clock.fps = number("fps", 0.1, 1000) ?? clock.fps;
    if (clock.loops.includes(given.get("loop"))) clock.loop = given.get("loop");
    if (Object.hasOwn(backgrounds, given.get("background"))) setBackground(backgrounds[given.get("background")]);
    given.has("play") ? clock.play() : (clock.playing = false);
}

// What window.lapgs becomes once the scene is shown.
export function makeApi(state, viewport, wake) {
    const finite = (values, count) => {
        if (!Array.isArray(values) || values.length !== count || !values.every(Number.isFinite)) {
            throw new TypeError(`expected ${count} finite numbers, got ${JSON.stringify(values)}`);
        }
        return values;
    };
    return {
        get time() { return state.clock.time; },
        get playing() { return state.clock.playing; },
        get seconds() { return viewport.seconds; }, // that the last frame took
        onframe: null, // called with the time after each frame
        setTime(t) { // in [0, 1]; pauses
            state.clock.playing = false;
            state.clock.seek(finite([t], 1)[0]);
            wake();
        },
        // World units, and the vertical field of view in radians; what is left out stays.
        setCamera({ position = state.camera.position, focus = state.camera.focus, fovY = state.camera.fovY }) {
            if (!(fovY > 0 && fovY < Math.PI)) throw new TypeError(`expected fovY between 0 and pi, got ${JSON.stringify(fovY)}`);
            state.camera.place({ position: finite(position, 3), focus: finite(focus, 3), fovY });
            wake();
        },
        play() { state.clock.play(); wake(); },
        pause() { state.clock.playing = false; wake(); },
        // {width, height, time, values}: of the frame on show while the clip plays, else of the final one.
        picture: () => viewport.planes(),
    };
}
