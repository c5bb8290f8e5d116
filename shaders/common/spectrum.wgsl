// The motion spectrum at a time, L(t), and the places of its parameters among a field's weights.

struct Spectrum {
    width: u32,          // channels
    components: u32,
    alpha: u32,          // (components, width)
    beta: u32,
    frequencies: u32,    // (components,), cycles over the clip
    second: u32,         // (width, width)
    second_bias: u32,    // (width,)
    heads: u32,          // (outputs, width), of which the motion reaches the first MOVED
    head_biases: u32,    // (outputs,)
    outputs: u32,
    columns: u32,        // of the folded heads: width, with motion 2 x width
    time: f32,
    unit: f32,           // of lengths: the factor of shifts and of changes of scale
    appearance: f32,     // the factor of what changes the look
}

const MOVED = 14u;
const TURN = 6.283185307179586;

// Cosine and sine of a component's phase. The whole turns are taken off first: drivers' own sines lose digits far from zero.
fn phase(frequency: f32, time: f32) -> vec2<f32> {
    let turns = frequency * time;
    let angle = TURN * (turns - round(turns));
    return vec2(cos(angle), sin(angle));
}

fn head_factor(s: Spectrum, head: u32) -> f32 {
    let length = (head >= 4u && head < 7u) || head >= 11u;
    return select(select(1.0, s.unit, length), s.appearance, head >= MOVED);
}
