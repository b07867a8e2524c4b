// Colours of Gaussians by spherical harmonics, for float32 on a CPU, and their gradients.
//
// spherical_harmonics.py calls this file where it was built, does the same in torch, and has the names that are used
// here; geometry/harmonics.py says where the formulas are from. Threads take ranges of Gaussians, and
// nothing is summed across Gaussians, so that the number of threads changes nothing.

#include "harmonics.h"

extern "C" {

// Colours of ``count`` Gaussians, or their gradients.
struct Colors {
    const float* directions;                 // [M, 3]
    const float *first, *rest;               // the coefficients of a Gaussian: its first, [3], and the others, [K - 1, 3]
    int64_t rest_row;                        // numbers from the others of a Gaussian to those of the next
    const int64_t* ids;                      // [M] rows of the coefficients
    int64_t count, degree;                   // M, degree of the basis
    float* colors;                           // [M, 3]
    const float* grad_colors;                // as colors; null forward
    float* grad_directions;                  // as directions; or null
    float *grad_first, *grad_rest;           // as the coefficients, zeros before; or null
};

}  // extern "C"

namespace {

inline const float* coefficient(const Colors& task, int64_t row, int k) {
    return k ? task.rest + task.ids[row] * task.rest_row + 3 * (k - 1) : task.first + task.ids[row] * 3;
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

// Prefetches the coefficients of some Gaussians: they are scattered in memory, where no processor predicts them.
template <int USED>
void fetch(const Colors& task, const Lanes& rows) {
    for (int64_t row : rows.rows) {
        __builtin_prefetch(coefficient(task, row, 0));
        if (USED == 1) continue;
        const float* rest = coefficient(task, row, 1);
        for (int at = 0; at < 3 * (USED - 1); at += 16) __builtin_prefetch(rest + at);
    }
}

template <int DEGREE>
void color_lanes(const Colors& task, const Lanes& rows) {
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    fetch<USED>(task, rows);
    Lane unit[3], lanes[USED];
    rows.load(task.directions, unit);
    normalise(unit);
    basis_of<DEGREE>(unit, lanes);
    float basis[USED][LANES];
    std::memcpy(basis, lanes, sizeof(lanes));
    for (int lane = 0; lane < rows.count; ++lane) {
        const float *first = coefficient(task, rows.rows[lane], 0), *rest = coefficient(task, rows.rows[lane], 1);
        color_of<USED>(basis, lane, first, rest, task.colors + 3 * rows.rows[lane]);
    }
}

template <int DEGREE>
void color_backward_lanes(const Colors& task, const Lanes& rows) {
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    if (task.grad_directions) fetch<USED>(task, rows);
    Lane unit[3], lanes[USED];
    rows.load(task.directions, unit);
    const Lane inverse_length = normalise(unit);
    basis_of<DEGREE>(unit, lanes);
    float basis[USED][LANES], grad_basis[USED][LANES] = {};
    std::memcpy(basis, lanes, sizeof(lanes));
    for (int lane = 0; lane < rows.count; ++lane) {
        const int64_t row = rows.rows[lane];
        float grad[3];
        for (int c = 0; c < 3; ++c) grad[c] = task.colors[3 * row + c] > 0.0f ? task.grad_colors[3 * row + c] : 0.0f;
        if (task.grad_directions) {
            for (int k = 0; k < USED; ++k) {
                const float* sh = coefficient(task, row, k);
                grad_basis[k][lane] = sh[0] * grad[0] + sh[1] * grad[1] + sh[2] * grad[2];
            }
        }
        if (task.grad_first) {
            float* out = task.grad_first + task.ids[row] * 3;
            for (int c = 0; c < 3; ++c) out[c] = basis[0][lane] * grad[c];
        }
        if (task.grad_rest) {
            float* out = task.grad_rest + task.ids[row] * task.rest_row;
            for (int k = 1; k < USED; ++k)
                for (int c = 0; c < 3; ++c) out[3 * (k - 1) + c] = basis[k][lane] * grad[c];
        }
    }
    if (DEGREE == 0 || !task.grad_directions) return;
    std::memcpy(lanes, grad_basis, sizeof(lanes));
    Lane grad_unit[3];
    basis_backward<DEGREE>(unit, lanes, grad_unit);
    const Lane along_itself = dot(unit, grad_unit);
    for (int i = 0; i < 3; ++i) grad_unit[i] = (grad_unit[i] - unit[i] * along_itself) * inverse_length;
    rows.store(task.grad_directions, grad_unit);
}

template <int DEGREE>
void color_all(const Colors& task, int64_t* next) {
    const auto work = task.grad_colors ? color_backward_lanes<DEGREE> : color_lanes<DEGREE>;
    each_range(next, task.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t at = first; at < last; at += LANES) work(task, Lanes(at, last - at));
    });
}

}  // namespace

extern "C" {

// Colours, or their gradients if ``grad_colors`` is there.
void pointsplat_color(const Colors* task, int64_t* next) {
    switch (task->degree) {
        case 0: return color_all<0>(*task, next);
        case 1: return color_all<1>(*task, next);
        case 2: return color_all<2>(*task, next);
        case 3: return color_all<3>(*task, next);
    }
}

}  // extern "C"
