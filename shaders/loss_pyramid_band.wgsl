// A band-pass level: what the coarser level, enlarged, leaves of the finer one. Sums up its absolute values and keeps its
// signs. A lane takes a run of a column of the coarse level, and the four fine pixels of each of its pixels.
// RESIDUAL: the coarse level is the last, and is summed up, too.
#import common/picture
#import common/pyramid

@group(0) @binding(0) var<uniform> level: Level;
#ifdef FINEST
#table 1 fine: vec4<u32>
#else
#table 1 fine: vec4<f32>
#endif
#table 2 coarse: vec4<f32>
@group(0) @binding(3) var<storage, read_write> signs: array<u32>;
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= level.coarse.x) {
        return;
    }
    let size = vec2<i32>(level.fine);
    let last = vec2<i32>(level.coarse) - 1;
    let x = i32(id.x);
    // Weights of the three coarse columns in the two fine ones.
    var across: array<vec2<f32>, 3>;
#unroll k 3
    across[$k] = vec2(enlarge_weight(x + $k - 1, 2 * x, size.x), enlarge_weight(x + $k - 1, 2 * x + 1, size.x));
#end
    var band = 0.0;
    var residual = 0.0;
    let end = i32(min((id.y + 1u) * level.run, level.coarse.y));
    for (var y = i32(id.y * level.run); y < end; y++) {
        var enlarged = array<vec3<f32>, 4>();
#unroll j 3
        {
            let row = clamp(y + $j - 1, 0, last.y) * (last.x + 1);
            let down = vec2(enlarge_weight(y + $j - 1, 2 * y, size.y), enlarge_weight(y + $j - 1, 2 * y + 1, size.y));
            var left = vec3(0.0);
            var right = vec3(0.0);
#unroll i 3
            {
                let texel = coarse_at(u32(row + clamp(x + $i - 1, 0, last.x))).xyz;
                left = fma(vec3(across[$i].x), texel, left);
                right = fma(vec3(across[$i].y), texel, right);
            }
#end
            enlarged[0] = fma(vec3(down.x), left, enlarged[0]);
            enlarged[1] = fma(vec3(down.x), right, enlarged[1]);
            enlarged[2] = fma(vec3(down.y), left, enlarged[2]);
            enlarged[3] = fma(vec3(down.y), right, enlarged[3]);
        }
#end
#ifdef RESIDUAL
        residual += dot(abs(coarse_at(u32(y * (last.x + 1) + x)).xyz), vec3(1.0));
#endif
#unroll q 4
        {
            let at = vec2(2 * x + $q % 2, 2 * y + $q / 2);
            if (all(at < size)) {
                let texel = fine_at(fine_place(u32(at.x), u32(at.y), level));
#ifdef FINEST
                let left = seen(texel) - truth(texel) - enlarged[$q];
#else
                let left = texel.xyz - enlarged[$q];
#endif
                band += dot(abs(left), vec3(1.0));
                signs[u32(at.y * size.x + at.x)] = pack_signs(left);
            }
        }
#end
    }
    sums[level.first + id.y * level.coarse.x + id.x] = level.value * band + level.coarse_value * residual;
}
