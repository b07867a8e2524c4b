// What one camera draws, in one pass over the Gaussians, for pictures without gradients, float32 on a CPU.
//
// pictures.py calls this file where it was built, then lists the tiles and blends as for any picture. It does what
// projection.cpp and colors.cpp do one after the other, without what lies between.

#include <utility>
#include <vector>

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
    int32_t* ids;      // [N] Gaussians that are drawn, those of each range from where the range begins
    double* depths;    // [N] of these
    int64_t* counts;   // [ranges] how many are drawn
    double* nearest;   // [ranges] least depth
    int64_t* order;    // [M] the Gaussians that are drawn, front to back
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
        task.ids[to] = static_cast<int32_t>(lanes.rows[lane]), task.depths[to] = at.point[2][lane];
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
        task.nearest[range] = std::numeric_limits<double>::infinity();
        for (int64_t i = first; i < to; ++i) task.nearest[range] = std::min(task.nearest[range], task.depths[i]);
    });
}

// Sorts places by the depth in their upper half, equal ones as they stand, by three digits of 11 bits, and leaves the
// places.
void sort_by_depth(int64_t* values, int64_t count) {
    constexpr int DIGITS = 3, BITS = 11, VALUES = 1 << BITS;
    std::vector<int64_t> other(count);
    int32_t places[DIGITS][VALUES] = {};
    const auto digit = [](int64_t value, int which) { return value >> (32 + BITS * which) & (VALUES - 1); };
    for (int64_t i = 0; i < count; ++i)
        for (int which = 0; which < DIGITS; ++which) ++places[which][digit(values[i], which)];
    int64_t *from = values, *to = other.data();
    for (int which = 0; which < DIGITS; ++which) {
        if (places[which][digit(values[0], which)] == count) continue;  // all the same
        int32_t sum = 0;
        for (int32_t& place : places[which]) sum += std::exchange(place, sum);
        for (int64_t i = 0; i < count; ++i) to[places[which][digit(from[i], which)]++] = from[i];
        std::swap(from, to);
    }
    for (int64_t i = 0; i < count; ++i) values[i] = from[i] & 0xffffffff;
}

}  // namespace

extern "C" {

// Places all Gaussians: everything but the pairs.
void pointsplat_place(const Placing* task, int64_t* next) {
    switch (task->degree) {
        case -1: return place_all<-1>(*task, next);
        case 0: return place_all<0>(*task, next);
        case 1: return place_all<1>(*task, next);
        case 2: return place_all<2>(*task, next);
        case 3: return place_all<3>(*task, next);
    }
}

// Orders the Gaussians by depth, equal ones by row.
void pointsplat_order(const Placing* task) {
    const int64_t ranges = (task->scene.count + RANGE - 1) / RANGE;
    if (ranges == 0) return;  // no Gaussians
    const double nearest = *std::min_element(task->nearest, task->nearest + ranges);
    int64_t drawn = 0;
    for (int64_t range = 0; range < ranges; ++range) {
        for (int64_t i = range * RANGE; i < range * RANGE + task->counts[range]; ++i) {
            const float beyond = static_cast<float>(task->depths[i] - nearest);  // not negative: ordered as its bits
            int32_t bits;
            std::memcpy(&bits, &beyond, sizeof(bits));
            task->order[drawn++] = static_cast<int64_t>(bits) << 32 | i;
        }
    }
    if (drawn == 0) return;
    sort_by_depth(task->order, drawn);
    for (int64_t i = 0; i < drawn; ++i) task->order[i] = task->ids[task->order[i]];
}

}  // extern "C"
