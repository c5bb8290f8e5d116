// Closes the guard behind which nothing is changed, where a step's values are not finite or its intersections did not fit. It
// then names that step until the host opens it, so that steps that are in flight behind it change nothing, either.
struct Guarded {
    step: u32,
    capacity: u32,
    rounds: u32,     // 1 where lists are drawn in rounds, of which they may need more
}

const OVERFLOW = 0x80000000u;

@group(0) @binding(0) var<uniform> guarded: Guarded;
@group(0) @binding(1) var<storage, read> needed: array<u32>;
@group(0) @binding(2) var<storage, read_write> bad: u32;
@group(0) @binding(3) var<storage, read_write> guard: u32;

@compute @workgroup_size(1)
fn main() {
    if (needed[0] > guarded.capacity || (guarded.rounds == 1u && needed[2] != 0u)) {
        bad |= OVERFLOW;
    }
    if (bad != 0u && guard == 0u) {
        guard = guarded.step;
    }
}
