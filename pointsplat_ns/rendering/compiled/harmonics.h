// The basis of spherical harmonics, colours and their gradients: shared by colors.cpp and pictures.cpp.
// spherical_harmonics.py says where the formulas are from.

#pragma once

#include "lanes.h"

namespace {

constexpr float C0 = 0.28209479177387814f, C1 = 0.4886025119029199f;
constexpr float C2[3] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
constexpr float C3[5] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f,
                         1.445305721320277f};

template <int DEGREE>
void basis_of(const Lane (&unit)[3], Lane* out) {
    const Lane x = unit[0], y = unit[1], z = unit[2], xx = x * x, yy = y * y, zz = z * z, xy = x * y;
    out[0] = ZERO + C0;
    if (DEGREE >= 1) out[1] = -C1 * y, out[2] = C1 * z, out[3] = -C1 * x;
    if (DEGREE >= 2) {
        out[4] = C2[0] * xy, out[5] = -C2[0] * (y * z), out[6] = C2[1] * (2.0f * zz - xx - yy);
        out[7] = -C2[0] * (x * z), out[8] = C2[2] * (xx - yy);
    }
    if (DEGREE >= 3) {
        const Lane around = 4.0f * zz - xx - yy;
        out[9] = -C3[0] * y * (3.0f * xx - yy), out[10] = C3[1] * xy * z, out[11] = -C3[2] * y * around;
        out[12] = C3[3] * z * (2.0f * zz - 3.0f * xx - 3.0f * yy), out[13] = -C3[2] * x * around;
        out[14] = C3[4] * z * (xx - yy), out[15] = -C3[0] * x * (xx - 3.0f * yy);
    }
}

// The colour of one lane's Gaussian from its coefficients: constant ones, and all others in rows of 3. NaN where it is
// not finite.
template <int USED>
void color_of(const float (&basis)[USED][LANES], int lane, const float* first, const float* rest, float* out) {
    float sum[3];
    for (int c = 0; c < 3; ++c) sum[c] = basis[0][lane] * first[c];
    for (int k = 1; k < USED; ++k)
        for (int c = 0; c < 3; ++c) sum[c] += basis[k][lane] * rest[3 * (k - 1) + c];
    for (int c = 0; c < 3; ++c) {
        const float color = (sum[c] - sum[c]) + (sum[c] + 0.5f);  // NaN where it is infinite
        out[c] = color < 0.0f ? 0.0f : color;
    }
}

// Gradient by the unit direction, from the gradients of the basis.
template <int DEGREE>
void basis_backward(const Lane (&unit)[3], const Lane* grad, Lane (&out)[3]) {
    const Lane x = unit[0], y = unit[1], z = unit[2];
    Lane gx = -C1 * grad[3], gy = -C1 * grad[1], gz = C1 * grad[2];
    if (DEGREE >= 2) {
        const Lane a = C2[0] * grad[4], b = C2[0] * grad[5], c = 2.0f * C2[1] * grad[6], d = C2[0] * grad[7];
        const Lane e = 2.0f * C2[2] * grad[8];
        gx += a * y - c * x - d * z + e * x;
        gy += a * x - b * z - c * y - e * y;
        gz += 2.0f * c * z - b * y - d * x;
    }
    if (DEGREE >= 3) {
        const Lane xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
        const Lane h0 = C3[0] * grad[9], h1 = C3[1] * grad[10], h2 = C3[2] * grad[11], h3 = C3[3] * grad[12];
        const Lane h4 = C3[2] * grad[13], h5 = C3[4] * grad[14], h6 = C3[0] * grad[15];
        const Lane around = 4.0f * zz - xx - yy, across = 3.0f * (xx - yy), six = 6.0f * xy;
        gx += h1 * yz - h0 * six + 2.0f * (h2 * xy) - 6.0f * (h3 * xz) - h4 * (around - 2.0f * xx) + 2.0f * (h5 * xz) -
              h6 * across;
        gy += h1 * xz - h0 * across - h2 * (around - 2.0f * yy) - 6.0f * (h3 * yz) + 2.0f * (h4 * xy) -
              2.0f * (h5 * yz) + h6 * six;
        gz += h1 * xy - 8.0f * (h2 * yz) + h3 * (6.0f * zz - 3.0f * xx - 3.0f * yy) - 8.0f * (h4 * xz) + h5 * (xx - yy);
    }
    out[0] = gx, out[1] = gy, out[2] = gz;
}

// Gradients of the colours of up to eight Gaussians, ``rows`` of the coefficients: those by the coefficients, where there
// are arrays, zeros before, and by the direction (of any length; a constant has none), where it is asked for.
template <int DEGREE>
void color_back(Lane (&direction)[3], int count, const int64_t (&rows)[LANES], const float (&grad)[LANES][3],
                const float* first, const float* rest, int64_t rest_row, float* grad_first, float* grad_rest,
                Lane (*grad_direction)[3]) {
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    Lane lanes[USED];
    const Lane inverse_length = normalise(direction);
    basis_of<DEGREE>(direction, lanes);
    float basis[USED][LANES], grad_basis[USED][LANES] = {};
    std::memcpy(basis, lanes, sizeof(lanes));
    for (int lane = 0; lane < count; ++lane) {
        const float* by = grad[lane];
        const int64_t others = rest_row * rows[lane] - 3;  // of the second coefficient, less its place
        if (grad_direction)
            for (int k = 1; k < USED; ++k) {
                const float* sh = rest + others + 3 * k;
                grad_basis[k][lane] = sh[0] * by[0] + sh[1] * by[1] + sh[2] * by[2];
            }
        if (grad_first)
            for (int c = 0; c < 3; ++c) grad_first[3 * rows[lane] + c] = basis[0][lane] * by[c];
        if (grad_rest)
            for (int k = 1; k < USED; ++k)
                for (int c = 0; c < 3; ++c) grad_rest[others + 3 * k + c] = basis[k][lane] * by[c];
    }
    if (DEGREE == 0 || !grad_direction) return;
    std::memcpy(lanes, grad_basis, sizeof(lanes));
    basis_backward<DEGREE>(direction, lanes, *grad_direction);
    const Lane along_itself = dot(direction, *grad_direction);
    for (int i = 0; i < 3; ++i)
        (*grad_direction)[i] = ((*grad_direction)[i] - direction[i] * along_itself) * inverse_length;
}

}  // namespace
