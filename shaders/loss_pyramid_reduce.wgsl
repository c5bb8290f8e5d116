// The next coarser level of the difference's pyramid; of a difference alone, since pyramids are linear.
#import common/picture
#import common/pyramid

@group(0) @binding(0) var<uniform> level: Level;
#ifdef FINEST
#table 1 fine: vec4<u32>
#else
#table 1 fine: vec4<f32>
#endif
@group(0) @binding(2) var<storage, read_write> coarse: array<vec4<f32>>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= level.coarse.x) {
        return;
    }
    let size = vec2<i32>(level.fine);
    let center = vec2<i32>(id.xy);
    let last = size - 1;
    var sum = vec3(0.0);
    var across: array<f32, 5>;
#unroll k 5
    across[$k] = reduce_weight(2 * center.x + $k - 2, center.x, size.x);
#end
    for (var dy = -2; dy <= 2; dy++) {
        let y = 2 * center.y + dy;
        let row = u32(clamp(y, 0, last.y));
        var along = vec3(0.0);
#unroll k 5
        {
            let texel = fine_at(fine_place(u32(clamp(2 * center.x + $k - 2, 0, last.x)), row, level));
#ifdef FINEST
            along = fma(vec3(across[$k]), seen(texel) - truth(texel), along);
#else
            along = fma(vec3(across[$k]), texel.xyz, along);
#endif
        }
#end
        sum = fma(vec3(reduce_weight(y, center.y, size.y)), along, sum);
    }
    coarse[id.y * level.coarse.x + id.x] = vec4(sum, 0.0);
}
