// Mouse, touch and keyboard on the canvas (viewer/controls.py); numbers and the table of keys travel as data.
export class Controls {
    // actions: name -> function. wake: something may have changed. signal: ends it.
    constructor(canvas, state, { keys, orbit, zoom }, actions, wake, signal) {
        Object.assign(this, { canvas, state, orbit, zoom, actions, wake });
        this.keys = new Map(Object.entries(keys)).set("/", "show_help");
        this.pointer = [0, 0]; // where it was last
        this.pointers = new Map(); // that are down, by number: where each is
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
    }

    pointerDown(event) {
        this.canvas.setPointerCapture(event.pointerId);
        this.canvas.focus();
        this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
        this.dragging = event.button !== 0 || event.shiftKey ? "pan" : "orbit";
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
        const action = this.actions[this.keys.get(event.key) ?? this.keys.get(key)];
        if (!action) return;
        if (!event.repeat || key === "," || key === ".") action(...this.pointer);
        event.preventDefault();
        this.wake();
    }
}
