// What the scan adds up: the values, whether they are not zero (FLAGS), or the values picked by an index (GATHER).
#import common/count

@group(0) @binding(0) var<uniform> length: Count;   // the number of elements
#table 1 values: u32
#ifdef GATHER
#table 2 indices: u32
#endif

fn element(i: u32) -> u32 {
    if (i >= length.value) {
        return 0u;
    }
#ifdef GATHER
    return values_at(indices_at(i));
#else
#ifdef FLAGS
    return select(0u, 1u, values_at(i) != 0u);
#else
    return values_at(i);
#endif
#endif
}
