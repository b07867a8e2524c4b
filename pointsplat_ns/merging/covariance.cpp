// Covariances of Gaussians of a scene.
//
// covariance.py calls this file where it was built; covariance.py does the same in torch, and
// says why. All of it is float64.

#include "lanes.h"

extern "C" {

struct Shapes {
    const float *log_scales, *quats;  // [N, 3], [N, 4]
    const int64_t* rows;              // [m] which of them
    int64_t count;                    // m
    double* cov;                      // [m, 6]
};

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

}  // extern "C"
