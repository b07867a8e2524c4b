// What one camera draws on which tile, in one pass over the Gaussians, for pictures without gradients, float32 on a CPU.
//
// pictures.py compiles this file where there is a C++ compiler and calls it, then blends as for any picture. It does what
// projection.cpp, colors.cpp and tiles.cpp do one after the other, without what lies between.

#include <utility>
#include <vector>

#include "camera.h"
#include "extent.h"
#include "harmonics.h"

extern "C" {

struct Placing {
    Camera camera;
    Scene scene;
    const float *first, *rest;       // SH coefficients, [N, 3] and [N, K - 1, 3]
    int64_t rest_row, degree;        // numbers of the others of a Gaussian; degree of the basis, -1 for no colours
    int64_t rows, columns;           // of tiles
    float log2_alpha_min, slack, most_color;
    float* table;      // [N, 6 + channels], as of pointsplat_tabulate; rows of Gaussians that are not drawn stay as they are
    int32_t* ids;      // [N] Gaussians that are drawn, those of each range from where the range begins
    double* depths;    // [N] of these
    int32_t* boxes;    // [N, 4] first and last row of tiles, first and last column
    int64_t* counts;   // [ranges] how many are drawn
    double* nearest;   // [ranges] least depth
    int64_t* offsets;  // [tiles + 1] where each tile's pairs start; before, in the next place, how many there are
    int64_t* pairs;    // [P] the Gaussians of each tile, front to back
};

}  // extern "C"

namespace {

constexpr float LN2 = 0.693147180559945f, LOG2E = 1.44269504088896f;
constexpr int GEOMETRY = 6, GRAB = 4;  // columns of the table before the colours; tiles that a thread takes at once
constexpr int64_t FEW = 256;  // pairs that are sorted faster by comparing them

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
    const Lane level = (2.0f * LN2) * larger(base - task.log2_alpha_min, ZERO);  // squared Mahalanobis distance
    const Lane half_x = root(level * flat.xx) + task.slack, half_y = root(level * flat.yy) + task.slack;
    const Lane rows[GEOMETRY] = {flat.x, flat.y, flat.xy / flat.yy, LOG2E * flat.yy / flat.det, LOG2E / flat.yy, base};
    float colors[LANES][3];
    if constexpr (DEGREE >= 0) color_lanes<DEGREE>(task, lanes, at, colors);
    for (int lane = 0; lane < lanes.count; ++lane) {
        if (!flat.drawn[lane]) continue;
        bool usable = true;  // no colour is NaN
        for (int c = 0; c < CHANNELS; ++c) usable &= colors[lane][c] < task.most_color;
        if (!usable) continue;
        const float x = flat.x[lane], y = flat.y[lane];
        int32_t* box = task.boxes + 4 * to;
        box[0] = static_cast<int32_t>(tile_from(y - half_y[lane], task.rows));
        box[1] = static_cast<int32_t>(tile_to(y + half_y[lane], task.rows));
        box[2] = static_cast<int32_t>(tile_from(x - half_x[lane], task.columns));
        box[3] = static_cast<int32_t>(tile_to(x + half_x[lane], task.columns));
        if (box[0] > box[1] || box[2] > box[3]) continue;
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

// Calls ``visit`` with each place of a drawn Gaussian and each tile that its ellipse touches.
template <typename Visit>
void each_pair(const Placing& task, Visit visit) {
    const int64_t stride = GEOMETRY + (task.degree < 0 ? 0 : 3), ranges = (task.scene.count + RANGE - 1) / RANGE;
    for (int64_t range = 0; range < ranges; ++range) {
        for (int64_t i = range * RANGE; i < range * RANGE + task.counts[range]; ++i) {
            const int32_t* box = task.boxes + 4 * i;
            const int64_t across = box[3] - box[2] + 1;
            if (across == 1 || box[0] == box[1]) {  // the ellipse touches all tiles of its box
                for (int64_t row = box[0]; row <= box[1]; ++row)
                    for (int64_t column = box[2]; column <= box[3]; ++column) visit(i, row * task.columns + column);
                continue;
            }
            // In a row of tiles the ellipse a w^2 + d v^2 = 2 level reaches from r v - w to r v + w, at the v of the
            // row that is nearest to where it is widest.
            const float* s = task.table + stride * task.ids[i];
            const float x = s[0], y = s[1], r = s[2], a = s[3], d = s[4];
            const float level = 2.0f * std::max(s[5] - task.log2_alpha_min, 0.0f);
            const float widest = r * std::sqrt(level / (d * (d / a + r * r)));
            for (int64_t row = box[0]; row <= box[1]; ++row) {
                const float top = row * TILE + (0.5f - task.slack) - y;
                const float bottom = std::min(row * TILE + (TILE - 0.5f), task.camera.height - 0.5f) + task.slack - y;
                const auto edge = [&](float v, float sign) {
                    v = std::min(std::max(v, top), bottom);
                    return x + r * v + sign * (std::sqrt(std::max(level - d * v * v, 0.0f) / a) + task.slack);
                };
                const int64_t from = tile_from(edge(-widest, -1.0f), task.columns);
                const int64_t to = tile_to(edge(widest, 1.0f), task.columns);
                for (int64_t column = from; column <= to; ++column) visit(i, row * task.columns + column);
            }
        }
    }
}

// Sorts pairs by depth, equal ones as they stand, by three digits of 11 bits, and leaves the Gaussians. ``other`` has room
// for as many.
void sort_by_depth(int64_t* pairs, int64_t count, int64_t* other) {
    constexpr int DIGITS = 3, BITS = 11, VALUES = 1 << BITS;
    int32_t places[DIGITS][VALUES] = {};
    const auto digit = [](int64_t pair, int which) { return pair >> (32 + BITS * which) & (VALUES - 1); };
    for (int64_t i = 0; i < count; ++i)
        for (int which = 0; which < DIGITS; ++which) ++places[which][digit(pairs[i], which)];
    int64_t *from = pairs, *to = other;
    for (int which = 0; which < DIGITS; ++which) {
        if (places[which][digit(pairs[0], which)] == count) continue;  // all the same
        int32_t sum = 0;
        for (int32_t& place : places[which]) sum += std::exchange(place, sum);
        for (int64_t i = 0; i < count; ++i) to[places[which][digit(from[i], which)]++] = from[i];
        std::swap(from, to);
    }
    for (int64_t i = 0; i < count; ++i) pairs[i] = from[i] & 0xffffffff;
}

}  // namespace

extern "C" {

int64_t pointsplat_range() { return RANGE; }

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

// Counts the pairs of each tile into ``offsets``, from its second place on.
void pointsplat_count(const Placing* task) {
    each_pair(*task, [&](int64_t, int64_t tile) { ++task->offsets[tile + 1]; });
}

// Writes the pairs of each tile from ``free``, [tiles], on: depth in the upper half, which orders them, then the Gaussian.
void pointsplat_list(const Placing* task, int64_t* free) {
    double* end = task->nearest + (task->scene.count + RANGE - 1) / RANGE;
    const double nearest = *std::min_element(task->nearest, end);
    each_pair(*task, [&](int64_t i, int64_t tile) {
        const float beyond = static_cast<float>(task->depths[i] - nearest);  // not negative: ordered as its bits
        int32_t bits;
        std::memcpy(&bits, &beyond, sizeof(bits));
        task->pairs[free[tile]++] = static_cast<int64_t>(bits) << 32 | task->ids[i];
    });
}

// Sorts the pairs of each tile by depth, equal ones by Gaussian, and leaves the Gaussians.
void pointsplat_sort(const Placing* task, int64_t* next) {
    const int64_t tiles = task->rows * task->columns;
    std::vector<int64_t> other;
    for (;;) {
        const int64_t first = __atomic_fetch_add(next, GRAB, __ATOMIC_RELAXED);
        if (first >= tiles) return;
        for (int64_t tile = first; tile < std::min(first + GRAB, tiles); ++tile) {
            int64_t *begin = task->pairs + task->offsets[tile], *end = task->pairs + task->offsets[tile + 1];
            if (end - begin < FEW) {
                std::sort(begin, end);
                for (int64_t* pair = begin; pair < end; ++pair) *pair &= 0xffffffff;
            } else {
                other.resize(std::max<size_t>(other.size(), end - begin));
                sort_by_depth(begin, end - begin, other.data());
            }
        }
    }
}

}  // extern "C"
