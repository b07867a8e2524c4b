// The tiles that each Gaussian touches, for float32 on a CPU.
//
// compiled/tiles.py calls this file where it was built; ellipses.py does the same in torch. Gaussians are rows of the table
// of pointsplat_tabulate. At an offset v across rows of pixels, the ellipse a w^2 + d v^2 = level within which one is drawn
// reaches from r v - w to r v + w.

#include <vector>

#include "lanes.h"

extern "C" {

// The columns of tiles that an ellipse touches in one row of tiles; none if the last is before the first.
struct Strip {
    int32_t from, to;
};

// Gaussians, front to back, and the tiles that they touch in some rows of tiles.
struct Listing {
    const float* table;
    const int32_t* boxes;  // [.., 4] first and last row of tiles, first and last column, by place
    const int32_t* ids;    // row of the table, by place; null if it is the place
    const int64_t* order;  // [M] places, front to back
    int64_t count, stride;  // M, numbers in a row of the table
    int64_t height, columns, top, bottom;  // of the image, pixels and tiles; rows of tiles from top on, before bottom
    float log2_alpha_min, slack;
    Strip* strips;                // one for each row of tiles of each Gaussian
    int64_t* offsets;             // [tiles + 1] counts, in the next place, then where each tile's pairs start
    int64_t* counts;              // [M] pairs of each Gaussian; or null
    int64_t *gaussians, *places;  // [P] rows of the table by tile; where each pair stands by Gaussian, or null
};

}  // extern "C"

namespace {

constexpr int64_t AHEAD = 24;  // Gaussians between the one that is prefetched and the one that is read

// An ellipse, and how far it reaches down and across.
struct Ellipse {
    float x, y, r, a, d, level, down, across;

    Ellipse(const float* row, float log2_alpha_min) : x(row[0]), y(row[1]), r(row[2]), a(row[3]), d(row[4]) {
        level = 2.0f * std::max(row[5] - log2_alpha_min, 0.0f);
        down = std::sqrt(level / d), across = std::sqrt(level / a + (r * down) * (r * down));
    }
};

inline int64_t id_of(const Listing& l, int64_t place) { return l.ids ? l.ids[place] : place; }

// Writes the strips of a Gaussian in rows of tiles ``top`` to ``bottom``.
void write_strips(const Listing& l, int64_t place, int64_t top, int64_t bottom, Strip* strips) {
    const int32_t* box = l.boxes + 4 * place;
    if (box[2] == box[3] || box[0] == box[1]) {  // the ellipse touches all tiles of its box
        std::fill(strips, strips + std::max<int64_t>(bottom - top + 1, 0), Strip{box[2], box[3]});
        return;
    }
    const Ellipse e(l.table + l.stride * id_of(l, place), l.log2_alpha_min);
    const float widest = e.across > 0.0f ? e.r * e.down / e.across * e.down : 0.0f;
    for (int64_t row = top; row <= bottom; ++row) {
        const float first = row * TILE + (0.5f - l.slack) - e.y;
        const float last = std::min(row * TILE + (TILE - 0.5f), l.height - 0.5f) + l.slack - e.y;
        const auto edge = [&](float v, float sign) {  // at the v of the row that is nearest to where it is widest
            v = std::min(std::max(v, first), last);
            return e.x + e.r * v + sign * (std::sqrt(std::max(e.level - e.d * v * v, 0.0f) / e.a) + l.slack);
        };
        *strips++ = {static_cast<int32_t>(tile_from(edge(-widest, -1.0f), l.columns)),
                     static_cast<int32_t>(tile_to(edge(widest, 1.0f), l.columns))};
    }
}

// Calls ``visit`` with the number in the order and the row of each Gaussian, and each tile that its strips touch; ``before``
// first, with its place, its rows of tiles and its strips.
template <typename Before, typename Visit>
void each_pair(const Listing& l, Before before, Visit visit) {
    Strip* strips = l.strips;
    for (int64_t at = 0; at < l.count; ++at) {
        const int64_t place = l.order[at], ahead = l.order[std::min(at + AHEAD, l.count - 1)];
        __builtin_prefetch(l.boxes + 4 * ahead);
        if (l.ids) __builtin_prefetch(l.ids + ahead);
        const int32_t* box = l.boxes + 4 * place;
        const int64_t top = std::max<int64_t>(box[0], l.top), bottom = std::min<int64_t>(box[1], l.bottom - 1);
        before(at, place, top, bottom, strips);
        for (int64_t row = top; row <= bottom; ++row, ++strips)
            for (int64_t column = strips->from; column <= strips->to; ++column)
                visit(at, id_of(l, place), (row - l.top) * l.columns + column);
    }
}

}  // namespace

extern "C" {

// Writes the boxes of ``count`` Gaussians in the rows of a table without colours.
void pointsplat_boxes(const float* table, int64_t count, float log2_alpha_min, float slack, int64_t rows, int64_t columns,
                      int32_t* boxes, int64_t* next) {
    each_range(next, count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            const Ellipse e(table + 6 * i, log2_alpha_min);
            const float half_y = e.down + slack, half_x = e.across + slack;
            boxes[4 * i] = static_cast<int32_t>(tile_from(e.y - half_y, rows));
            boxes[4 * i + 1] = static_cast<int32_t>(tile_to(e.y + half_y, rows));
            boxes[4 * i + 2] = static_cast<int32_t>(tile_from(e.x - half_x, columns));
            boxes[4 * i + 3] = static_cast<int32_t>(tile_to(e.x + half_x, columns));
        }
    });
}

// Writes strips, and counts the pairs.
void pointsplat_count(const Listing* listing) {
    const Listing& l = *listing;
    each_pair(
        l,
        [&](int64_t at, int64_t place, int64_t top, int64_t bottom, Strip* strips) {
            const int64_t ahead = l.order[std::min(at + AHEAD / 2, l.count - 1)];
            __builtin_prefetch(l.table + l.stride * id_of(l, ahead));
            write_strips(l, place, top, bottom, strips);
        },
        [&](int64_t at, int64_t, int64_t tile) {
            ++l.offsets[tile + 1];
            if (l.counts) ++l.counts[at];
        });
}

// Writes the pairs.
void pointsplat_list(const Listing* listing) {
    const Listing& l = *listing;
    std::vector<int64_t> free(l.offsets, l.offsets + (l.bottom - l.top) * l.columns);  // where the next pair of each tile goes
    int64_t pair = 0;
    each_pair(
        l, [](int64_t, int64_t, int64_t, int64_t, Strip*) {},
        [&](int64_t, int64_t row, int64_t tile) {
            const int64_t to = free[tile]++;
            l.gaussians[to] = row;
            if (l.places) l.places[to] = pair++;
        });
}

}  // extern "C"
