// Moves Gaussians to a time: the decoder of their features, its heads, and what these do to means, quaternions, scales,
// opacities and colors. A lane holds POINTS Gaussians and goes through the decoder's channels, QUADS quads of them a round,
// so that a weight that is read serves several Gaussians and a feature several channels.
// MOTION: with the Laplacian motion, whose second layer and spectrum are folded into the heads. COLOR: colors change, too.
#import common/constants
#import common/gate
#import common/index

struct Deform {
    gaussians: u32,
    rounds: u32,       // times 4 x QUADS channels: the decoder's width
    still_quads: u32,  // of features
    moving_quads: u32,
    stream: u32,       // where the decoder's weights begin
    sh_stored: u32,    // coefficients in `colors`
}

const POINTS: u32 = $POINTS;
const HEADS: u32 = $HEADS;   // quads of outputs: turn; quaternion; shift, opacity; scales; and with COLOR color
const CANONICAL = 4u;        // quads of a Gaussian before its still features
const LANES = 64u;

@group(0) @binding(0) var<uniform> deform: Deform;
// rows of: mean, opacity logit; quaternion; scales, 1 where negative ones count as their magnitude, else 0; color, -; then
// the features that do not depend on time
#table 1 still: vec4<f32>
// rows of the others
#table 2 moving: vec4<f32>
// heads' biases; heads, by channel; then for each round biases and columns of the layers, in the order in which they are used
#table 3 weights: vec4<f32>
@group(0) @binding(4) var<storage, read_write> means: array<f32>;
@group(0) @binding(5) var<storage, read_write> quats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> scales: array<f32>;
@group(0) @binding(7) var<storage, read_write> opacities: array<f32>;
#ifdef COLOR
@group(0) @binding(8) var<storage, read_write> colors: array<f32>;   // (N, sh_stored, 3), of which the first is written
#endif

fn unit(v: vec4<f32>) -> vec4<f32> {
    return v / max(length(v), 1e-12);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = workgroup_number(group, groups) * LANES * POINTS + lane;
    if (first >= deform.gaussians) {
        return;
    }
    let still_row = CANONICAL + deform.still_quads;
#unroll p $POINTS
    let i$p = min(first + $(p)u * LANES, deform.gaussians - 1u);
    let still$p = i$p * still_row;
    let moving$p = i$p * deform.moving_quads;
#end
    // Loops over channels and Gaussians shift what they need to a place with a constant index: unrolled, they would take
    // long to compile, and with a variable index the driver would keep the array in memory.
    var heads: array<vec4<f32>, POINTS * HEADS>;
#unroll h $HEADS
    {
        let bias = weights_at($(h)u);
#unroll p $POINTS
        heads[$p * $HEADS + $h] = bias;
#end
    }
#end
    var head = HEADS;
    var at = deform.stream;
    for (var round = 0u; round < deform.rounds; round++) {
        var gate: array<vec4<f32>, $POINTS * $QUADS>;
        var hidden: array<vec4<f32>, $POINTS * $QUADS>;
#ifdef MOTION
        var inner: array<vec4<f32>, $POINTS * $QUADS>;
#endif
#unroll c $QUADS
        {
            let gate_bias = weights_at(at);
            let hidden_bias = weights_at(at + 1u);
#ifdef MOTION
            let inner_bias = weights_at(at + 2u);
            at += 3u;
#else
            at += 2u;
#endif
#unroll p $POINTS
            gate[$p * $QUADS + $c] = gate_bias;
            hidden[$p * $QUADS + $c] = hidden_bias;
#ifdef MOTION
            inner[$p * $QUADS + $c] = inner_bias;
#endif
#end
        }
#end
        for (var k = 0u; k < deform.still_quads; k++) {
#unroll p $POINTS
            let x$p = still_at(still$p + CANONICAL + k);
#end
#unroll c $QUADS
#unroll j 4
            {
                let g = weights_at(at);
#ifdef MOTION
                let m = weights_at(at + 1u);
                at += 2u;
#else
                at += 1u;
#endif
#unroll p $POINTS
                gate[$p * $QUADS + $c] = fma(g, vec4(x$p[$j]), gate[$p * $QUADS + $c]);
#ifdef MOTION
                inner[$p * $QUADS + $c] = fma(m, vec4(x$p[$j]), inner[$p * $QUADS + $c]);
#endif
#end
            }
#end
#end
        }
        for (var k = 0u; k < deform.moving_quads; k++) {
#unroll p $POINTS
            let x$p = moving_at(moving$p + k);
#end
#unroll c $QUADS
#unroll j 4
            {
                let w = weights_at(at);
                at += 1u;
#unroll p $POINTS
                hidden[$p * $QUADS + $c] = fma(w, vec4(x$p[$j]), hidden[$p * $QUADS + $c]);
#end
            }
#end
#end
        }
#unroll c $QUADS
        {
#unroll p $POINTS
            var gated$p = gated(hidden[$p * $QUADS + $c], gate[$p * $QUADS + $c]);
#ifdef MOTION
            var motion$p = max(inner[$p * $QUADS + $c], vec4(0.0));
#endif
#end
            for (var j = 0u; j < 4u; j++) {
#unroll h $HEADS
                {
                    let w = weights_at(head + $(h)u);
#unroll p $POINTS
                    heads[$p * $HEADS + $h] = fma(w, gated$p.xxxx, heads[$p * $HEADS + $h]);
#end
                }
#end
                head += HEADS;
#ifdef MOTION
#unroll h 4
                {
                    let w = weights_at(head + $(h)u);
#unroll p $POINTS
                    heads[$p * $HEADS + $h] = fma(w, motion$p.xxxx, heads[$p * $HEADS + $h]);
#end
                }
#end
                head += 4u;
#endif
#unroll p $POINTS
                gated$p = gated$p.yzwx;
#ifdef MOTION
                motion$p = motion$p.yzwx;
#endif
#end
            }
        }
#end
    }
    for (var p = 0u; p < POINTS; p++) {
        let i = first + p * LANES;
        if (i < deform.gaussians) {
            let row = i * still_row;
            let mean = still_at(row);
            let q = unit(heads[0] + vec4(1.0, 0.0, 0.0, 0.0));
            let twice = 2.0 * cross(q.yzw, mean.xyz);
            let moved = mean.xyz + q.x * twice + cross(q.yzw, twice) + heads[2].xyz;
            let scale = still_at(row + 2u);
            let changed = scale.xyz + heads[3].xyz;
            let size = max(max(changed, -scale.w * changed), vec3(MIN_SCALE));
#unroll a 3
            means[3u * i + $(a)u] = moved[$a];
            scales[3u * i + $(a)u] = size[$a];
#end
            quats[i] = unit(still_at(row + 1u) + heads[1]);
            opacities[i] = 1.0 / (1.0 + exp(-(mean.w + heads[2].w)));
#ifdef COLOR
            let color = still_at(row + 3u).xyz + heads[4].xyz;
#unroll a 3
            colors[3u * i * deform.sh_stored + $(a)u] = color[$a];
#end
#endif
        }
#unroll p $POINTS
#unroll h $HEADS
        heads[$p * $HEADS + $h] = heads[($p + 1) % $POINTS * $HEADS + $h];
#end
#end
    }
}
