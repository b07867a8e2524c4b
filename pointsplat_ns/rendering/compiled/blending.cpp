// The inner loops of blending for float32 on a CPU: the Gaussians of a tile front to back, and their gradients.
//
// blending.py calls this file where it was built; blocks.py does the same in torch.
// Both follow the rule of alpha.py and the algebra of quadratics.py, whose names are used here. A tile has 8 x 8 pixels; a
// row of them is one vector. Each tile is drawn by one thread from front to back, so that the number of threads changes
// nothing.

#include <type_traits>

#include "blending.h"
#include "gradients.h"

namespace {

constexpr int PIXELS = TILE * TILE;
constexpr int CHUNK = 32;    // Gaussians between two checks for saturation, and between two kept transmittances; a bit each
constexpr int GRAB = 4;      // tiles that a thread takes at once
constexpr int AHEAD = 16;    // pairs that are fetched early: a tenth to three tenths less time of a large scene's picture
constexpr int COLOR = 6;     // first column of the colours in the table
constexpr float HALF = 0.5f * (TILE - 1);
constexpr float ROUNDING = 1e-3f;  // log2 alpha: no pixel that is drawn is left out

typedef Lane Row;  // of pixels
static_assert(LANES == TILE, "a row of a tile is one vector");

const Row OFFSETS = {-3.5f, -2.5f, -1.5f, -0.5f, 0.5f, 1.5f, 2.5f, 3.5f};  // of pixels from the tile's centre
const Mask BITS = {1, 2, 4, 8, 16, 32, 64, 128};

inline Row load(const float* from) {
    Row row;
    std::memcpy(&row, from, sizeof(Row));
    return row;
}

inline void store(float* to, Row row) { std::memcpy(to, &row, sizeof(Row)); }

}  // namespace

namespace {

// Fetches ``columns`` numbers that are read soon, in up to two lines of the cache.
inline void fetch(const float* row, int64_t columns) { __builtin_prefetch(row), __builtin_prefetch(row + columns - 1); }

// Up to CHUNK Gaussians, as seen from a tile.
template <int D>
struct Chunk {
    int size;
    float half_a[CHUNK];          // of log2 alpha = base - half_a w^2
    float color[CHUNK][D ? D : 1];
    float r[CHUNK], a[CHUNK], d[CHUNK];
    Row y[CHUNK], base[CHUNK], w[CHUNK];  // by row of the tile: dv, base, w in its middle
    uint32_t reached[TILE], rows[CHUNK];  // bits of the Gaussians that reach each row, of the rows that each reaches

    void read(const Task& task, int64_t begin, int64_t end, float x, float y_centre) {
        size = static_cast<int>(end - begin);
        const int64_t last = task.offsets[task.tiles] - 1;
        Mask reaching = {};
        for (int k = 0; k < size; ++k) {
            fetch(task.table + task.gaussians[std::min(begin + k + AHEAD, last)] * (COLOR + D), COLOR + D);
            const float* row = task.table + task.gaussians[begin + k] * (COLOR + D);
            const float half_d = 0.5f * row[4];
            half_a[k] = 0.5f * row[3];
            r[k] = row[2], a[k] = row[3], d[k] = row[4];
            const float dv = y_centre - row[1], s = (x - row[0]) - row[2] * dv;
            y[k] = OFFSETS + dv;
            base[k] = row[5] - half_d * (y[k] * y[k]);
            w[k] = s - row[2] * OFFSETS;
            const Row nearest = larger(magnitude(w[k]) - HALF, ZERO);
            const Mask reaches = ~(base[k] - half_a[k] * (nearest * nearest) < task.log2_alpha_min - ROUNDING);
            reaching |= reaches & static_cast<int32_t>(1u << k);
            rows[k] = bits_of(reaches & BITS);
            for (int c = 0; c < D; ++c) color[k][c] = row[COLOR + c];
        }
        std::memcpy(reached, &reaching, sizeof(reached));
    }

    Row w_of(int k, int row) const { return OFFSETS + w[k][row]; }

    // Alphas of a row of pixels, 0 where the Gaussian is not drawn for being faint.
    Row alpha(int k, int row, Row w_row, const Task& task) const {
        const Row log2_alpha = base[k][row] - half_a[k] * (w_row * w_row);
        const Row value = smaller(exp2_of(log2_alpha), ZERO + task.alpha_max);
        return log2_alpha > task.log2_alpha_min ? value : ZERO;
    }
};

struct Place {
    float x, y;           // centre, pixels
    Row inside[TILE];     // 1 for pixels of the image, by row
};

Place place_of(const Task& task, int64_t tile) {
    const int64_t top = (task.top + tile / task.columns) * TILE, left = tile % task.columns * TILE;
    Place place{static_cast<float>(left + TILE / 2), static_cast<float>(top + TILE / 2), {}};
    for (int row = 0; row < TILE; ++row)
        for (int column = 0; column < TILE; ++column)
            place.inside[row][column] = left + column < task.width && top + row < task.height ? 1.0f : 0.0f;
    return place;
}

template <int D>
void blend_tile(const Task& task, int64_t tile) {
    const Place place = place_of(task, tile);
    Row through[TILE], last[TILE], color[TILE][D] = {};
    for (int row = 0; row < TILE; ++row) through[row] = place.inside[row], last[row] = ZERO + 1.0f;
    const int64_t begin = task.offsets[tile], end = task.offsets[tile + 1];
    int64_t at = begin;
    Chunk<D> chunk;
    for (int64_t which = task.chunks[tile]; at < end; ++which) {
        if (task.before)
            for (int row = 0; row < TILE; ++row) store(task.before + which * PIXELS + row * TILE, through[row]);
        chunk.read(task, at, at + CHUNK < end ? at + CHUNK : end, place.x, place.y);
        at += chunk.size;
        bool unfinished = false;
        for (int row = 0; row < TILE; ++row) {
            Row t = through[row], left = last[row], c[D];
            if (!(sum(t) > 0.0f)) continue;
            for (int i = 0; i < D; ++i) c[i] = color[row][i];
            each_bit(chunk.reached[row], [&](int k) {
                const Row alpha = chunk.alpha(k, row, chunk.w_of(k, row), task);
                const Row after = t * (1.0f - alpha);
                const Mask drawn = after > task.transmittance_min;
                const Row weight = drawn ? alpha * t : ZERO;
                t = after;  // it falls: a pixel that is finished stays so
                left = drawn ? after : left;
                for (int i = 0; i < D; ++i) c[i] += weight * chunk.color[k][i];
            });
            t = t > task.transmittance_min ? t : ZERO;
            through[row] = t, last[row] = left;
            for (int i = 0; i < D; ++i) color[row][i] = c[i];
            unfinished |= sum(t) > 0.0f;
        }
        if (!unfinished) break;
    }
    task.blended[tile] = at - begin;
    for (int row = 0; row < TILE; ++row) {
        store(task.final_ + tile * PIXELS + row * TILE, last[row]);
        for (int i = 0; i < D; ++i) store(task.image + (tile * D + i) * PIXELS + row * TILE, color[row][i]);
    }
}

// Writes the gradient sums of one Gaussian of a chunk on a tile, and puts it before ``behind``: the colour behind, as a
// product with the gradient of the image, and the gradient of the transmittance.
template <int D, bool ABSOLUTE>
void pass_back(const Task& task, const Chunk<D>& chunk, int k, const Row (&alphas)[TILE], const Row (&weights)[TILE],
               const Row (&pixels)[TILE][D], Row (&behind)[TILE], float* out) {
    constexpr int COLUMNS = MOMENTS + D + (ABSOLUTE ? 2 : 0);
    Row w_sum = ZERO, ww = ZERO, v_sum = ZERO, vv = ZERO, wv = ZERO, one = ZERO, g_color[D] = {}, abs_x = ZERO, abs_y = ZERO;
    each_bit(chunk.rows[k], [&](int row) {
        const Row alpha = alphas[row], weight = weights[row];
        Row change = pixels[row][0] * chunk.color[k][0] - behind[row];
        for (int i = 1; i < D; ++i) change += pixels[row][i] * chunk.color[k][i];
        for (int i = 0; i < D; ++i) g_color[i] += weight * pixels[row][i];
        const Row g = alpha >= task.clamped_from ? ZERO : weight * change;
        behind[row] += alpha * change;
        const Row w = chunk.w_of(k, row), g_w = g * w;
        const float v = chunk.y[k][row];
        one += g, w_sum += g_w, ww += g_w * w;
        v_sum += g * v, vv += g * (v * v), wv += g_w * v;
        if (ABSOLUTE) {
            const Row along = w * chunk.a[k];
            abs_x += magnitude(g * along);
            abs_y += magnitude(g * (chunk.d[k] * v - chunk.r[k] * along));
        }
    });
    Row found[MOMENTS + D + 2] = {w_sum, ww, v_sum, vv, wv, one};
    std::copy(g_color, g_color + D, found + MOMENTS);
    found[MOMENTS + D] = LN2 * abs_x, found[MOMENTS + D + 1] = LN2 * abs_y;
    constexpr int AT_ONCE = COLUMNS < LANES ? 0 : LANES;
    if (AT_ONCE) store(out, sums(found));
    for (int i = AT_ONCE; i < COLUMNS; ++i) out[i] = sum(found[i]);
}

template <int D, bool ABSOLUTE>
void differentiate_tile(const Task& task, int64_t tile) {
    constexpr int COLUMNS = MOMENTS + D + (ABSOLUTE ? 2 : 0);
    const Place place = place_of(task, tile);
    const int64_t begin = task.offsets[tile], passed = begin + task.blended[tile], end = task.offsets[tile + 1];
    std::fill(task.sums + passed * COLUMNS, task.sums + end * COLUMNS, 0.0f);
    Row pixels[TILE][D], behind[TILE], alphas[CHUNK][TILE], weights[CHUNK][TILE];
    for (int row = 0; row < TILE; ++row) {
        const int64_t at = tile * PIXELS + row * TILE;
        behind[row] = load(task.grad_final + at);
        for (int i = 0; i < D; ++i) pixels[row][i] = load(task.grad_image + (tile * D + i) * PIXELS + row * TILE);
    }
    Chunk<D> chunk;
    for (int64_t which = (passed - begin + CHUNK - 1) / CHUNK - 1; which >= 0; --which) {
        const int64_t first = begin + which * CHUNK;
        chunk.read(task, first, first + CHUNK < passed ? first + CHUNK : passed, place.x, place.y);
        for (int row = 0; row < TILE; ++row) {
            Row t = load(task.before + (task.chunks[tile] + which) * PIXELS + row * TILE);
            each_bit(chunk.reached[row], [&](int k) {
                const Row alpha = chunk.alpha(k, row, chunk.w_of(k, row), task);
                const Row after = t * (1.0f - alpha);
                const Mask drawn = after > task.transmittance_min;
                alphas[k][row] = drawn ? alpha : ZERO;
                weights[k][row] = drawn ? alpha * t : ZERO;
                t = after;
            });
        }
        for (int k = chunk.size - 1; k >= 0; --k)
            pass_back<D, ABSOLUTE>(task, chunk, k, alphas[k], weights[k], pixels, behind, task.sums + (first + k) * COLUMNS);
    }
}

// Writes for each Gaussian on a tile the sum over the pixels of its blending weight.
void weigh_tile(const Task& task, int64_t tile) {
    const Place place = place_of(task, tile);
    Row through[TILE];
    for (int row = 0; row < TILE; ++row) through[row] = place.inside[row];
    const int64_t end = task.offsets[tile + 1];
    Chunk<0> chunk;
    for (int64_t at = task.offsets[tile]; at < end; at += chunk.size) {
        chunk.read(task, at, std::min(at + CHUNK, end), place.x, place.y);
        Row weights[CHUNK] = {}, left = ZERO;
        for (int row = 0; row < TILE; ++row) {
            Row t = through[row];
            if (!(sum(t) > 0.0f)) continue;
            each_bit(chunk.reached[row], [&](int k) {
                const Row alpha = chunk.alpha(k, row, chunk.w_of(k, row), task);
                const Row after = t * (1.0f - alpha);
                weights[k] += after > task.transmittance_min ? alpha * t : ZERO;
                t = after;
            });
            t = t > task.transmittance_min ? t : ZERO;
            through[row] = t, left += t;
        }
        for (int k = 0; k < chunk.size; ++k) task.sums[at + k] = sum(weights[k]);
        if (!(sum(left) > 0.0f)) {
            std::fill(task.sums + at + chunk.size, task.sums + end, 0.0f);
            break;
        }
    }
}

template <typename Work>
void each_tile(const Task& task, int64_t* next, Work work) {
    for (;;) {
        const int64_t first = __atomic_fetch_add(next, GRAB, __ATOMIC_RELAXED);
        if (first >= task.tiles) return;
        for (int64_t tile = first; tile < first + GRAB && tile < task.tiles; ++tile) work(task, tile);
    }
}

template <typename Work>
void each_gaussian(int64_t* next, int64_t count, Work work) {
    each_range(next, count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) work(i);
    });
}

// Calls ``work`` with the number of channels as a constant.
template <typename Work>
void with_channels(int64_t channels, Work work) {
    switch (channels) {
        case 1: return work(std::integral_constant<int, 1>());
        case 2: return work(std::integral_constant<int, 2>());
        case 3: return work(std::integral_constant<int, 3>());
        case 4: return work(std::integral_constant<int, 4>());
    }
}

}  // namespace

extern "C" {

int pointsplat_chunk() { return CHUNK; }

void pointsplat_blend(const Task* task, int64_t* next) {
    with_channels(task->channels, [&](auto d) { each_tile(*task, next, blend_tile<d>); });
}

void pointsplat_differentiate(const Task* task, int64_t* next) {
    with_channels(task->channels, [&](auto d) {
        each_tile(*task, next, task->absolute ? differentiate_tile<d, true> : differentiate_tile<d, false>);
    });
}

// For colours of no channel: ``sums`` has one column.
void pointsplat_weigh(const Task* task, int64_t* next) { each_tile(*task, next, weigh_tile); }

// For each of ``count`` Gaussians the sum of its pairs: rows ``pairs[starts[i]]`` to ``pairs[starts[i + 1] - 1]``.
void pointsplat_gather(const float* sums, const int64_t* pairs, const int64_t* starts, const int64_t* order, int64_t count,
                       int64_t columns, float* out, int64_t* next) {
    const int64_t last = starts[count] - 1;
    each_gaussian(next, count, [&](int64_t i) {
        float* to = out + order[i] * columns;
        for (int64_t c = 0; c < columns; ++c) to[c] = 0.0f;
        for (int64_t j = starts[i]; j < starts[i + 1]; ++j) {
            fetch(sums + pairs[std::min(j + AHEAD, last)] * columns, columns);
            for (int64_t c = 0; c < columns; ++c) to[c] += sums[pairs[j] * columns + c];
        }
    });
}

// Row of the table for each Gaussian: x, y (pixels), r, a, d (log2 per pixels^2), log2 opacity, the colour; as
// quadratics.table_of.
void pointsplat_tabulate(const float* means2d, const float* cov2d, const float* det, const float* opacities,
                         const float* colors, int64_t count, int64_t channels, float* table, int64_t* next) {
    each_gaussian(next, count, [&](int64_t i) {
        const float xy = cov2d[3 * i + 1], yy = cov2d[3 * i + 2];
        float* row = table + i * (COLOR + channels);
        row[0] = means2d[2 * i], row[1] = means2d[2 * i + 1];
        row[2] = xy / yy, row[3] = LOG2E * yy / det[i], row[4] = LOG2E / yy, row[5] = std::log2(opacities[i]);
        std::copy_n(colors + i * channels, channels, row + COLOR);
    });
}

// From the moments of Gaussians, the first columns of ``sums``, to their gradients; as quadratics.chain.
void pointsplat_chain(const float* sums, int64_t columns, const float* cov2d, const float* det, const float* opacities,
                      int64_t count, float* grad_means2d, float* grad_cov2d, float* grad_det, float* grad_opacities,
                      int64_t* next) {
    each_gaussian(next, count, [&](int64_t i) {
        float mean2d[2], cov[3];
        moments_back(sums + i * columns, cov2d[3 * i + 1], cov2d[3 * i + 2], det[i], opacities[i], mean2d, cov, grad_det[i],
                     grad_opacities[i]);
        std::copy_n(mean2d, 2, grad_means2d + 2 * i), std::copy_n(cov, 3, grad_cov2d + 3 * i);
    });
}

}  // extern "C"
