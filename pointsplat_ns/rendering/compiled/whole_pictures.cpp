// What one camera draws, in one pass over the Gaussians, and the gradients by them in another, for float32 on a CPU.
//
// pictures.py calls this file where it was built, and lists the tiles and blends as for any picture between both. It does
// what projection.cpp and colors.cpp do one after the other, without what lies between.

#include <numeric>
#include <vector>

#include "blending.h"
#include "camera.h"
#include "gradients.h"
#include "harmonics.h"
#include "tiles.h"

extern "C" {

struct Placing {
    Camera camera;
    Scene scene;
    const float *first, *rest;       // SH coefficients, [N, 3] and [N, K - 1, 3]
    int64_t rest_row, degree;        // numbers of the others of a Gaussian; degree of the basis, -1 for no colours
    float most_color;
    float* table;      // [N, 6 + channels], as of pointsplat_tabulate; rows of Gaussians that are not drawn stay as is
    int64_t* ids;      // [N] Gaussians that are drawn, those of each range from where the range begins
    double* depths;    // [N] of these
    int64_t *counts, *spoilt;  // [ranges] how many are drawn, and how many are not because of their colours
};

struct PlacingGradient {
    Placing placing;     // of three channels
    const int64_t* ids;  // [M] Gaussians that are drawn, ascending
    int64_t drawn;       // M
    const float* sums;   // [N, MOMENTS + 3] of the pixels of each, of these
    // By the parameters of the scene, of which the standard deviations and opacities are exponentials and sigmoids: zeros
    // before; or null.
    float *means, *quats, *scales, *opacities, *first, *rest;
};

// Blending weights of Gaussians, summed over the pixels of each of several pictures.
struct Weighing {
    Placing placing;        // of no colours, without camera, table and lists
    const Camera* cameras;  // [V]
    int64_t views;          // V
    Task drawing;           // its constants
    float slack;
    int64_t most_pairs;  // of Gaussian and tile in a picture
    float* weights;      // [V, N], zeros before
    int64_t* left_out;   // [V] whether a picture has more pairs, and is left out
};

}  // extern "C"

namespace {

constexpr int GEOMETRY = 6;  // columns of the table before the colours

template <int DEGREE>
void fetch_rest(const Placing& task, const Lanes& lanes) {
    for (int64_t row : lanes.rows)
        for (int k = 0; DEGREE > 0 && k < task.rest_row; k += 16) __builtin_prefetch(task.rest + task.rest_row * row + k);
}

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

// Writes what is drawn of up to eight Gaussians from place ``to`` on; returns the next place. Adds those whose colours have
// no meaning to ``spoilt``.
template <int DEGREE>
int64_t place_lanes(const Placing& task, const Lanes& lanes, int64_t to, int64_t& spoilt) {
    constexpr int CHANNELS = DEGREE < 0 ? 0 : 3, COLUMNS = GEOMETRY + CHANNELS;
    const Camera& camera = task.camera;
    const Position at(camera, lanes, task.scene.means);
    const Flat flat(camera, at, Shape(camera, at, lanes, task.scene), lanes.load(task.scene.opacities));
    const Lane rows[GEOMETRY] = {flat.x, flat.y, flat.xy / flat.yy, LOG2E * flat.yy / flat.det, LOG2E / flat.yy, flat.log2_alpha};
    float colors[LANES][3];
    if constexpr (DEGREE >= 0) color_lanes<DEGREE>(task, lanes, at, colors);
    for (int lane = 0; lane < lanes.count; ++lane) {
        if (!flat.drawn[lane]) continue;
        bool usable = true;  // no colour is NaN
        for (int c = 0; c < CHANNELS; ++c) usable &= colors[lane][c] < task.most_color;
        if (!usable) {
            ++spoilt;
            continue;
        }
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
        int64_t candidates[RANGE], to = first, spoilt = 0;
        const int64_t number = find_candidates(task.camera, task.scene, first, last, candidates);
        for (int64_t at = 0; at < number; at += LANES) {
            const Lanes lanes(candidates + at, number - at);
            fetch_rest<DEGREE>(task, lanes);
            to = place_lanes<DEGREE>(task, lanes, to, spoilt);
        }
        task.counts[range] = to - first, task.spoilt[range] = spoilt;
    });
}

// The gradients of up to eight Gaussians.
template <int DEGREE>
void place_back_lanes(const PlacingGradient& task, const Lanes& lanes) {
    const Placing& placing = task.placing;
    const Camera& camera = placing.camera;
    const Position at(camera, lanes, placing.scene.means);
    const Shape shape(camera, at, lanes, placing.scene);
    const Lane opacity = lanes.load(placing.scene.opacities);
    const Lane alpha = camera.antialiased ? opacity * shape.compensation(camera) : opacity;
    Lane sums[MOMENTS + 3], direction[3];
    lanes.load(task.sums, sums);
    Gradient grad = {};
    moments_back(sums, shape.xy, shape.yy + camera.eps2d, shape.det, alpha, grad.mean2d, grad.cov2d, grad.det, grad.alpha);
    float by_color[LANES][3];
    for (int lane = 0; lane < LANES; ++lane)
        for (int c = 0; c < 3; ++c) {
            const float color = placing.table[(GEOMETRY + 3) * lanes.rows[lane] + GEOMETRY + c];
            by_color[lane][c] = color > 0.0f ? sums[MOMENTS + c][lane] : 0.0f;
        }
    for (int i = 0; i < 3; ++i) direction[i] = narrow(at.direction[i]);
    color_back<DEGREE>(direction, lanes.count, lanes.rows, by_color, placing.first, placing.rest, placing.rest_row,
                       task.first, task.rest, DEGREE ? &grad.direction : nullptr);
    project_back(camera, lanes, at, shape, opacity, grad, nullptr);
    for (int i = 0; i < 3; ++i) grad.std[i] *= shape.std[i];
    lanes.store(task.means, grad.direction);
    lanes.store(task.quats, grad.quat);
    lanes.store(task.scales, grad.std);
    lanes.store(task.opacities, grad.alpha * (1.0f - opacity) * opacity);
}

template <int DEGREE>
void place_back_all(const PlacingGradient& task, int64_t* next) {
    each_range(next, task.placing.scene.count, [&](int64_t, int64_t first, int64_t last) {
        const int64_t *end = task.ids + task.drawn, *from = std::lower_bound(task.ids, end, first);
        const int64_t* to = std::lower_bound(from, end, last);
        for (; from < to; from += LANES) {
            const Lanes lanes(from, to - from);
            fetch_rest<DEGREE>(task.placing, lanes);
            place_back_lanes<DEGREE>(task, lanes);
        }
    });
}

// Memory of a thread for one picture after another.
struct Workspace {
    std::vector<float> table, sorted, depths, sums;
    std::vector<double> exact;
    std::vector<int64_t> ids, counts, spoilt, order, places, offsets, pairs;
    std::vector<int32_t> boxes;
    std::vector<Strip> strips;
};

// Places the Gaussians of a picture, and writes which are drawn, front to back, and their rows of the table.
void place_in_order(Placing& placing, Workspace& work) {
    const int64_t count = placing.scene.count, ranges = (count + RANGE - 1) / RANGE;
    work.table.resize(GEOMETRY * count), work.exact.resize(count), work.ids.resize(count);
    work.counts.resize(ranges), work.spoilt.resize(ranges);
    placing.table = work.table.data(), placing.ids = work.ids.data(), placing.depths = work.exact.data();
    placing.counts = work.counts.data(), placing.spoilt = work.spoilt.data();
    int64_t next = 0, drawn = 0;
    place_all<-1>(placing, &next);
    double nearest = std::numeric_limits<double>::infinity();
    for (int64_t range = 0; range < ranges; ++range)
        for (int64_t at = range * RANGE; at < range * RANGE + work.counts[range]; ++at, ++drawn) {
            work.ids[drawn] = work.ids[at], work.exact[drawn] = work.exact[at];
            nearest = std::min(nearest, work.exact[at]);
        }
    work.depths.resize(drawn), work.order.resize(drawn);
    for (int64_t at = 0; at < drawn; ++at) work.depths[at] = static_cast<float>(work.exact[at] - nearest);
    ::pointsplat_by_depth(work.depths.data(), drawn, work.order.data());
    work.sorted.resize(GEOMETRY * drawn), work.places.resize(drawn);
    std::iota(work.places.begin(), work.places.end(), 0);
    for (int64_t at = 0; at < drawn; ++at) {
        const int64_t id = work.order[at] = work.ids[work.order[at]];
        std::copy_n(work.table.data() + GEOMETRY * id, GEOMETRY, work.sorted.data() + GEOMETRY * at);
    }
}

// Adds the weights of one picture; returns whether it is left out.
bool weigh_view(const Weighing& all, int64_t view, Workspace& work) {
    Placing placing = all.placing;
    const Camera& camera = placing.camera = all.cameras[view];
    place_in_order(placing, work);
    const int64_t drawn = work.order.size();
    Listing listing = {};
    listing.table = work.sorted.data(), listing.stride = GEOMETRY, listing.order = work.places.data(), listing.count = drawn;
    listing.height = static_cast<int64_t>(camera.height);
    listing.rows = listing.bottom = (listing.height + TILE - 1) / TILE;
    listing.columns = (static_cast<int64_t>(camera.width) + TILE - 1) / TILE;
    listing.log2_alpha_min = all.drawing.log2_alpha_min, listing.slack = all.slack;
    work.boxes.resize(4 * drawn);
    listing.boxes = work.boxes.data();
    int64_t next = 0, strips = 0;
    ::pointsplat_boxes(&listing, &next);
    for (int64_t at = 0; at < drawn; ++at) strips += std::max(listing.boxes[4 * at + 1] - listing.boxes[4 * at] + 1, 0);
    const int64_t tiles = listing.rows * listing.columns;
    work.strips.resize(strips), work.offsets.assign(tiles + 1, 0);
    listing.strips = work.strips.data(), listing.offsets = work.offsets.data();
    ::pointsplat_count(&listing);
    for (int64_t tile = 0; tile < tiles; ++tile) work.offsets[tile + 1] += work.offsets[tile];
    const int64_t pairs = work.offsets[tiles];
    if (pairs > all.most_pairs) return true;
    work.pairs.resize(pairs), work.sums.resize(pairs);
    listing.gaussians = work.pairs.data();
    ::pointsplat_list(&listing);
    Task task = all.drawing;
    task.table = work.sorted.data(), task.gaussians = work.pairs.data(), task.offsets = task.chunks = work.offsets.data();
    task.tiles = tiles, task.columns = listing.columns, task.channels = 0, task.sums = work.sums.data();
    task.width = static_cast<int64_t>(camera.width), task.height = listing.height;
    next = 0;
    ::pointsplat_weigh(&task, &next);
    float* weights = all.weights + view * placing.scene.count;
    for (int64_t pair = 0; pair < pairs; ++pair) weights[work.order[work.pairs[pair]]] += work.sums[pair];  // in the order of tiles
    return false;
}

}  // namespace

extern "C" {

// One thread weighs a whole picture.
void pointsplat_weigh_views(const Weighing* task, int64_t* next) {
    Workspace work;
    for (int64_t view; (view = __atomic_fetch_add(next, 1, __ATOMIC_RELAXED)) < task->views;)
        task->left_out[view] = weigh_view(*task, view, work);
}

void pointsplat_place(const Placing* task, int64_t* next) {
    switch (task->degree) {
        case -1: return place_all<-1>(*task, next);
        case 0: return place_all<0>(*task, next);
        case 1: return place_all<1>(*task, next);
        case 2: return place_all<2>(*task, next);
        case 3: return place_all<3>(*task, next);
    }
}

void pointsplat_place_back(const PlacingGradient* task, int64_t* next) {
    switch (task->placing.degree) {
        case 0: return place_back_all<0>(*task, next);
        case 1: return place_back_all<1>(*task, next);
        case 2: return place_back_all<2>(*task, next);
        case 3: return place_back_all<3>(*task, next);
    }
}

}  // extern "C"
