// A number that only the device knows, bound as a uniform (which costs less to read than storage).
struct Count { value: u32 }
