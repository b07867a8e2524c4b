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
    if (task.grad_directions) fetch<(DEGREE + 1) * (DEGREE + 1)>(task, rows);
    int64_t gaussians[LANES];
    float grad[LANES][3];
    for (int lane = 0; lane < LANES; ++lane) {
        const int64_t row = rows.rows[lane];
        gaussians[lane] = task.ids[row];
        for (int c = 0; c < 3; ++c) grad[lane][c] = task.colors[3 * row + c] > 0.0f ? task.grad_colors[3 * row + c] : 0.0f;
    }
    Lane direction[3], grad_direction[3];
    rows.load(task.directions, direction);
    color_back<DEGREE>(direction, rows.count, gaussians, grad, task.first, task.rest, task.rest_row, task.grad_first,
                       task.grad_rest, task.grad_directions ? &grad_direction : nullptr);
    if (DEGREE) rows.store(task.grad_directions, grad_direction);
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
