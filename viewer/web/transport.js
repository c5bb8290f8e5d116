// The bar below the picture: play, time slider, speed, loop. Its lists and the help stand in the page already.
export class Transport {
    constructor(root, state, { actions, wake, signal }) {
        this.state = state;
        const { clock } = state;
        const names = ["bar", "play", "time", "label", "speed", "loop", "more"];
        [this.bar, this.button, this.slider, this.label, this.speed, this.loop, this.more] = names.map(name => root.getElementById(name));
        const change = (element, event, handler) => element.addEventListener(event, () => {
            handler();
            wake();
        }, { signal });
        change(this.button, "click", actions.toggle_playing);
        change(this.more, "click", actions.show_help);
        change(root.getElementById("home"), "click", actions.reset_camera);
        change(this.slider, "input", () => {
            clock.playing = false;
            clock.seek(Number(this.slider.value));
        });
        change(this.speed, "change", () => (clock.speed = clock.speeds[this.speed.selectedIndex]));
        change(this.loop, "change", () => (clock.loop = clock.loops[this.loop.selectedIndex]));
    }

    // Show the state of the clock.
    update() {
        const { clock } = this.state;
        this.button.textContent = clock.playing ? "Pause" : "Play";
        this.slider.value = clock.time;
        this.label.textContent = `${clock.time.toFixed(3)}  frame ${clock.frame} of ${clock.frames - 1}`;
        if (!clock.speeds.includes(clock.speed)) { // by the page's address
            clock.speeds = [...clock.speeds, clock.speed].sort((a, b) => a - b);
            this.speed.add(new Option(`${clock.speed}x`), clock.speeds.indexOf(clock.speed));
        }
        this.speed.selectedIndex = clock.speeds.indexOf(clock.speed);
        this.loop.selectedIndex = clock.loops.indexOf(clock.loop);
    }
}
