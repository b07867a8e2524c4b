// What one camera draws, in one pass over the Gaussians, for pictures without gradients, float32 on a CPU.
//
// pictures.py calls this file where it was built, then lists the tiles and blends as for any picture. It does what
// projection.cpp and colors.cpp do one after the other, without what lies between.

#include "camera.h"
#include "harmonics.h"

extern "C" {

struct Placing {
    Camera camera;
    Scene scene;
    const float *first, *rest;       // SH coefficients, [N, 3] and [N, K - 1, 3]
    int64_t rest_row, degree;        // numbers of the others of a Gaussian; degree of the basis, -1 for no colours
    float most_color;
    float* table;      // [N, 6 + channels], as of pointsplat_tabulate; rows of Gaussians that are not drawn stay as they are
    int64_t* ids;      // [N] Gaussians that are drawn, those of each range from where the range begins
    double* depths;    // [N] of these
    int64_t* counts;   // [ranges] how many are drawn
};

}  // extern "C"

namespace {

constexpr int GEOMETRY = 6;  // columns of the table before the colours

// Colours of up to eight Gaussians; NaN where a coefficient is not finite.
template <int DEGREE>
void color_lanes(const Placing& task, const Lanes& lanes, const Position& at, float (&out)[LANES][3]) {
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    Lane unit[3] = {narrow(at.direction[0]), narrow(at.direction[1]), narrow(at.direction[2])}, values[USED];
    normalise(unit);
    basis_of<DEGREE>(unit, values);
    float basis[USED][LANES];
    std::memcpy(basis, values, sizeof(values));
    for (int lane = 0; lane < lanes.count; ++lane) {
        const float *first = task.first + 3 * lanes.rows[lane], *rest = task.rest + task.rest_row * lanes.rows[lane];
        color_of<USED>(basis, lane, first, rest, out[lane]);
    }
}

// Writes what is drawn of up to eight Gaussians from place ``to`` on; returns the next place.
template <int DEGREE>
int64_t place_lanes(const Placing& task, const Lanes& lanes, int64_t to) {
    constexpr int CHANNELS = DEGREE < 0 ? 0 : 3, COLUMNS = GEOMETRY + CHANNELS;
    const Camera& camera = task.camera;
    const Position at(camera, lanes, task.scene.means);
    const Flat flat(camera, at, Shape(camera, at, lanes, task.scene), lanes.load(task.scene.opacities));
    const Lane base = each(flat.alpha, [](float value) { return std::log2(value); });
    const Lane rows[GEOMETRY] = {flat.x, flat.y, flat.xy / flat.yy, LOG2E * flat.yy / flat.det, LOG2E / flat.yy, base};
    float colors[LANES][3];
    if constexpr (DEGREE >= 0) color_lanes<DEGREE>(task, lanes, at, colors);
    for (int lane = 0; lane < lanes.count; ++lane) {
        if (!flat.drawn[lane]) continue;
        bool usable = true;  // no colour is NaN
        for (int c = 0; c < CHANNELS; ++c) usable &= colors[lane][c] < task.most_color;
        if (!usable) continue;
        float* row = task.table + COLUMNS * lanes.rows[lane];
        for (int i = 0; i < GEOMETRY; ++i) row[i] = rows[i][lane];
        for (int c = 0; c < CHANNELS; ++c) row[GEOMETRY + c] = colors[lane][c];
        task.ids[to] = lanes.rows[lane], task.depths[to] = at.point[2][lane];
        ++to;
    }
    return to;
}

template <int DEGREE>
void place_all(const Placing& task, int64_t* next) {
    each_range(next, task.scene.count, [&](int64_t range, int64_t first, int64_t last) {
        int64_t candidates[RANGE], to = first;
        const int64_t number = find_candidates(task.camera, task.scene, first, last, candidates);
        for (int64_t at = 0; at < number; at += LANES) {
            const Lanes lanes(candidates + at, number - at);
            for (int64_t row : lanes.rows)
                for (int k = 0; DEGREE > 0 && k < task.rest_row; k += 16)
                    __builtin_prefetch(task.rest + task.rest_row * row + k);
            to = place_lanes<DEGREE>(task, lanes, to);
        }
        task.counts[range] = to - first;
    });
}

}  // namespace

extern "C" {

void pointsplat_place(const Placing* task, int64_t* next) {
    switch (task->degree) {
        case -1: return place_all<-1>(*task, next);
        case 0: return place_all<0>(*task, next);
        case 1: return place_all<1>(*task, next);
        case 2: return place_all<2>(*task, next);
        case 3: return place_all<3>(*task, next);
    }
}

}  // extern "C"
