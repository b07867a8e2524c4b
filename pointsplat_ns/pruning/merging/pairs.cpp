// Which pairs are merged, and what becomes of them.
//
// pairs.py calls this file where it was built. It does the same in torch, and has the formulas and the names that are used
// here. Replacements are computed in float64.

#include "lanes.h"

extern "C" {

struct Matching {
    const int32_t* near;  // [n, neighbours]
    const float* costs;   // [n, neighbours]
    int64_t count, neighbours;
    int64_t* keys;     // [n, neighbours]
    int64_t* least;    // [n] the least key of each Gaussian with a free neighbour
    int32_t* partner;  // [n] that neighbour
    int64_t* best;     // [n] the least key of each Gaussian, as either member
    int32_t* taken;    // [n] whether it is in a pair
    int64_t *first, *second, *found;  // [n / 2] members of the pairs and their keys
    int64_t* pairs;                   // [1] number of pairs
};

struct Replacing {
    double max_opacity, growth_exponent;
    const int64_t *first, *second, *place;    // [E], [E], [n]
    int64_t count, axes;                      // E, C
    const float *means, *cov, *alphas;        // of the state: [n, 3], [n, 6], [n]
    const float *colours, *weights;           // [n, C], [n]
    const int32_t* counts;                    // [n]
    float *means_after, *cov_after, *alphas_after, *colours_after, *weights_after;  // of the next state
    int32_t* counts_after;
    float* shares;  // [n]
};

}  // extern "C"

namespace {

constexpr int64_t NEVER = std::numeric_limits<int64_t>::max();
constexpr double MIN_DIVISOR = 1e-300;
constexpr float MOST_COST = std::numeric_limits<float>::max();

// NaN compares as false.
float bounded(float cost) { return cost < MOST_COST ? cost : MOST_COST; }

// A symmetric matrix 3 x 3: xx, xy, xz, yy, yz, zz.
struct Six {
    double a, b, c, d, e, f;

    Six adjugate() const {
        return {d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b};
    }

    double trace() const { return a + d + f; }

    double rms_area() const { return std::sqrt(std::max(adjugate().trace(), 0.0) / 3); }

    double bilinear(const double (&u)[3], const double (&v)[3]) const {
        return u[0] * (a * v[0] + b * v[1] + c * v[2]) + u[1] * (b * v[0] + d * v[1] + e * v[2]) +
               u[2] * (c * v[0] + e * v[1] + f * v[2]);
    }
};

// A symmetric matrix 2 x 2.
struct Three {
    double uu, uv, vv;

    double area() const { return std::sqrt(std::max(uu * vv - uv * uv, 0.0)); }
};

void thinnest_axis(const Six& cov, double (&axis)[3]) {
    Six m = cov.adjugate();
    for (int i = 0; i < 3; ++i) {
        const double trace = std::max(m.trace(), MIN_DIVISOR);
        const double a = m.a / trace, b = m.b / trace, c = m.c / trace, d = m.d / trace, e = m.e / trace, f = m.f / trace;
        m = {a * a + b * b + c * c, a * b + b * d + c * e, a * c + b * e + c * f,
             b * b + d * d + e * e, b * c + d * e + e * f, c * c + e * e + f * f};
    }
    const double columns[3][3] = {{m.a, m.b, m.c}, {m.b, m.d, m.e}, {m.c, m.e, m.f}};
    int column = 0;
    if (m.d > m.a) column = 1;
    if (m.f > std::max(m.a, m.d)) column = 2;
    const double* v = columns[column];
    const double length = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    const bool unique = length > MIN_DIVISOR;
    for (int i = 0; i < 3; ++i) axis[i] = unique ? v[i] / length : i == 2;
}

void plane_axes(const double (&normal)[3], double (&u)[3], double (&v)[3]) {
    const double x = normal[0], y = normal[1], z = normal[2], sign = z >= 0 ? 1.0 : -1.0;
    const double a = -1 / (sign + z), b = x * y * a;
    u[0] = 1 + sign * x * x * a, u[1] = sign * b, u[2] = -sign * x;
    v[0] = b, v[1] = sign + y * y * a, v[2] = -y;
}

double overlap(const Three& first, const Three& second, double u, double v) {
    const Three both = {first.uu + second.uu, first.uv + second.uv, first.vv + second.vv};
    const double area = std::max(both.area(), MIN_DIVISOR);
    const double distance = (both.vv * u * u - 2 * both.uv * u * v + both.uu * v * v) / area / area;
    const double large = std::max(first.area(), second.area()), small = std::min(first.area(), second.area());
    return small * std::min(large / area, 1.0) * std::exp(-0.5 * std::max(distance, 0.0));
}

Six six_of(const float* row) { return {row[0], row[1], row[2], row[3], row[4], row[5]}; }

void replace(const Replacing& r, int64_t pair) {
    const int64_t i = r.first[pair], j = r.second[pair], k = r.place[i];
    const Six ci = six_of(r.cov + 6 * i), cj = six_of(r.cov + 6 * j);
    const double ai = r.alphas[i], aj = r.alphas[j];
    const double mi = ai * ci.rms_area(), mj = aj * cj.rms_area(), total = mi + mj;
    const double wi = total > MIN_DIVISOR ? mi / total : 0.5, wj = 1 - wi, both = wi * wj;
    double apart[3];
    for (int d = 0; d < 3; ++d) {
        const double ui = r.means[3 * i + d], uj = r.means[3 * j + d];
        apart[d] = ui - uj;
        r.means_after[3 * k + d] = static_cast<float>(wi * ui + wj * uj);
    }
    const double x = apart[0], y = apart[1], z = apart[2];
    const Six cov = {wi * ci.a + wj * cj.a + both * (x * x), wi * ci.b + wj * cj.b + both * (x * y),
                     wi * ci.c + wj * cj.c + both * (x * z), wi * ci.d + wj * cj.d + both * (y * y),
                     wi * ci.e + wj * cj.e + both * (y * z), wi * ci.f + wj * cj.f + both * (z * z)};
    double normal[3], u[3], v[3];
    thinnest_axis(cov, normal);
    plane_axes(normal, u, v);
    const auto projected = [&](const Six& c) { return Three{c.bilinear(u, u), c.bilinear(u, v), c.bilinear(v, v)}; };
    const Three si = projected(ci), sj = projected(cj), sk = projected(cov);
    const double along_u = x * u[0] + y * u[1] + z * u[2], along_v = x * v[0] + y * v[1] + z * v[2];
    const double mass = ai * si.area() + aj * sj.area() - ai * aj * overlap(si, sj, along_u, along_v);
    const double alpha = std::max(mass, 0.0) / std::max(sk.area(), MIN_DIVISOR);
    const double needed = alpha / r.max_opacity;
    const double growth = needed > 1.0 ? std::pow(std::min(needed, 4.0), r.growth_exponent) : 1.0;
    const double grown[6] = {cov.a, cov.b, cov.c, cov.d, cov.e, cov.f};
    for (int at = 0; at < 6; ++at)
        r.cov_after[6 * k + at] = static_cast<float>(std::min(std::max(grown[at] * growth, -1e30), 1e30));
    r.alphas_after[k] = static_cast<float>(std::min(alpha, r.max_opacity));
    const float share = static_cast<float>(wi), other = static_cast<float>(wj);
    for (int64_t axis = 0; axis < r.axes; ++axis)
        r.colours_after[r.axes * k + axis] = share * r.colours[r.axes * i + axis] + other * r.colours[r.axes * j + axis];
    r.weights_after[k] = share * r.weights[i] + other * r.weights[j];
    r.counts_after[k] = r.counts[i] + r.counts[j];
    r.shares[i] = share, r.shares[j] = 1 - share;
}

}  // namespace

extern "C" {

// Writes the keys of all pairs.
void pointsplat_pair_keys(const Matching* task, int64_t* next) {
    const Matching& m = *task;
    each_range(next, m.count, [&](int64_t, int64_t first, int64_t last) {
        const int64_t k = m.neighbours;
        for (int64_t i = first; i < last; ++i)
            for (int64_t slot = 0; slot < k; ++slot) {
                const int64_t at = k * i + slot, j = m.near[at];
                float cost = bounded(m.costs[at]);
                for (int64_t back = k * j; back < k * (j + 1); ++back)
                    if (m.near[back] == i) {
                        cost = j > i ? cost / 2 + bounded(m.costs[back]) / 2 : std::numeric_limits<float>::infinity();
                        break;
                    }
                int32_t bits;
                std::memcpy(&bits, &cost, sizeof(bits));
                const int64_t hash = at * 2654435761 & 0xFFFFFFFF;
                m.keys[at] = j != i && cost < std::numeric_limits<float>::infinity() ? static_cast<int64_t>(bits) << 32 | hash : NEVER;
            }
    });
}

// Writes the least key of each free Gaussian and free neighbours, and the neighbour.
void pointsplat_least_keys(const Matching* task, int64_t* next) {
    const Matching& m = *task;
    each_range(next, m.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            int64_t least = NEVER;
            for (int64_t at = m.neighbours * i; at < m.neighbours * (i + 1) && !m.taken[i]; ++at) {
                if (m.taken[m.near[at]]) m.keys[at] = NEVER;
                if (m.keys[at] < least) least = m.keys[at], m.partner[i] = m.near[at];
            }
            m.least[i] = least;
        }
    });
}

// Takes the pairs that are the cheapest for both of their members.
void pointsplat_take_pairs(const Matching* task) {
    const Matching& m = *task;
    std::copy_n(m.least, m.count, m.best);
    for (int64_t i = 0; i < m.count; ++i)
        for (int64_t at = m.neighbours * i; m.least[i] < NEVER && at < m.neighbours * (i + 1); ++at)
            m.best[m.near[at]] = std::min(m.best[m.near[at]], m.keys[at]);
    for (int64_t i = 0; i < m.count; ++i) {
        const int64_t key = m.least[i];
        if (key == NEVER || key != m.best[i] || key != m.best[m.partner[i]]) continue;
        const int64_t pair = (*m.pairs)++;
        m.first[pair] = i, m.second[pair] = m.partner[i], m.found[pair] = key;
        m.taken[i] = m.taken[m.partner[i]] = 1;
    }
}

// Writes the Gaussians that replace pairs.
void pointsplat_replace_pairs(const Replacing* task, int64_t* next) {
    each_range(next, task->count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t pair = first; pair < last; ++pair) replace(*task, pair);
    });
}

}  // extern "C"
