// The tiles that each Gaussian touches, for float32 on a CPU.
//
// compiled/tiles.py calls this file where it was built; ellipses.py does the same in torch,
// says where the formulas are from, and has the names that are used here.

#include <vector>

#include "extent.h"

namespace {

constexpr int64_t AHEAD = 24;  // Gaussians between the one that is prefetched and the one that is read

}  // namespace

extern "C" {

struct Grid {
    int64_t height, rows, columns;  // pixels, tiles
    float slack;
};

struct Ellipses {
    const int64_t* order;  // [M]
    float* shapes;         // [M, 7] in depth order, as all that follows
    int64_t *row0, *row1, *column0, *widths;
    int64_t count;  // M
};

struct Footprints {
    Grid grid;
    Ellipses ellipses;
    const float *means2d, *cov2d, *det, *opacities;  // of the projected Gaussians, in their own order
    float alpha_min;
};

void pointsplat_ellipses(const Footprints* task, int64_t* next) {
    const Footprints& f = *task;
    const Ellipses& e = f.ellipses;
    const float slack = f.grid.slack;
    each_range(next, e.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t at = first; at < last; ++at) {
            const int64_t ahead = e.order[std::min(at + AHEAD, e.count - 1)], i = e.order[at];
            __builtin_prefetch(f.means2d + 2 * ahead), __builtin_prefetch(f.cov2d + 3 * ahead);
            __builtin_prefetch(f.det + ahead), __builtin_prefetch(f.opacities + ahead);
            const float x = f.means2d[2 * i], y = f.means2d[2 * i + 1];
            const float xx = f.cov2d[3 * i], xy = f.cov2d[3 * i + 1], yy = f.cov2d[3 * i + 2];
            const float level = 2.0f * std::max(std::log(f.opacities[i] / f.alpha_min), 0.0f);
            float* shape = e.shapes + 7 * at;
            shape[0] = x, shape[1] = y, shape[2] = level, shape[3] = 1.0f / yy;
            shape[4] = xy * std::sqrt(level / xx), shape[5] = xy / yy, shape[6] = f.det[i] / yy;
            const float half_x = std::sqrt(level * xx) + slack, half_y = std::sqrt(level * yy) + slack;
            e.row0[at] = tile_from(y - half_y, f.grid.rows), e.row1[at] = tile_to(y + half_y, f.grid.rows);
            e.column0[at] = tile_from(x - half_x, f.grid.columns);
            const int64_t width = tile_to(x + half_x, f.grid.columns) - e.column0[at] + 1;
            e.widths[at] = std::max<int64_t>(width, 0);
        }
    });
}

// The pairs of a region, in three calls: strips, by threads; how many there are; and the pairs.
struct Listing {
    Grid grid;
    Ellipses ellipses;
    int64_t top, bottom, left, right, tiles;  // the region, and its tiles
    const int64_t* starts;                    // [M + 1] where each Gaussian's strips start
    Strip* strips;                            // columns of the region
    int64_t* counts;              // [M] pairs of each Gaussian
    int64_t* offsets;             // [tiles + 1] counts, then where each tile's pairs start
    int64_t *gaussians, *places;  // [P] by tile, front to back; and where each pair stands by Gaussian
};

}  // extern "C"

namespace {

inline int64_t first_row(const Listing& l, int64_t i) { return std::max(l.ellipses.row0[i], l.top); }

// Calls ``visit`` with each Gaussian and tile that touch, by Gaussian.
template <typename Visit>
void each_pair(const Listing& l, Visit visit) {
    const int64_t columns = l.right - l.left;
    for (int64_t i = 0; i < l.ellipses.count; ++i) {
        int64_t base = (first_row(l, i) - l.top) * columns;
        for (int64_t at = l.starts[i]; at < l.starts[i + 1]; ++at, base += columns)
            for (int64_t tile = base + l.strips[at].from; tile <= base + l.strips[at].to; ++tile) visit(i, tile);
    }
}

}  // namespace

extern "C" {

void pointsplat_strips(const Listing* listing, int64_t* next) {
    const Listing& l = *listing;
    const float slack = l.grid.slack;
    each_range(next, l.ellipses.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            const float *s = l.ellipses.shapes + 7 * i, x = s[0], y = s[1], level = s[2], inverse_yy = s[3], peak = s[4];
            int64_t row = first_row(l, i);
            for (int64_t at = l.starts[i]; at < l.starts[i + 1]; ++at, ++row) {
                const float top = row * TILE + (0.5f - slack) - y;
                const float bottom = std::min(row * TILE + (TILE - 0.5f), l.grid.height - 0.5f) + slack - y;
                const auto edge = [&](float dy, float sign) {
                    dy = std::min(std::max(dy, top), bottom);
                    const float within = std::max(level - dy * dy * inverse_yy, 0.0f);
                    return x + s[5] * dy + sign * (std::sqrt(within * s[6]) + slack);
                };
                const int64_t from = std::max(tile_from(edge(-peak, -1.0f), l.grid.columns), l.left);
                const int64_t to = std::min(tile_to(edge(peak, 1.0f), l.grid.columns), l.right - 1);
                l.strips[at] = {static_cast<int32_t>(from - l.left), static_cast<int32_t>(to - l.left)};
            }
        }
    });
}

void pointsplat_count(const Listing* listing) {
    const Listing& l = *listing;
    each_pair(l, [&](int64_t i, int64_t tile) { ++l.counts[i], ++l.offsets[tile + 1]; });
}

void pointsplat_list(const Listing* listing) {
    const Listing& l = *listing;
    std::vector<int64_t> free(l.offsets, l.offsets + l.tiles);  // where the next pair of each tile goes
    int64_t pair = 0;
    each_pair(l, [&](int64_t i, int64_t tile) {
        const int64_t place = free[tile]++;
        l.gaussians[place] = l.ellipses.order[i], l.places[place] = pair++;
    });
}

}  // extern "C"
