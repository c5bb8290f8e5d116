// Charbonnier's loss, a smooth L1: the mean over the pixels of the sum over the channels of sqrt(difference^2 + 0.01^2).
#import common/loss_term

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= term.size)) {
        return;
    }
    let difference = rendered(id.xy) - truth(id.xy);
    let root = sqrt(difference * difference + 1e-4);
    leave(id.xy, root.x + root.y + root.z, difference / root);
}
