// The gradient by the difference itself, the finest level: of its band's absolute values, plus what reaches it through
// the coarser level. A lane takes a pixel of the coarser level, and the four below it.
#import common/picture
#import common/pyramid

@group(0) @binding(0) var<uniform> level: Level;
#table 1 signs: u32
#table 2 d_coarse: vec4<f32>
@group(0) @binding(3) var<storage, read_write> d_difference: array<vec4<f32>>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= level.coarse.x) {
        return;
    }
    let size = vec2<i32>(level.fine);
    let last = vec2<i32>(level.coarse) - 1;
    let x = i32(id.x);
    let y = i32(id.y);
    var through = array<vec3<f32>, 4>();
#unroll j 3
    {
        let row = clamp(y + $j - 1, 0, last.y) * (last.x + 1);
        let down = vec2(reduce_weight(2 * y, y + $j - 1, size.y), reduce_weight(2 * y + 1, y + $j - 1, size.y));
#unroll i 3
        {
            let column = x + $i - 1;
            let across = vec2(reduce_weight(2 * x, column, size.x), reduce_weight(2 * x + 1, column, size.x));
            let texel = d_coarse_at(u32(row + clamp(column, 0, last.x))).xyz;
            through[0] = fma(vec3(down.x * across.x), texel, through[0]);
            through[1] = fma(vec3(down.x * across.y), texel, through[1]);
            through[2] = fma(vec3(down.y * across.x), texel, through[2]);
            through[3] = fma(vec3(down.y * across.y), texel, through[3]);
        }
#end
    }
#end
#unroll q 4
    {
        let at = vec2(2 * x + $q % 2, 2 * y + $q / 2);
        if (all(at < size)) {
            let own = level.slope * unpack_signs(signs_at(u32(at.y * size.x + at.x)));
            d_difference[fine_place(u32(at.x), u32(at.y), level)] = vec4(own + through[$q], 0.0);
        }
    }
#end
}
