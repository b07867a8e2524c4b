// Shared by the kernels: vectors of eight numbers, of eight Gaussians or of the pixels in a row of a tile, and ranges of
// Gaussians for threads.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

namespace {

constexpr int LANES = 8;
constexpr int TILE = 8;          // edge of a tile, pixels
constexpr int64_t RANGE = 1024;  // Gaussians that a thread takes at once
constexpr float LN2 = 0.693147180559945f, LOG2E = 1.44269504088896f;
constexpr float SHORTEST = std::numeric_limits<float>::min();  // vectors of no larger component are zero

typedef float Lane __attribute__((vector_size(4 * LANES)));
typedef double Wide __attribute__((vector_size(8 * LANES)));
typedef int32_t Mask __attribute__((vector_size(4 * LANES)));

const Lane ZERO = {};

inline Lane larger(Lane a, Lane b) { return a > b ? a : b; }

inline Lane smaller(Lane a, Lane b) { return a < b ? a : b; }

inline Lane clamp(Lane x, float low, float high) { return smaller(larger(x, ZERO + low), ZERO + high); }

inline Lane magnitude(Lane x) { return larger(x, -x); }

inline Mask is_finite(Lane x) { return x - x == ZERO; }

// All bits of a vector's numbers.
inline uint32_t bits_of(Mask mask) {
    uint64_t parts[4];
    std::memcpy(parts, &mask, sizeof(mask));
    const uint64_t both = (parts[0] | parts[1]) | (parts[2] | parts[3]);
    return static_cast<uint32_t>(both | both >> 32);
}

// Calls ``work`` with the place of each bit that is set, the lowest first.
template <typename Work>
inline void each_bit(uint32_t bits, Work work) {
    for (; bits; bits &= bits - 1) work(__builtin_ctz(bits));
}

// First tile with a pixel centre at or after a position.
inline int64_t tile_from(float position, int64_t tiles) {
    const float tile = std::ceil((position - (TILE - 0.5f)) / TILE);
    return static_cast<int64_t>(std::min(std::max(tile, 0.0f), static_cast<float>(tiles)));
}

// Last tile with a pixel centre at or before a position.
inline int64_t tile_to(float position, int64_t tiles) {
    const float tile = std::floor((position - 0.5f) / TILE);
    return static_cast<int64_t>(std::min(std::max(tile, -1.0f), static_cast<float>(tiles - 1)));
}

inline Lane narrow(Wide x) { return __builtin_convertvector(x, Lane); }

template <typename Function>
inline Lane each(Lane x, Function function) {
    float values[LANES];
    std::memcpy(values, &x, sizeof(Lane));
    for (float& value : values) value = function(value);
    std::memcpy(&x, values, sizeof(Lane));
    return x;
}

inline Lane root(Lane x) {
    return each(x, [](float value) { return std::sqrt(value); });
}

inline float sum(Lane x) {
    return ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]));
}

// Eight numbers of two vectors, whose places run from 0 to 15.
#ifdef __clang__
#define POINTSPLAT_MIX(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define POINTSPLAT_MIX(a, b, ...) __builtin_shuffle(a, b, Mask{__VA_ARGS__})
#endif

// The sums of eight vectors, each as of ``sum``.
inline Lane sums(const Lane* v) {
    const auto halves = [](Lane a, Lane b) {
        return POINTSPLAT_MIX(a, b, 0, 1, 2, 3, 8, 9, 10, 11) + POINTSPLAT_MIX(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
    };
    const auto quarters = [](Lane a, Lane b) {
        return POINTSPLAT_MIX(a, b, 0, 1, 8, 9, 4, 5, 12, 13) + POINTSPLAT_MIX(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
    };
    const Lane a = quarters(halves(v[0], v[4]), halves(v[1], v[5])), b = quarters(halves(v[2], v[6]), halves(v[3], v[7]));
    return POINTSPLAT_MIX(a, b, 0, 2, 8, 10, 4, 6, 12, 14) + POINTSPLAT_MIX(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}

// 2^x to 2e-7 for -126 <= x <= 0; without meaning below. A polynomial of 2^f on [-0.5, 0.5], fitted for the least relative
// error (9e-8) and evaluated in pairs: half as many steps, one after the other, as by Horner.
inline Lane exp2_of(Lane x) {
    const Lane shifted = x + 12582912.0f;  // 1.5 * 2^23: rounds to the nearest integer, which its last bits then are
    const Lane f = x - (shifted - 12582912.0f), ff = f * f;
    const Lane low = f * 0.6931470036506653f + 1.0f, middle = f * 0.05550733581185341f + 0.24022242426872253f;
    const Lane p = ((f * 0.001326472731307149f + 0.009671512991189957f) * ff + middle) * ff + low;
    return reinterpret_cast<Lane>(reinterpret_cast<Mask>(p) + (reinterpret_cast<Mask>(shifted) << 23));
}

template <int D>
inline Lane dot(const Lane (&a)[D], const Lane (&b)[D]) {
    Lane sum = a[0] * b[0];
    for (int d = 1; d < D; ++d) sum += a[d] * b[d];
    return sum;
}

// Each component needs two columns only, so it is exact for a needle.
inline void cross(const Lane (&p)[3], const Lane (&q)[3], Lane (&out)[3]) {
    out[0] = p[1] * q[2] - p[2] * q[1];
    out[1] = p[2] * q[0] - p[0] * q[2];
    out[2] = p[0] * q[1] - p[1] * q[0];
}

// Unit vectors in place, and the inverse of their lengths; both zero for zero. Squares neither under- nor overflow.
template <int D>
inline Lane normalise(Lane (&vector)[D]) {
    Lane largest = magnitude(vector[0]);
    for (int d = 1; d < D; ++d) largest = larger(largest, magnitude(vector[d]));
    const Mask zero = largest < SHORTEST;
    const Lane inverse = zero ? ZERO : 1.0f / largest;
    for (Lane& value : vector) value *= inverse;
    const Lane square = dot(vector, vector), shrink = 1.0f / root(zero ? ZERO + 1.0f : square);
    for (Lane& value : vector) value *= shrink;
    return inverse * shrink;
}

// Rows of up to eight Gaussians. Lanes after the last Gaussian repeat it, and are not stored.
struct Lanes {
    int64_t rows[LANES];
    int count;

    Lanes(const int64_t* from, int64_t left) : count(static_cast<int>(std::min<int64_t>(left, LANES))) {
        for (int lane = 0; lane < LANES; ++lane) rows[lane] = from[std::min(lane, count - 1)];
    }

    Lanes(int64_t first, int64_t left) : count(static_cast<int>(std::min<int64_t>(left, LANES))) {
        for (int lane = 0; lane < LANES; ++lane) rows[lane] = first + std::min(lane, count - 1);
    }

    // Zeros where there is no array.
    template <int D>
    void load(const float* array, Lane (&out)[D]) const {
        if (!array) {
            for (Lane& value : out) value = ZERO;
            return;
        }
        float values[D][LANES];
        for (int lane = 0; lane < LANES; ++lane)
            for (int d = 0; d < D; ++d) values[d][lane] = array[rows[lane] * D + d];
        std::memcpy(out, values, sizeof(out));
    }

    Lane load(const float* array) const {
        Lane out[1];
        load(array, out);
        return out[0];
    }

    // Nothing where there is no array.
    template <int D>
    void store(float* array, const Lane (&in)[D]) const {
        if (!array) return;
        float values[D][LANES];
        std::memcpy(values, in, sizeof(in));
        for (int lane = 0; lane < count; ++lane)
            for (int d = 0; d < D; ++d) array[rows[lane] * D + d] = values[d][lane];
    }

    void store(float* array, Lane in) const {
        const Lane one[1] = {in};
        store(array, one);
    }
};

// Calls ``work`` with ranges of ``count`` Gaussians that no other thread has; ``next`` counts those that were taken.
template <typename Work>
void each_range(int64_t* next, int64_t count, Work work) {
    for (;;) {
        const int64_t range = __atomic_fetch_add(next, 1, __ATOMIC_RELAXED), first = range * RANGE;
        if (first >= count) return;
        work(range, first, std::min(first + RANGE, count));
    }
}

}  // namespace
