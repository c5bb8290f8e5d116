// Mouse, touch and keyboard on the canvas (viewer/controls.py); numbers and the table of keys travel as data.
export class Controls {
    // actions: name -> function. wake: something may have changed. signal: ends it.
    constructor(canvas, state, { keys, fly, orbit, look, zoom, reach }, actions, wake, signal) {
        Object.assign(this, { canvas, state, fly, orbit, look, zoom, reach, actions, wake });
        this.keys = new Map(Object.entries(keys)).set("/", "show_help");
        this.pointer = [0, 0]; // where it was last
        this.pointers = new Map(); // that are down, by number: where each is
        this.held = new Map(); // keys that fly, and those that say how fast: where each is on the keyboard -> its name
        this.flying = false;
        this.dragging = null;
        const listen = (name, handler, options) => canvas.addEventListener(name, event => {
            handler.call(this, event);
            wake();
        }, { ...options, signal });
        listen("pointerdown", this.pointerDown);
        listen("pointermove", this.pointerMove);
        for (const name of ["pointerup", "pointercancel"]) listen(name, event => this.pointers.delete(event.pointerId));
        listen("wheel", this.wheel, { passive: false });
        listen("dblclick", event => this.actions.focus(event.clientX, event.clientY));
        listen("contextmenu", event => event.preventDefault());
        addEventListener("keydown", event => this.keyDown(event), { signal });
        // macOS tells of no key that is let go while Command is down.
        addEventListener("keyup", event => event.key === "Meta" ? this.held.clear() : this.held.delete(event.code), { signal });
        addEventListener("blur", () => this.held.clear(), { signal });
    }

    pointerDown(event) {
        this.canvas.setPointerCapture(event.pointerId);
        this.canvas.focus();
        this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
        const pan = event.button !== 0 || event.shiftKey;
        this.dragging = pan ? "pan" : this.flying ? "look" : "orbit";
    }

    pointerMove(event) {
        this.pointer = [event.clientX, event.clientY];
        const last = this.pointers.get(event.pointerId);
        if (!last) return;
        const { camera } = this.state;
        const [right, down] = [event.clientX - last[0], event.clientY - last[1]];
        const height = camera.pictureHeight(this.canvas.clientWidth, this.canvas.clientHeight);
        const before = this.pointers.size === 2 && this.spread();
        this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
        if (before) { // two fingers: pan by their middle, zoom by their distance
            camera.pan(0.5 * right / height, 0.5 * down / height);
            camera.zoom(before / this.spread());
        } else if (this.dragging === "orbit") camera.orbit(this.orbit * right, this.orbit * down);
        else if (this.dragging === "look") camera.look(this.look * right, this.look * down);
        else camera.pan(right / height, down / height);
    }

    spread() {
        const [a, b] = [...this.pointers.values()];
        return Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1);
    }

    wheel(event) {
        event.preventDefault();
        const pixels = event.deltaY * (event.deltaMode === 0 ? 1 : event.deltaMode === 1 ? 16 : this.canvas.clientHeight);
        this.state.camera.zoom(Math.exp(this.zoom * pixels));
    }

    keyDown(event) {
        if (event.ctrlKey || event.metaKey || event.target.closest?.(event.key === " " ? "select, button" : "select")) return;
        const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
        if (this.flying && (key in this.fly || key === "Shift" || key === "Alt")) {
            this.held.set(event.code, key);
        } else {
            const action = this.actions[this.keys.get(event.key) ?? this.keys.get(key)];
            if (!action) return;
            if (!event.repeat || key === "," || key === ".") action(...this.pointer);
        }
        event.preventDefault();
        this.wake();
    }

    // Move the camera by what the held keys say.
    advance(seconds) {
        const held = new Set(this.held.values());
        const moves = [...held].map(key => this.fly[key]).filter(Boolean);
        if (!this.flying || !moves.length) return;
        const far = seconds * this.reach * (held.has("Shift") ? 4 : held.has("Alt") ? 0.25 : 1) * this.state.camera.distance;
        this.state.camera.fly(...[0, 1, 2].map(axis => far * moves.reduce((sum, move) => sum + move[axis], 0)));
    }
}
