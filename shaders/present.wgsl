// Puts a drawn image on a window or a texture: its colors, or one of its values by a scale of colors; enlarged where it
// was drawn smaller.
struct Present {
    heat0: vec4<f32>, heat1: vec4<f32>, heat2: vec4<f32>, heat3: vec4<f32>, heat4: vec4<f32>, heat5: vec4<f32>,
    background: vec4<f32>,
    size: vec2<f32>,         // of the target, pixels
    picture: vec2<u32>,      // size of the image as drawn
    value: u32,              // what is shown: 0 color, 1 alpha, 2 depth, 3 the color's first channel as a value
    low: f32,                // the values at the two ends of the scale
    high: f32,
}

@group(0) @binding(0) var<uniform> present: Present;
@group(0) @binding(1) var<storage, read> image: array<f32>;   // the planes that rasterize writes

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

@fragment
fn fragment(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let place = position.xy / present.size * vec2<f32>(present.picture);
    var color: vec3<f32>;
    if (all(present.size == vec2<f32>(present.picture))) {
        color = drawn(vec2<i32>(place));
    } else {
        let low = vec2<i32>(floor(place - 0.5));
        let f = fract(place - 0.5);
        color = mix(
            mix(drawn(low), drawn(low + vec2(1, 0)), f.x),
            mix(drawn(low + vec2(0, 1)), drawn(low + vec2(1, 1)), f.x),
            f.y,
        );
    }
    return vec4(clamp(color, vec3(0.0), vec3(1.0)), 1.0);
}
