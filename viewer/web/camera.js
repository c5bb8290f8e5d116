// The camera that turns about a focus, as viewer/camera.py; matrices are rows of world-to-camera axes (OpenCV's).
const STEEPEST = 89 * Math.PI / 180; // of the line of sight, up or down

export const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => a.map(x => x / Math.hypot(...a));
const turned = (v, axis, angle) => { // a row times the rotation about a unit axis (Rodrigues)
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return add(add(v.map(x => c * x), cross(v, axis), s), axis, (1 - c) * dot(axis, v));
};

export class ViewCamera {
    // Where the scene begins. narrowest: width by height of a picture; in a narrower one fovY grows, so that no side is cut.
    // near: depth up to which nothing is drawn.
    constructor({ rotation, position, fovY, focus, up, narrowest, near = 0 }) {
        Object.assign(this, { up: unit(up), narrowest, near });
        this.reset = () => {
            const far = Math.hypot(...add(focus, position, -1));
            const ahead = Math.max(dot(add(focus, position, -1), rotation[2]), 1e-3 * far, 1e-6);
            Object.assign(this, { rotation, position, fovY, focus: add(position, rotation[2], ahead) });
        };
        this.reset();
    }

    get distance() { return Math.hypot(...add(this.focus, this.position, -1)); }

    // Stand at a position and look at a focus; fovY in radians.
    place({ position = this.position, focus = this.focus, fovY = this.fovY }) {
        Object.assign(this, { position, focus, fovY });
        this.rotation = this.level(add(focus, position, -1));
    }

    orbit(right, down) {
        const { distance } = this;
        this.turn(right, down);
        this.position = add(this.focus, this.rotation[2], -distance);
    }

    // By these parts of the picture's height at the focus.
    pan(right, down) {
        const reach = -2 * this.distance * Math.tan(0.5 * this.fovY);
        const by = add(this.rotation[0].map(x => reach * right * x), this.rotation[1], reach * down);
        this.position = add(this.position, by);
        this.focus = add(this.focus, by);
    }

    zoom(factor) { this.position = add(this.focus, add(this.position, this.focus, -1), factor); }

    turn(right, down) {
        const rotation = this.rotation.map(row => turned(row, this.up, right));
        let across = cross(rotation[2], this.up);
        across = Math.hypot(...across) > 1e-6 ? unit(across) : rotation[0];
        const pitch = Math.asin(Math.min(1, Math.max(-1, dot(rotation[2], this.up))));
        const wanted = Math.min(STEEPEST, Math.max(-STEEPEST, pitch - down));
        this.rotation = rotation.map(row => turned(row, across, pitch - wanted));
    }

    level(forward) {
        forward = Math.hypot(...forward) > 0 ? unit(forward) : [0, 0, 1];
        let right = cross(forward, this.up);
        if (Math.hypot(...right) < 1e-6) right = cross(forward, [this.up[2], this.up[0], this.up[1]]);
        right = unit(right);
        return [right, cross(forward, right), forward];
    }

    // What fovY spans on a canvas of this size.
    pictureHeight(width, height) { return Math.min(height, width / this.narrowest); }

    // What the rasterizer takes for a picture of this size; view is column by column.
    camera(width, height) {
        const [x, y, z] = this.rotation;
        const f = 0.5 * this.pictureHeight(width, height) / Math.tan(0.5 * this.fovY);
        const shift = [x, y, z].map(row => -dot(row, this.position));
        const view = [0, 1, 2].flatMap(i => [x[i], y[i], z[i], 0]).concat(shift, 1);
        const { position, near } = this;
        return { view, focal: [f, f], center: [width / 2, height / 2], position, width, height, near };
    }
}

// Where a scene begins, of its metadata; without such a view, the middle of its means from a distance.
export function firstView(text, means) {
    try {
        const { K, T_cam_world: T, size, focus, up, frames, near = 0 } = JSON.parse(text);
        const rotation = [0, 1, 2].map(i => T[i].slice(0, 3));
        const position = [0, 1, 2].map(i => -(T[0][i] * T[0][3] + T[1][i] * T[1][3] + T[2][i] * T[2][3]));
        const fovY = 2 * Math.atan(0.5 * size[1] / K[1][1]);
        const values = [...rotation.flat(), ...position, fovY, ...focus, ...up, near];
        const square = [0, 1, 2].every(i => Math.abs(dot(rotation[i], rotation[i]) - 1) < 1e-3);
        if (values.length === 20 && values.every(Number.isFinite) && square && fovY > 0 && Math.hypot(...up) > 1e-3) {
            const narrowest = Math.min(Math.max(size[0] / size[1], 0.1), 1);
            const count = Math.min(Math.max(Math.round(frames) || 1, 1), 1e6);
            return { rotation, position, fovY, focus, up, narrowest, near, frames: count };
        }
    } catch {
        // as without one
    }
    const axes = [0, 1, 2].map(axis => means.filter((_, i) => i % 3 === axis).sort());
    const focus = axes.map(values => values[values.length >> 1]);
    const radius = Math.max(1e-3, ...axes.map(values => 0.5 * (values.at(-1) - values[0])));
    const rotation = [[1, 0, 0], [0, 0, -1], [0, 1, 0]];
    return { rotation, position: add(focus, rotation[2], -3.6 * radius), fovY: 0.7, focus, up: [0, 0, 1], narrowest: 1, frames: 150 };
}
