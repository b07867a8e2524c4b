// What pairs cost, for float32 on a CPU.
//
// pair_cost.py calls this file where it was built. It does the same in torch, and has the formulas, the bounds and the
// names that are used here. A vector holds the neighbours of one Gaussian, eight at most.

#include "lanes.h"

extern "C" {

struct Planes {
    double axes[13][3][2];       // of the plane of each direction
    double to_plane[13][6][3];   // from a covariance to that of its projection
    int64_t triples[13][3];      // directions in which a Gaussian is compared that is largest in one
};

struct Costs {
    Planes planes;
    double background_decay, min_cover, max_opacity, growth_exponent;
    const float *means, *cov, *alphas;  // [n, 3], [n, 6], [n]
    const float *colours, *weights;     // [n, axes], [n]
    int64_t count, axes, neighbours;
    float* table;         // [n, 12] of pointsplat_projected
    const int32_t* near;  // [n, neighbours]
    float* costs;         // [n, neighbours]
};

}  // extern "C"

namespace {

constexpr int PLANES = 13;
constexpr int TABLE = 12;  // mean, covariance, opacity, squared length of the colour, direction
constexpr int MOST_AXES = 8;
constexpr double MOST = 1e3;  // bound of coordinates and of standard deviations
constexpr float ROUNDNESS = 1e-5, MIN_VARIANCE = 1e-6 * 1e-6, TINY = 1e-30;

struct Flat {
    Lane u, v, uu, uv, vv, area;
};

struct Plane {
    float axes[3][2], to_plane[6][3];

    explicit Plane(const Costs& c, int direction) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 2; ++j) axes[i][j] = static_cast<float>(c.planes.axes[direction][i][j]);
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 3; ++j) to_plane[i][j] = static_cast<float>(c.planes.to_plane[direction][i][j]);
    }
};

// Numbers of up to eight Gaussians.
struct Some {
    Lane mean[3], cov[6], alpha, squared_colour, colours[MOST_AXES];

    Some(const Costs& c, const int32_t* rows, int count) {
        float values[TABLE][LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const float* row = c.table + TABLE * static_cast<int64_t>(rows[std::min(lane, count - 1)]);
            for (int column = 0; column < TABLE; ++column) values[column][lane] = row[column];
        }
        std::memcpy(mean, values, sizeof(mean));
        std::memcpy(cov, values[3], sizeof(cov));
        std::memcpy(&alpha, values[9], sizeof(Lane));
        std::memcpy(&squared_colour, values[10], sizeof(Lane));
        float colour[MOST_AXES][LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const float* row = c.colours + c.axes * rows[std::min(lane, count - 1)];
            for (int axis = 0; axis < c.axes; ++axis) colour[axis][lane] = row[axis];
        }
        std::memcpy(colours, colour, c.axes * sizeof(Lane));
    }

    // Projections, with centres relative to ``from``.
    Flat on(const Plane& plane, const Lane (&from)[3]) const {
        Flat flat = {};
        for (int i = 0; i < 3; ++i) {
            const Lane apart = from[i] - mean[i];
            flat.u += apart * plane.axes[i][0], flat.v += apart * plane.axes[i][1];
        }
        for (int i = 0; i < 6; ++i) {
            flat.uu += cov[i] * plane.to_plane[i][0];
            flat.uv += cov[i] * plane.to_plane[i][1];
            flat.vv += cov[i] * plane.to_plane[i][2];
        }
        const Lane added = ROUNDNESS * (flat.uu + flat.vv) + MIN_VARIANCE;
        flat.uu += added, flat.vv += added;
        flat.area = root(larger(flat.uu * flat.vv - flat.uv * flat.uv, ZERO + TINY));
        return flat;
    }
};

inline Lane overlap_of_sum(Lane uu, Lane uv, Lane vv, Lane areas, Lane u, Lane v) {
    const Lane inverse = 1.0f / larger(uu * vv - uv * uv, ZERO + TINY);
    const Lane distance = larger(((vv * u - 2.0f * uv * v) * u + uu * v * v) * inverse, ZERO);
    return exp2_of(larger(distance * -0.72134752044f, ZERO - 125.0f)) * root(inverse) * areas;  // 0.5 log2 e
}

}  // namespace

extern "C" {

// Means and covariances within the bounds, and the direction in which each is largest.
void pointsplat_projected(const Costs* task, int64_t* next) {
    const Costs& c = *task;
    const double most = MOST * MOST;
    each_range(next, c.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            float* row = c.table + TABLE * i;
            for (int d = 0; d < 3; ++d) {
                const double at = c.means[3 * i + d];
                row[d] = static_cast<float>(std::min(std::max(at, -MOST), MOST));
            }
            double cov[6];
            for (int d = 0; d < 6; ++d) cov[d] = c.cov[6 * i + d];
            const double shrink = most / std::max(cov[0] + cov[3] + cov[5], most);
            for (int d = 0; d < 6; ++d) cov[d] *= shrink, row[3 + d] = static_cast<float>(cov[d]);
            int best = 0;
            double largest = -std::numeric_limits<double>::infinity();
            for (int direction = 0; direction < PLANES; ++direction) {
                double flat[3] = {};
                for (int d = 0; d < 6; ++d)
                    for (int e = 0; e < 3; ++e) flat[e] += cov[d] * c.planes.to_plane[direction][d][e];
                const double squared = flat[0] * flat[2] - flat[1] * flat[1];
                if (squared > largest) largest = squared, best = direction;
            }
            float squared_colour = 0.0f;
            for (int axis = 0; axis < c.axes; ++axis) {
                const float colour = c.colours[c.axes * i + axis];
                squared_colour += colour * colour;
            }
            row[9] = static_cast<float>(c.alphas[i]), row[10] = squared_colour, row[11] = static_cast<float>(best);
        }
    });
}

void pointsplat_pair_costs(const Costs* task, int64_t* next) {
    const Costs& c = *task;
    const float assumed = 3.0 * 0.01 * 0.01, hole = 3.0 * 0.3 * 0.3, min_cover = c.min_cover;
    const float max_opacity = c.max_opacity, exponent = c.growth_exponent, max_ratio = 4.0, max_growth = 100.0;
    const int neighbours = static_cast<int>(c.neighbours), axes = static_cast<int>(c.axes);
    each_range(next, c.count, [&](int64_t, int64_t first_row, int64_t last_row) {
        for (int64_t i = first_row; i < last_row; ++i) {
            const int32_t self = static_cast<int32_t>(i);
            const Some me(c, &self, 1), other(c, c.near + neighbours * i, neighbours);
            Lane same = ZERO, total = ZERO;  // <c_i, c_j>; costs of all directions
            for (int axis = 0; axis < axes; ++axis) same += me.colours[axis] * other.colours[axis];
            const int largest = static_cast<int>(c.table[TABLE * i + 11]);
            for (int d = 0; d < 3; ++d) {
                const Plane plane(c, static_cast<int>(c.planes.triples[largest][d]));
                const Flat first = me.on(plane, me.mean), second = other.on(plane, me.mean);
                const Lane u = second.u, v = second.v;
                const Lane overlaps = overlap_of_sum(
                    first.uu + second.uu, first.uv + second.uv, first.vv + second.vv, first.area * second.area, u, v);
                Lane on_first = other.alpha * overlaps / first.area, around[MOST_AXES];
                for (int lane = neighbours; lane < LANES; ++lane) on_first[lane] = 0.0f;
                float cover = 0.5f * me.alpha[0];
                for (int axis = 0; axis < axes; ++axis) around[axis] = cover * me.colours[axis];
                cover += sum(on_first);
                for (int axis = 0; axis < axes; ++axis) around[axis] += sum(on_first * other.colours[axis]);
                const float per_cover = 1.0f / std::max(cover, TINY);
                float rr = 0.0f, ir = 0.0f;
                Lane jr = ZERO;
                for (int axis = 0; axis < axes; ++axis) {
                    around[axis] *= per_cover;
                    rr += around[axis][0] * around[axis][0], ir += me.colours[axis][0] * around[axis][0];
                    jr += other.colours[axis] * around[axis];
                }
                const float ii = std::max(me.squared_colour[0] - 2.0f * ir + rr, 0.0f) + assumed;
                const float gii = 0.5f * me.alpha[0] * me.alpha[0] * first.area[0], mi = me.alpha[0] * first.area[0];
                const float counted = 1.0f / (std::max(cover, min_cover) * std::max(cover, min_cover));
                const float through = hole * std::exp(static_cast<float>(-c.background_decay) * cover);
                const Lane jj = larger(other.squared_colour - 2.0f * jr + rr, ZERO) + assumed;
                const Lane ij = same - jr + (rr - ir + assumed), both = me.alpha * other.alpha * overlaps;
                // the replacement
                const Lane mj = other.alpha * second.area;
                const Lane wi = mi / larger(mi + mj, ZERO + TINY), wj = 1.0f - wi, wu = wi * wj * u, wv = wi * wj * v;
                Lane uu = wu * u + wi * first.uu + wj * second.uu;
                Lane uv = wu * v + wi * first.uv + wj * second.uv;
                Lane vv = wv * v + wi * first.vv + wj * second.vv;
                Lane area = root(larger(uu * vv - uv * uv, ZERO + TINY));
                Lane alpha = larger(mi + mj - both, ZERO) / area;
                const Lane factor = each(alpha, [&](float value) {
                    return value > max_opacity ? std::pow(std::min(value / max_opacity, max_ratio), exponent) : 1.0f;
                });
                uu *= factor, uv *= factor, vv *= factor, area *= factor;
                alpha = smaller(alpha, ZERO + max_opacity);
                const Lane oik = overlap_of_sum(
                    first.uu + uu, first.uv + uv, first.vv + vv, first.area * area, wj * u, wj * v);
                const Lane ojk = overlap_of_sum(
                    second.uu + uu, second.uv + uv, second.vv + vv, second.area * area, wi * u, wi * v);
                // the changes
                const Lane ik = wi * ii + wj * ij, jk = wj * jj + wi * ij, kk = wi * ik + wj * jk;
                const Lane gjj = 0.5f * other.alpha * other.alpha * second.area, gkk = 0.5f * alpha * alpha * area;
                const Lane gij = 2.0f * both, gik = 2.0f * me.alpha * alpha * oik, gjk = 2.0f * other.alpha * alpha * ojk;
                const Lane colour = jj * gjj + ii * gii + kk * gkk + ij * gij - ik * gik - jk * gjk;
                const Lane shape = gjj + gii + gkk + gij - gik - gjk;
                const Lane growth = smaller(area / (first.area + second.area), ZERO + max_growth);
                const Lane change = larger(colour, ZERO) * counted + larger(shape, ZERO) * through;
                total += growth * growth * change;
            }
            for (int lane = 0; lane < neighbours; ++lane) c.costs[neighbours * i + lane] = total[lane] * c.weights[i];
        }
    });
}

}  // extern "C"
