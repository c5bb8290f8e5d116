// Puts a drawn picture on a window or a texture: its colors, or one of its values by a scale of colors; enlarged
// where it was drawn smaller; and beside it, or split with it, the ground truth of the same view.
struct Present {
    heat0: vec4<f32>, heat1: vec4<f32>, heat2: vec4<f32>, heat3: vec4<f32>, heat4: vec4<f32>, heat5: vec4<f32>,
    background: vec4<f32>,
    origin: vec2<f32>,       // of the picture on the target, and its size there; pixels
    size: vec2<f32>,
    picture: vec2<u32>,      // size of the picture as drawn, and of the ground truth
    truth: vec2<u32>,
    value: u32,              // what is shown: 0 color, 1 alpha, 2 depth, 3 the color's first channel as a value
    low: f32,                // the values at the two ends of the scale
    high: f32,
    truth_until: f32,        // left of this part of the width stands the ground truth
    error_gain: f32,         // above 0: the absolute difference from the ground truth, times this
}

@group(0) @binding(0) var<uniform> present: Present;
@group(0) @binding(1) var<storage, read> image: array<f32>;          // the planes that rasterize writes
@group(0) @binding(2) var<storage, read> ground_truth: array<u32>;   // 8 bits a channel, red lowest

@vertex
fn vertex(@builtin(vertex_index) i: u32) -> @builtin(position) vec4<f32> {
    return vec4(f32(i & 1u) * 4.0 - 1.0, f32(i >> 1u) * 4.0 - 1.0, 0.0, 1.0);   // a triangle that covers the viewport
}

fn heat(share: f32) -> vec3<f32> {
    let x = clamp(share, 0.0, 1.0) * 5.0;
    var color = mix(present.heat0, present.heat1, clamp(x, 0.0, 1.0));
    color = mix(color, present.heat2, clamp(x - 1.0, 0.0, 1.0));
    color = mix(color, present.heat3, clamp(x - 2.0, 0.0, 1.0));
    color = mix(color, present.heat4, clamp(x - 3.0, 0.0, 1.0));
    return mix(color, present.heat5, clamp(x - 4.0, 0.0, 1.0)).rgb;
}

fn drawn(p: vec2<i32>) -> vec3<f32> {
    let size = vec2<i32>(present.picture);
    let at = clamp(p, vec2(0), size - 1);
    let pixels = present.picture.x * present.picture.y;
    let i = u32(at.y) * present.picture.x + u32(at.x);
    if (present.value == 0u) {
        return vec3(image[i], image[pixels + i], image[2u * pixels + i]);
    }
    let alpha = 1.0 - image[3u * pixels + i];
    if (present.value == 1u) {
        return vec3(alpha);
    }
    var total = image[i];
    if (present.value == 2u) {
        total = image[4u * pixels + i];
    }
    let share = (total / max(alpha, 1e-6) - present.low) / max(present.high - present.low, 1e-12);
    return mix(present.background.rgb, heat(share), alpha);
}

fn true_color(p: vec2<i32>) -> vec3<f32> {
    let at = clamp(p, vec2(0), vec2<i32>(present.truth) - 1);
    return unpack4x8unorm(ground_truth[u32(at.y) * present.truth.x + u32(at.x)]).rgb;
}

@fragment
fn fragment(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let share = (position.xy - present.origin) / present.size;
    let compared = present.truth.x > 0u;
    var color = vec3(0.0);
    var reference = vec3(0.0);
    if (!compared || share.x >= present.truth_until || present.error_gain > 0.0) {
        if (all(present.size == vec2<f32>(present.picture)) || all(present.truth == present.picture)) {
            color = drawn(vec2<i32>(share * vec2<f32>(present.picture)));
        } else {
            let p = share * vec2<f32>(present.picture) - 0.5;
            let low = vec2<i32>(floor(p));
            let f = fract(p);
            color = mix(
                mix(drawn(low), drawn(low + vec2(1, 0)), f.x),
                mix(drawn(low + vec2(0, 1)), drawn(low + vec2(1, 1)), f.x),
                f.y,
            );
        }
    }
    if (compared) {
        reference = true_color(vec2<i32>(share * vec2<f32>(present.truth)));
        if (present.error_gain > 0.0) {
            color = present.error_gain * abs(clamp(color, vec3(0.0), vec3(1.0)) - reference);
        } else if (share.x < present.truth_until) {
            color = reference;
        }
    }
    return vec4(clamp(color, vec3(0.0), vec3(1.0)), 1.0);
}
