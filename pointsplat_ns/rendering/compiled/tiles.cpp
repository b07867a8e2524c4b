// The tiles that each Gaussian touches, for float32 on a CPU.
//
// compiled/tiles.py calls this file where it was built; ellipses.py does the same in torch. Gaussians are rows of the table
// of pointsplat_tabulate. At an offset v across rows of pixels, the ellipse a w^2 + d v^2 = level within which one is drawn
// reaches from r v - w to r v + w.

#include <utility>
#include <vector>

#include "tiles.h"

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

// Fetches the row of a Gaussian that is read soon.
inline void fetch(const Listing& l, int64_t at) {
    __builtin_prefetch(l.table + l.stride * l.order[std::min(at + AHEAD, l.count - 1)]);
}

inline Ellipse ellipse_of(const Listing& l, int64_t at) {
    return Ellipse(l.table + l.stride * l.order[at], l.log2_alpha_min);
}

// Writes the strips of a Gaussian in rows of tiles ``top`` to ``bottom``.
void write_strips(const Listing& l, int64_t at, int64_t top, int64_t bottom, Strip* strips) {
    const int32_t* box = l.boxes + 4 * at;
    if (box[2] == box[3] || box[0] == box[1]) {  // the ellipse touches all tiles of its box
        std::fill(strips, strips + std::max<int64_t>(bottom - top + 1, 0), Strip{box[2], box[3]});
        return;
    }
    const Ellipse e = ellipse_of(l, at);
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

// Calls ``visit`` with the place of each Gaussian in the order and each tile that its strips touch; ``before`` first, with
// the place, its rows of tiles and its strips.
template <typename Before, typename Visit>
void each_pair(const Listing& l, Before before, Visit visit) {
    Strip* strips = l.strips;
    for (int64_t at = 0; at < l.count; ++at) {
        const int32_t* box = l.boxes + 4 * at;
        const int64_t top = std::max<int64_t>(box[0], l.top), bottom = std::min<int64_t>(box[1], l.bottom - 1);
        before(at, top, bottom, strips);
        for (int64_t row = top; row <= bottom; ++row, ++strips)
            for (int64_t column = strips->from; column <= strips->to; ++column)
                visit(at, (row - l.top) * l.columns + column);
    }
}

}  // namespace

extern "C" {

// Writes the order of ``count`` depths, not negative, equal ones as they stand: sorted by three digits of 11 bits.
void pointsplat_by_depth(const float* depths, int64_t count, int64_t* order) {
    constexpr int DIGITS = 3, BITS = 11, VALUES = 1 << BITS;
    std::vector<int64_t> values(count), other(count);  // bits of the depth, which are in its order, then the place
    int32_t places[DIGITS][VALUES] = {};
    const auto digit = [](int64_t value, int which) { return value >> (32 + BITS * which) & (VALUES - 1); };
    for (int64_t i = 0; i < count; ++i) {
        int32_t bits;
        std::memcpy(&bits, depths + i, sizeof(bits));
        values[i] = static_cast<int64_t>(bits) << 32 | i;
        for (int which = 0; which < DIGITS; ++which) ++places[which][digit(values[i], which)];
    }
    for (int which = 0; which < DIGITS; ++which) {
        int32_t sum = 0;
        for (int32_t& place : places[which]) sum += std::exchange(place, sum);
        for (int64_t value : values) other[places[which][digit(value, which)]++] = value;
        values.swap(other);
    }
    for (int64_t i = 0; i < count; ++i) order[i] = values[i] & 0xffffffff;
}

// Writes boxes.
void pointsplat_boxes(const Listing* listing, int64_t* next) {
    const Listing& l = *listing;
    each_range(next, l.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t at = first; at < last; ++at) {
            fetch(l, at);
            const Ellipse e = ellipse_of(l, at);
            const float half_y = e.down + l.slack, half_x = e.across + l.slack;
            int32_t* box = l.boxes + 4 * at;
            box[0] = static_cast<int32_t>(tile_from(e.y - half_y, l.rows));
            box[1] = static_cast<int32_t>(tile_to(e.y + half_y, l.rows));
            box[2] = static_cast<int32_t>(tile_from(e.x - half_x, l.columns));
            box[3] = static_cast<int32_t>(tile_to(e.x + half_x, l.columns));
        }
    });
}

// Writes strips, and counts the pairs.
void pointsplat_count(const Listing* listing) {
    const Listing& l = *listing;
    each_pair(
        l,
        [&](int64_t at, int64_t top, int64_t bottom, Strip* strips) {
            fetch(l, at);
            write_strips(l, at, top, bottom, strips);
        },
        [&](int64_t at, int64_t tile) {
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
        l, [](int64_t, int64_t, int64_t, Strip*) {},
        [&](int64_t at, int64_t tile) {
            const int64_t to = free[tile]++;
            l.gaussians[to] = l.order[at];
            if (l.places) l.places[to] = pair++;
        });
}

}  // extern "C"
