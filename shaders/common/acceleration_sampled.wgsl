// The sampled Gaussians at both times, from the heads' outputs there.

fn before_at(i: u32, column: u32) -> f32 {
    return before[i * acceleration.outputs + column] + biases_before[column / 4u][column % 4u];
}

fn after_at(i: u32, column: u32) -> f32 {
    return after[i * acceleration.outputs + column] + biases_after[column / 4u][column % 4u];
}

fn sampled(turn: vec4<f32>, shift: vec3<f32>, change: vec3<f32>, row: u32) -> Sampled {
    let turned = turn + IDENTITY;
    let changed = resting_scales(geometry[ROW * row + 2u].xyz) + change;
    let mean = rotated(unit(turned), geometry[ROW * row].xyz) + shift;
    return Sampled(turned, changed, mean, moved_scales(changed, acceleration.mirror));
}

fn sampled_before(i: u32, row: u32) -> Sampled {
    let turn = vec4(before_at(i, 0u), before_at(i, 1u), before_at(i, 2u), before_at(i, 3u));
    let shift = vec3(before_at(i, SHIFT), before_at(i, SHIFT + 1u), before_at(i, SHIFT + 2u));
    let change = vec3(before_at(i, SCALES), before_at(i, SCALES + 1u), before_at(i, SCALES + 2u));
    return sampled(turn, shift, change, row);
}

fn sampled_after(i: u32, row: u32) -> Sampled {
    let turn = vec4(after_at(i, 0u), after_at(i, 1u), after_at(i, 2u), after_at(i, 3u));
    let shift = vec3(after_at(i, SHIFT), after_at(i, SHIFT + 1u), after_at(i, SHIFT + 2u));
    let change = vec3(after_at(i, SCALES), after_at(i, SCALES + 1u), after_at(i, SCALES + 2u));
    return sampled(turn, shift, change, row);
}

// How far the means, and how far the scales, are from the line.
fn mean_apart(first: Sampled, last: Sampled, row: u32) -> vec3<f32> {
    let now = vec3(means[3u * row], means[3u * row + 1u], means[3u * row + 2u]);
    return now - mix(first.mean, last.mean, acceleration.share);
}

fn scale_apart(first: Sampled, last: Sampled, row: u32) -> vec3<f32> {
    let now = vec3(scales[3u * row], scales[3u * row + 1u], scales[3u * row + 2u]);
    return now - mix(first.scale, last.scale, acceleration.share);
}
