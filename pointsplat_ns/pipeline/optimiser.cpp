// A step of Adam, for float32 on a CPU.
//
// optimiser.py calls this file where it was built, and does the same in torch. Threads take ranges of Gaussians, and
// nothing is summed, so that their number changes nothing.

#include <vector>

#include "lanes.h"

extern "C" {

// One parameter of ``count`` Gaussians, ``columns`` numbers each.
struct AdamStep {
    const float *values, *gradient;          // [K, columns]
    float *first, *second, *moved;           // as the values: averages of the gradient and of its square, new values
    const float* factors;                    // [K, kinds] of the rate, of which column ``kind`` counts; null for 1
    int64_t count, columns, kind, kinds;
    float rate, epsilon;
    float fresh, kept_square, fresh_square;  // weights of what is new and of what is kept
    float weight_sum, square_weight_sum;     // of the averages
};

}  // extern "C"

namespace {

void step(const AdamStep& task, int64_t size, const float* __restrict rates, const float* __restrict values,
          const float* __restrict gradient, float* __restrict first, float* __restrict second, float* __restrict moved) {
    const AdamStep t = task;
    const float over_sum = 1.0f / t.weight_sum, over_square_sum = 1.0f / t.square_weight_sum;
    for (int64_t i = 0; i < size; ++i) {
        const float g = gradient[i], mean = first[i] + t.fresh * (g - first[i]);
        const float square = t.kept_square * second[i] + t.fresh_square * g * g;
        first[i] = mean, second[i] = square;
        moved[i] = values[i] - rates[i] * (mean * over_sum) / (std::sqrt(square * over_square_sum) + t.epsilon);
    }
}

}  // namespace

extern "C" {

void pointsplat_adam(const AdamStep* task, int64_t* next) {
    const AdamStep& t = *task;
    std::vector<float> rates(RANGE * t.columns, t.rate);
    each_range(next, t.count, [&](int64_t, int64_t begin, int64_t end) {
        const int64_t from = begin * t.columns, size = end * t.columns - from;
        for (int64_t i = 0; t.factors && i < end - begin; ++i)
            std::fill_n(&rates[i * t.columns], t.columns, t.rate * t.factors[(begin + i) * t.kinds + t.kind]);
        step(t, size, rates.data(), t.values + from, t.gradient + from, t.first + from, t.second + from, t.moved + from);
    });
}

}  // extern "C"
