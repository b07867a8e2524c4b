// Covariances of Gaussians of a scene, and the group that each member fits best, all of it float64.
//
// covariance.py and regrouping.py call this file where it was built. They do the same in torch, say why, and have the
// names that are used here.

#include "lanes.h"

extern "C" {

struct Shapes {
    const float *log_scales, *quats;  // [N, 3], [N, 4]
    const int64_t* rows;              // [m] which of them
    int64_t count;                    // m
    double* cov;                      // [m, 6]
};

struct Choice {
    const double *means, *cov;  // of the members: [n, 3], [n, 6]
    const float* colours;       // [n, 3]
    const int64_t* group;       // [n] the group of each
    const int32_t* near;        // [n, candidates] the nearest groups
    int64_t count, candidates;
    const double *group_means, *inverse, *log_determinants, *group_colours;  // [K, 3], [K, 6], [K], [K, 3]
    double colour_weight;
    int64_t* best;  // [n]
};

}  // extern "C"

namespace {

inline double fit_of(const Choice& c, int64_t i, int64_t g) {
    const double *cov = c.cov + 6 * i, *inverse = c.inverse + 6 * g;
    const double x = c.means[3 * i] - c.group_means[3 * g], y = c.means[3 * i + 1] - c.group_means[3 * g + 1];
    const double z = c.means[3 * i + 2] - c.group_means[3 * g + 2];
    double fit = (cov[0] + x * x) * inverse[0] + (cov[1] + x * y) * inverse[1] + (cov[2] + x * z) * inverse[2];
    fit += (cov[3] + y * y) * inverse[3] + (cov[4] + y * z) * inverse[4] + (cov[5] + z * z) * inverse[5];
    double contrast = 0.0;
    for (int channel = 0; channel < 3; ++channel) {
        const double apart = c.colours[3 * i + channel] - c.group_colours[3 * g + channel];
        contrast += apart * apart;
    }
    return 0.5 * (fit + c.log_determinants[g]) + contrast * c.colour_weight;
}

}  // namespace

extern "C" {

void pointsplat_covariances(const Shapes* task, int64_t* next) {
    const Shapes& s = *task;
    each_range(next, s.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            const int64_t soon = s.rows[std::min(i + 16, last - 1)];  // rows lie apart: memory is slower than arithmetic
            __builtin_prefetch(s.log_scales + 3 * soon), __builtin_prefetch(s.quats + 4 * soon);
            const float *logs = s.log_scales + 3 * s.rows[i], *q = s.quats + 4 * s.rows[i];
            double variances[3], longest = -40.0;
            for (int d = 0; d < 3; ++d) longest = std::max(longest, std::min<double>(logs[d], 40.0));
            for (int d = 0; d < 3; ++d)
                variances[d] = std::exp(2 * std::max(std::min<double>(logs[d], 40.0), std::max(-40.0, longest - 11.5)));
            double w = q[0], x = q[1], y = q[2], z = q[3];
            if (std::max(std::max(std::abs(q[0]), std::abs(q[1])), std::max(std::abs(q[2]), std::abs(q[3]))) < SHORTEST)
                w = 1, x = y = z = 0;
            const double length = std::sqrt(w * w + x * x + y * y + z * z);
            w /= length, x /= length, y /= length, z /= length;
            const double r[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                                    {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                                    {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
            double* cov = s.cov + 6 * i;
            for (int a = 0; a < 3; ++a)
                for (int b = a; b < 3; ++b)
                    *cov++ = r[a][0] * r[b][0] * variances[0] + r[a][1] * r[b][1] * variances[1] + r[a][2] * r[b][2] * variances[2];
        }
    });
}

void pointsplat_best_groups(const Choice* task, int64_t* next) {
    const Choice& c = *task;
    each_range(next, c.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            int64_t best = c.group[i];
            double least = fit_of(c, i, best);
            if (least != least) least = std::numeric_limits<double>::infinity();
            for (int64_t at = c.candidates * i; at < c.candidates * (i + 1); ++at) {
                const double fit = fit_of(c, i, c.near[at]);
                if (fit < least) least = fit, best = c.near[at];
            }
            c.best[i] = best;
        }
    });
}

}  // extern "C"
