// The gradient by a level of the difference's pyramid, but the finest: of its own absolute values, less what the finer
// band took from it, plus what reaches it through the coarser level (unless RESIDUAL).
#import common/pyramid

@group(0) @binding(0) var<uniform> above: Level;    // this level as the coarse one of two
#table 1 fine_signs: u32
#ifdef RESIDUAL
#table 2 difference: vec4<f32>
#else
@group(0) @binding(3) var<uniform> below: Level;    // this level as the fine one of two
#table 4 signs: u32
#table 5 d_coarse: vec4<f32>
#endif
@group(0) @binding(6) var<storage, read_write> d_level: array<vec4<f32>>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = vec2<i32>(above.coarse);
    if (id.x >= u32(size.x)) {
        return;
    }
    let x = i32(id.x);
    let y = i32(id.y);
    let i = u32(y * size.x + x);
#ifdef RESIDUAL
    var d = above.coarse_slope * sign(difference_at(i).xyz);
#else
    var d = below.slope * unpack_signs(signs_at(i));
    let coarse = vec2<i32>(below.coarse);
    for (var row = y / 2 - 1; row <= y / 2 + 1; row++) {
        let down = reduce_weight(y, row, size.y);
        let start = clamp(row, 0, coarse.y - 1) * coarse.x;
#unroll k 3
        {
            let column = x / 2 + $k - 1;
            let weight = down * reduce_weight(x, column, size.x);
            d = fma(vec3(weight), d_coarse_at(u32(start + clamp(column, 0, coarse.x - 1))).xyz, d);
        }
#end
    }
#endif
    let fine = vec2<i32>(above.fine);
    for (var row = 2 * y - 2; row <= 2 * y + 2; row++) {
        let down = -above.slope * enlarge_weight(y, row, fine.y);
        let start = clamp(row, 0, fine.y - 1) * fine.x;
#unroll k 5
        {
            let column = 2 * x + $k - 2;
            let weight = down * enlarge_weight(x, column, fine.x);
            d = fma(vec3(weight), unpack_signs(fine_signs_at(u32(start + clamp(column, 0, fine.x - 1)))), d);
        }
#end
    }
    d_level[i] = vec4(d, 0.0);
}
