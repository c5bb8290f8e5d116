// The gate between the decoder's layers and its heads: the temporal channels, rectified, times 2 sigmoid(x) - 1 of the
// spatial ones, whose layer has half its weights, so that this is tanh. QUADS: on four channels at once.
#ifdef QUADS
alias Channels = vec4<f32>;
#else
alias Channels = f32;
#endif

// Not the built-in tanh, which some drivers compute as a quotient that overflows.
fn opening(half: Channels) -> Channels {
    return 2.0 / (1.0 + exp(-2.0 * half)) - 1.0;
}

fn gated(temporal: Channels, half: Channels) -> Channels {
    return max(temporal, Channels(0.0)) * opening(half);
}
