// The basis of spherical harmonics: shared by colors.cpp and pictures.cpp. spherical_harmonics.py says where the formulas
// are from.

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

}  // namespace
