// The group that each member fits best, of its own and the nearest.
//
// regrouping.py calls this file where it was built; regrouping.py does the same in
// torch, says where the formula is from, and has the names that are used here. All of it is float64.

#include "lanes.h"

extern "C" {

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
