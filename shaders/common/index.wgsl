// A dispatch of more than 65,535 workgroups is folded into two dimensions; this is its number again.
fn workgroup_number(id: vec3<u32>, count: vec3<u32>) -> u32 {
    return id.x + id.y * count.x;
}
