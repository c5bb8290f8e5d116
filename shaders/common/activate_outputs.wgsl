// The heads' outputs of a Gaussian, with their biases.
fn vec3_at(i: u32, column: u32) -> vec3<f32> {
    let at = i * activation.outputs + column;
    return vec3(outputs[at], outputs[at + 1u], outputs[at + 2u]) + vec3_bias(column);
}

fn vec4_at(i: u32, column: u32) -> vec4<f32> {
    let at = i * activation.outputs + column;
    return vec4(outputs[at], outputs[at + 1u], outputs[at + 2u], outputs[at + 3u]) + vec4_bias(column);
}
