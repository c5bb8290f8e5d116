// The gradient of a corrected image to the rendered one, and to the correction: a sum over each row of the image.
// A workgroup takes a row.
#import common/exposure

@group(0) @binding(0) var<uniform> exposure: Exposure;
#table 1 image: f32
#table 2 d_exposed: f32
@group(0) @binding(3) var<storage, read> corrections: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> d_image: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_rows: array<vec4<f32>>;   // three a row of the image

var<workgroup> of_lanes: array<array<vec4<f32>, 3>, $LANES>;

@compute @workgroup_size($LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let count = exposure.size.x * exposure.size.y;
    let red = corrections[exposure.first];
    let green = corrections[exposure.first + 1u];
    let blue = corrections[exposure.first + 2u];
    var sums = array<vec4<f32>, 3>();
    for (var column = lane; column < exposure.size.x; column += u32($LANES)) {
        let i = group.y * exposure.size.x + column;
        let color = vec4(image_at(i), image_at(count + i), image_at(2u * count + i), 1.0);
        let d = vec3(d_exposed_at(i), d_exposed_at(count + i), d_exposed_at(2u * count + i));
        sums[0] += d.x * color;
        sums[1] += d.y * color;
        sums[2] += d.z * color;
        let back = d.x * red + d.y * green + d.z * blue;
        d_image[i] = back.x;
        d_image[count + i] = back.y;
        d_image[2u * count + i] = back.z;
        d_image[3u * count + i] = 0.0;   // by alpha
    }
    of_lanes[lane] = sums;
    workgroupBarrier();
    if (lane < 3u) {
        var sum = vec4(0.0);
        for (var k = 0u; k < u32($LANES); k++) {
            sum += of_lanes[k][lane];
        }
        d_rows[3u * group.y + lane] = sum;
    }
}
