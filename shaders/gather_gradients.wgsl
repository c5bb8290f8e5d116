// Sums each Gaussian's records in the order of its slots, which lie side by side, and turns the moments into gradients of the splat.
#import common/count
#import common/index
#import common/splat

@group(0) @binding(0) var<uniform> visible: Count;
#table 1 ids: u32
#table 2 tile_counts: u32
#table 3 offsets: u32
#table 4 splats: vec4<f32>
#table 5 records: vec4<f32>
// place of each slot's record, from 1; blue of each record (, then depth)
#table 6 record_tails: u32
struct Tails { capacity: u32 }
@group(0) @binding(8) var<uniform> tails: Tails;
@group(0) @binding(7) var<storage, read_write> d_splats: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let rank = workgroup_number(group, groups) * 64u + lane;
    if (rank >= visible.value) {
        return;
    }
    let id = ids_at(rank);
    let first = offsets_at(rank);
    // Past the end (the step is then done again with larger buffers) the hardware returns zeros or the last record.
    let last = first + tile_counts_at(id);
    var a = vec4(0.0);   // moments 1, x, y, x^2
    var b = vec4(0.0);   // moments x y, y^2; red, green
    var c = vec2(0.0);   // blue, depth
    for (var slot = first; slot < last; slot++) {
        let place = record_tails_at(slot);
        if (place != 0u) {   // the tile was not full before it
            a += records_at(2u * place - 2u);
            b += records_at(2u * place - 1u);
            c.x += bitcast<f32>(record_tails_at(tails.capacity + place - 1u));
#ifdef DEPTH
            c.y += bitcast<f32>(record_tails_at(2u * tails.capacity + place - 1u));
#endif
        }
    }
    let s0 = splats_at(id * SPLAT_STRIDE);
    let s1 = splats_at(id * SPLAT_STRIDE + 1u);
    let d_mean = vec2(s0.z * a.y + s0.w * a.z, s0.w * a.y + s1.x * a.z);
    // Added, since an image may be drawn in several bands.
    d_splats[id * SPLAT_STRIDE] += vec4(d_mean, -0.5 * a.w, -b.x);
    d_splats[id * SPLAT_STRIDE + 1u] += vec4(-0.5 * b.y, a.x, b.zw);
    let tail = d_splats[id * SPLAT_STRIDE + 2u];
    d_splats[id * SPLAT_STRIDE + 2u] = vec4(tail.xy + c, 1.0, 0.0);
}
