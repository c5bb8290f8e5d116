// Time in the clip while it plays (viewer/clock.py).
export class Clock {
    constructor(frames, loops, speeds) {
        Object.assign(this, { frames, loops, speeds, time: 0, playing: false, fps: 30, speed: 1, loop: loops[0], forward: true });
    }

    get frame() { return Math.round(this.time * (this.frames - 1)); }

    get seconds() { return Math.max(1, this.frames - 1) / this.fps; }

    seek(time) { this.time = Math.min(Math.max(time, 0), 1); }

    // Play, from the start where the clip has ended; what has one moment only does not play.
    play() {
        this.playing = this.frames > 1;
        if (this.playing && this.loop === "once" && this.time >= 1) this.time = 0;
    }

    toggle() { return this.playing ? (this.playing = false) : this.play(); }

    step(frames) {
        this.playing = false;
        this.seek((this.frame + frames) / Math.max(1, this.frames - 1));
    }

    slower() { this.speed = this.speeds.findLast(speed => speed < this.speed) ?? this.speeds[0]; }

    faster() { this.speed = this.speeds.find(speed => speed > this.speed) ?? this.speeds.at(-1); }

    nextLoop() { this.loop = this.loops[(this.loops.indexOf(this.loop) + 1) % this.loops.length]; }

    // Let that much of the visitor's time pass.
    advance(seconds) {
        if (!this.playing) return;
        const way = seconds * this.speed / this.seconds;
        if (this.loop === "loop") {
            this.time = (this.time + way) % 1;
        } else if (this.loop === "once") {
            this.time = Math.min(this.time + way, 1);
            this.playing = this.time < 1;
        } else { // folded back at both ends: a place on a circle of twice the clip's length
            const place = ((this.forward ? this.time : 2 - this.time) + way) % 2;
            this.forward = place < 1;
            this.time = this.forward ? place : 2 - place;
        }
    }
}
