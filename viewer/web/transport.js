// The bar below the picture: play, time slider, speed, loop; and the help. All text is set as text.
export class Transport {
    constructor(root, state, { actions, keys, mouse, wake, signal }) {
        Object.assign(this, { root, state });
        const { clock } = state;
        const find = name => root.querySelector(`#${name}`);
        [this.bar, this.button, this.slider, this.label] = ["bar", "play", "time", "label"].map(find);
        [this.speed, this.loop, this.helpBox] = ["speed", "loop", "help"].map(find);
        fill(this.speed, clock.speeds.map(speed => `${speed}x`));
        fill(this.loop, clock.loops);
        const change = (element, event, handler) => element.addEventListener(event, () => {
            handler();
            wake();
        }, { signal });
        change(this.button, "click", actions.toggle_playing);
        change(this.slider, "input", () => {
            clock.playing = false;
            clock.seek(Number(this.slider.value));
        });
        change(this.speed, "change", () => (clock.speed = clock.speeds[this.speed.selectedIndex]));
        change(this.loop, "change", () => (clock.loop = clock.loops[this.loop.selectedIndex]));
        const rows = [...keys.map(({ shown, help }) => [shown, help]), ...mouse, ["two fingers", "move sideways, nearer or farther"]];
        this.helpBox.replaceChildren(...rows.flatMap(([shown, help]) => [element("dt", shown), element("dd", help)]));
    }

    // Show the state of the clock.
    update() {
        const { clock } = this.state;
        this.button.textContent = clock.playing ? "Pause" : "Play";
        this.slider.value = clock.time;
        this.label.textContent = `${clock.time.toFixed(3)}  frame ${clock.frame} of ${clock.frames - 1}`;
        this.speed.selectedIndex = clock.speeds.indexOf(clock.speed);
        this.loop.selectedIndex = clock.loops.indexOf(clock.loop);
    }

    toggle() {
        this.bar.hidden = !this.bar.hidden;
    }

    toggleHelp() {
        this.helpBox.hidden = !this.helpBox.hidden;
    }
}

function element(tag, text) {
    const made = document.createElement(tag);
    made.textContent = text;
    return made;
}

function fill(select, texts) {
    select.replaceChildren(...texts.map(text => element("option", text)));
}
