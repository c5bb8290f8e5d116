// Real spherical harmonics up to degree 3, in the order and with the signs of 3D Gaussian splatting.
#import common/constants

const SH_COUNT = $SH_COUNT;

// The basis at a direction of unit length.
fn sh_basis(d: vec3<f32>) -> array<f32, SH_COUNT> {
    let x = d.x; let y = d.y; let z = d.z;
    var basis: array<f32, SH_COUNT>;
    basis[0] = SH_C0;
#ifdef SH_1
    basis[1] = -SH_C1 * y;
    basis[2] = SH_C1 * z;
    basis[3] = -SH_C1 * x;
#endif
#ifdef SH_2
    basis[4] = SH_C2_0 * x * y;
    basis[5] = -SH_C2_0 * y * z;
    basis[6] = SH_C2_1 * (2.0 * z * z - x * x - y * y);
    basis[7] = -SH_C2_0 * x * z;
    basis[8] = SH_C2_2 * (x * x - y * y);
#endif
#ifdef SH_3
    basis[9] = -SH_C3_0 * y * (3.0 * x * x - y * y);
    basis[10] = SH_C3_1 * x * y * z;
    basis[11] = -SH_C3_2 * y * (4.0 * z * z - x * x - y * y);
    basis[12] = SH_C3_3 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
    basis[13] = -SH_C3_2 * x * (4.0 * z * z - x * x - y * y);
    basis[14] = SH_C3_4 * z * (x * x - y * y);
    basis[15] = -SH_C3_0 * x * (x * x - 3.0 * y * y);
#endif
    return basis;
}

// Sum over the basis of weights times its derivative by x, y and z, taken as independent variables.
fn sh_basis_gradient(d: vec3<f32>, weights: array<f32, SH_COUNT>) -> vec3<f32> {
    let x = d.x; let y = d.y; let z = d.z;
    var g = vec3(0.0);
#ifdef SH_1
    g += SH_C1 * vec3(-weights[3], -weights[1], weights[2]);
#endif
#ifdef SH_2
    g += SH_C2_0 * (weights[4] * vec3(y, x, 0.0) - weights[5] * vec3(0.0, z, y) - weights[7] * vec3(z, 0.0, x));
    g += SH_C2_1 * weights[6] * vec3(-2.0 * x, -2.0 * y, 4.0 * z);
    g += SH_C2_2 * weights[8] * vec3(2.0 * x, -2.0 * y, 0.0);
#endif
#ifdef SH_3
    let outer = 4.0 * z * z - x * x - y * y;
    g -= SH_C3_0 * weights[9] * vec3(6.0 * x * y, 3.0 * (x * x - y * y), 0.0);
    g += SH_C3_1 * weights[10] * vec3(y * z, x * z, x * y);
    g -= SH_C3_2 * weights[11] * vec3(-2.0 * x * y, outer - 2.0 * y * y, 8.0 * y * z);
    g += SH_C3_3 * weights[12] * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * x * x - 3.0 * y * y);
    g -= SH_C3_2 * weights[13] * vec3(outer - 2.0 * x * x, -2.0 * x * y, 8.0 * x * z);
    g += SH_C3_4 * weights[14] * vec3(2.0 * x * z, -2.0 * y * z, x * x - y * y);
    g -= SH_C3_0 * weights[15] * vec3(3.0 * (x * x - y * y), -6.0 * x * y, 0.0);
#endif
    return g;
}
