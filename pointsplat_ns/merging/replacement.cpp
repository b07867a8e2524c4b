// What pairs become, and the Gaussians that stay as they are.
//
// replacement.py calls this file where it was built. It and covariance.py do the same in torch,
// say where the formulas are from, and have the names that are used here. All of it is computed in float64, as there.

#include "lanes.h"

extern "C" {

struct Remaining {
    float *means, *cov, *alphas;  // [n, 3], [n, 6], [n]
    float *colours, *weights;     // [n, axes], [n]
    int32_t* counts;              // [n]
};

struct Replacing {
    Remaining before, after;
    const int64_t *source, *partner;  // [m] which Gaussian stays in each place, and which is merged into it; -1 for none
    int64_t count, axes;              // m
    double min_divisor, max_opacity, growth_exponent, max_growth_ratio;
    float* shares;  // [m] of the first member in the mass
};

}  // extern "C"

namespace {

struct Six {
    double xx, xy, xz, yy, yz, zz;
};

struct Vector {
    double x, y, z;
};

inline Six adjugate(const Six& m) {
    return {m.yy * m.zz - m.yz * m.yz, m.xz * m.yz - m.xy * m.zz, m.xy * m.yz - m.xz * m.yy,
            m.xx * m.zz - m.xz * m.xz, m.xy * m.xz - m.xx * m.yz, m.xx * m.yy - m.xy * m.xy};
}

inline Six square(const Six& m) {
    return {m.xx * m.xx + m.xy * m.xy + m.xz * m.xz, m.xx * m.xy + m.xy * m.yy + m.xz * m.yz,
            m.xx * m.xz + m.xy * m.yz + m.xz * m.zz, m.xy * m.xy + m.yy * m.yy + m.yz * m.yz,
            m.xy * m.xz + m.yy * m.yz + m.yz * m.zz, m.xz * m.xz + m.yz * m.yz + m.zz * m.zz};
}

inline double rms_area(const Six& cov) {
    const Six sides = adjugate(cov);
    return std::sqrt(std::max(sides.xx + sides.yy + sides.zz, 0.0) / 3.0);
}

inline double bilinear(const Six& m, const Vector& u, const Vector& v) {
    return u.x * (m.xx * v.x + m.xy * v.y + m.xz * v.z) + u.y * (m.xy * v.x + m.yy * v.y + m.yz * v.z) +
           u.z * (m.xz * v.x + m.yz * v.y + m.zz * v.z);
}

inline double dot(const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

inline Vector thinnest_axis(const Six& cov, double min_divisor) {
    Six m = adjugate(cov);
    for (int i = 0; i < 3; ++i) {
        const double scale = std::max(m.xx + m.yy + m.zz, min_divisor);
        m = square({m.xx / scale, m.xy / scale, m.xz / scale, m.yy / scale, m.yz / scale, m.zz / scale});
    }
    Vector column = {m.xx, m.xy, m.xz};
    double largest = m.xx;
    if (m.yy > largest) largest = m.yy, column = {m.xy, m.yy, m.yz};
    if (m.zz > largest) column = {m.xz, m.yz, m.zz};
    const double length = std::sqrt(dot(column, column));
    if (!(length > min_divisor)) return {0.0, 0.0, 1.0};
    return {column.x / length, column.y / length, column.z / length};
}

struct Flat {
    double uu, uv, vv;

    double area() const { return std::sqrt(std::max(uu * vv - uv * uv, 0.0)); }
};

inline double overlap(const Flat& first, const Flat& second, double u, double v, double min_divisor) {
    const Flat both = {first.uu + second.uu, first.uv + second.uv, first.vv + second.vv};
    const double area = std::max(both.area(), min_divisor), one = first.area(), other = second.area();
    const double distance = (both.vv * u * u - 2 * both.uv * u * v + both.uu * v * v) / area / area;
    const double within = std::min(std::max(one, other) / area, 1.0);
    return std::min(one, other) * within * std::exp(-0.5 * std::max(distance, 0.0));
}

inline Six load(const float* from) { return {from[0], from[1], from[2], from[3], from[4], from[5]}; }

// Writes a pair's mean, covariance and opacity, and gives the share of the first member.
double replace(const Replacing& r, int64_t i, int64_t j, int64_t place) {
    const Remaining& b = r.before;
    const Six si = load(b.cov + 6 * i), sj = load(b.cov + 6 * j);
    const double ai = b.alphas[i], aj = b.alphas[j], mi = ai * rms_area(si), mj = aj * rms_area(sj), total = mi + mj;
    const double wi = total > r.min_divisor ? mi / total : 0.5, wj = 1 - wi, both = wi * wj;
    const float *from = b.means + 3 * i, *to = b.means + 3 * j;
    const Vector apart = {double(from[0]) - to[0], double(from[1]) - to[1], double(from[2]) - to[2]};
    for (int d = 0; d < 3; ++d) r.after.means[3 * place + d] = static_cast<float>(wi * from[d] + wj * to[d]);
    const Six cov = {
        wi * si.xx + wj * sj.xx + both * (apart.x * apart.x), wi * si.xy + wj * sj.xy + both * (apart.x * apart.y),
        wi * si.xz + wj * sj.xz + both * (apart.x * apart.z), wi * si.yy + wj * sj.yy + both * (apart.y * apart.y),
        wi * si.yz + wj * sj.yz + both * (apart.y * apart.z), wi * si.zz + wj * sj.zz + both * (apart.z * apart.z)};
    const Vector n = thinnest_axis(cov, r.min_divisor);
    const double sign = n.z >= 0 ? 1.0 : -1.0, a = -1 / (sign + n.z), ab = n.x * n.y * a;
    const Vector u = {1 + sign * n.x * n.x * a, sign * ab, -sign * n.x}, v = {ab, sign + n.y * n.y * a, -n.y};
    const auto project = [&](const Six& six) { return Flat{bilinear(six, u, u), bilinear(six, u, v), bilinear(six, v, v)}; };
    const Flat pi = project(si), pj = project(sj);
    const double covered = ai * aj * overlap(pi, pj, dot(apart, u), dot(apart, v), r.min_divisor);
    const double mass = std::max(ai * pi.area() + aj * pj.area() - covered, 0.0);
    const double alpha = mass / std::max(project(cov).area(), r.min_divisor);
    const double needed = std::min(std::max(alpha / r.max_opacity, 1.0), r.max_growth_ratio);
    const double growth = needed > 1.0 ? std::pow(needed, r.growth_exponent) : 1.0;
    const double six[6] = {cov.xx, cov.xy, cov.xz, cov.yy, cov.yz, cov.zz};
    for (int d = 0; d < 6; ++d) r.after.cov[6 * place + d] = static_cast<float>(std::min(std::max(six[d] * growth, -1e30), 1e30));
    r.after.alphas[place] = static_cast<float>(std::min(alpha, r.max_opacity));
    return wi;
}

}  // namespace

extern "C" {

void pointsplat_replace(const Replacing* task, int64_t* next) {
    const Replacing& r = *task;
    const Remaining &b = r.before, &a = r.after;
    each_range(next, r.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t place = first; place < last; ++place) {
            const int64_t i = r.source[place], j = r.partner[place];
            if (j < 0) {
                std::copy_n(b.means + 3 * i, 3, a.means + 3 * place);
                std::copy_n(b.cov + 6 * i, 6, a.cov + 6 * place);
                std::copy_n(b.colours + r.axes * i, r.axes, a.colours + r.axes * place);
                a.alphas[place] = b.alphas[i], a.weights[place] = b.weights[i], a.counts[place] = b.counts[i];
                r.shares[place] = 1.0f;
                continue;
            }
            const double wi = replace(r, i, j, place);
            const float share = static_cast<float>(wi), other = static_cast<float>(1 - wi);
            for (int64_t axis = 0; axis < r.axes; ++axis)
                a.colours[r.axes * place + axis] = share * b.colours[r.axes * i + axis] + other * b.colours[r.axes * j + axis];
            a.weights[place] = share * b.weights[i] + other * b.weights[j];
            a.counts[place] = b.counts[i] + b.counts[j];
            r.shares[place] = share;
        }
    });
}

}  // extern "C"
