// A rendered image with the colors that the camera of a picture would have given it. A workgroup takes a row.
#import common/exposure

@group(0) @binding(0) var<uniform> exposure: Exposure;
#table 1 image: f32
@group(0) @binding(2) var<storage, read> corrections: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> exposed: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let count = exposure.size.x * exposure.size.y;
    let red = corrections[exposure.first];
    let green = corrections[exposure.first + 1u];
    let blue = corrections[exposure.first + 2u];
    for (var column = lane; column < exposure.size.x; column += u32($LANES)) {
        let i = group.y * exposure.size.x + column;
        let color = vec4(image_at(i), image_at(count + i), image_at(2u * count + i), 1.0);
        exposed[i] = dot(red, color);
        exposed[count + i] = dot(green, color);
        exposed[2u * count + i] = dot(blue, color);
    }
}
