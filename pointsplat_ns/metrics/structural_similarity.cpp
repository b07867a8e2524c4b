// Mean structural similarity of two images and its gradient by the first, for float32 on a CPU.
//
// structural_similarity.py says how it is defined, does the same in torch, and calls this file where
// it was built. Images are planes of rows whose neighbours along a row lie ``step`` numbers apart: one for
// planes of one channel, three where the channels of a pixel lie together. Threads take bands of rows, whose sums are
// added up afterwards, so that the number of threads changes nothing. A band is worked on in blocks of columns, of which
// the last eleven blurred rows stay in the fastest cache.

#include <algorithm>
#include <cstdint>
#include <cstring>

extern "C" {

struct Similarity {
    const float *image, *other;                // [planes, height, row]
    const float* window;                       // [11]
    int64_t planes, height, row, step, bands;  // bands of rows in a plane
    // Derivatives of the similarity of a window by its means of the image, of its square and of the product:
    // [3, planes, height - 10, row - 10 step]; or null
    float* partials;
    double* sums;  // [planes * bands] of the similarities
    float* grad;   // as image, by the sum of all similarities; null forward
};

}  // extern "C"

namespace {

constexpr int LANES = 8, TAPS = 11, REACH = TAPS - 1, BLOCK = 128, MOST_STEP = 4, MARGIN = REACH * MOST_STEP;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

typedef float Lane __attribute__((vector_size(4 * LANES)));

inline Lane load(const float* from) {
    Lane lanes;
    std::memcpy(&lanes, from, sizeof(lanes));
    return lanes;
}

inline void store(float* to, Lane lanes) { std::memcpy(to, &lanes, sizeof(lanes)); }

// Numbers ``first`` to ``first + count`` of a row, zeros where it has none.
void load_row(const float* row, int64_t length, int64_t first, int count, float* out) {
    const int64_t from = std::clamp<int64_t>(first, 0, length), to = std::clamp<int64_t>(first + count, from, length);
    std::fill_n(out, count, 0.0f);
    if (to > from) std::memcpy(out + (from - first), row + from, sizeof(float) * (to - from));
}

// The last blurred rows of some maps in a block of columns.
template <int MAPS>
struct Rows {
    float rows[TAPS][MAPS][BLOCK];

    // Blurs a row along itself; the window begins ``step`` numbers after another with each tap.
    void blur_along(int64_t at, int map, const float* from, const float* window, int64_t step) {
        float* out = rows[at % TAPS][map];
        for (int j = 0; j < BLOCK; j += LANES) {
            Lane sum = window[0] * load(from + j);
            for (int tap = 1; tap < TAPS; ++tap) sum += window[tap] * load(from + j + tap * step);
            store(out + j, sum);
        }
    }

    void clear(int64_t at) { std::memset(rows[at % TAPS], 0, sizeof(rows[0])); }

    // Blurs across the last eleven rows, of which ``at`` is the last.
    Lane blur_across(int64_t at, int map, int j, const float* window) const {
        Lane sum = window[0] * load(rows[at % TAPS][map] + j);
        for (int tap = 1; tap < TAPS; ++tap) sum += window[tap] * load(rows[(at + TAPS - tap) % TAPS][map] + j);
        return sum;
    }
};

enum Map { IMAGE, OTHER, SQUARES, PRODUCT };

// The similarities of rows ``first`` to ``last`` and their derivatives, in a block of columns: their sum.
double forward_block(const Similarity& task, int64_t plane, int64_t first, int64_t last, int64_t column) {
    const int64_t windows = task.row - REACH * task.step, rows = task.height - REACH;
    const int count = static_cast<int>(std::min<int64_t>(BLOCK, windows - column));
    const int64_t size = task.planes * rows * windows;
    Rows<4> blurred;
    float in[4][BLOCK + MARGIN];
    double total = 0.0;
    for (int64_t y = first; y < last + REACH; ++y) {
        const int64_t place = (plane * task.height + y) * task.row;
        load_row(task.image + place, task.row, column, BLOCK + MARGIN, in[IMAGE]);
        load_row(task.other + place, task.row, column, BLOCK + MARGIN, in[OTHER]);
        for (int j = 0; j < BLOCK + MARGIN; j += LANES) {
            const Lane a = load(in[IMAGE] + j), b = load(in[OTHER] + j);
            store(in[SQUARES] + j, a * a + b * b);
            store(in[PRODUCT] + j, a * b);
        }
        for (int map = 0; map < 4; ++map) blurred.blur_along(y, map, in[map], task.window, task.step);
        if (y < first + REACH) continue;
        float values[4][BLOCK];  // similarities and their derivatives
        for (int j = 0; j < BLOCK; j += LANES) {
            const Lane mean = blurred.blur_across(y, IMAGE, j, task.window);
            const Lane other = blurred.blur_across(y, OTHER, j, task.window);
            const Lane product = mean * other, square = mean * mean + other * other;
            const Lane light = 2.0f * product + C1, light_sum = square + C1;
            const Lane contrast = 2.0f * (blurred.blur_across(y, PRODUCT, j, task.window) - product) + C2;
            const Lane contrast_sum = blurred.blur_across(y, SQUARES, j, task.window) - square + C2;
            const Lane shared = 1.0f / (light_sum * contrast_sum), similarity = light * contrast * shared;
            store(values[0] + j, similarity);
            store(values[1] + j, 2.0f * (other * (contrast - light) * shared +
                                         mean * similarity * (1.0f / contrast_sum - 1.0f / light_sum)));
            store(values[2] + j, -similarity / contrast_sum);
            store(values[3] + j, 2.0f * light * shared);
        }
        for (int j = 0; j < count; ++j) total += values[0][j];
        if (!task.partials) continue;
        float* out = task.partials + (plane * rows + y - REACH) * windows + column;
        for (int part = 0; part < 3; ++part) std::memcpy(out + part * size, values[1 + part], sizeof(float) * count);
    }
    return total;
}

// The gradient by the pixels of rows ``first`` to ``last``, in a block of columns.
void backward_block(const Similarity& task, int64_t plane, int64_t first, int64_t last, int64_t column) {
    const int64_t windows = task.row - REACH * task.step, rows = task.height - REACH;
    const int count = static_cast<int>(std::min<int64_t>(BLOCK, task.row - column));
    const int64_t size = task.planes * rows * windows;
    Rows<3> blurred;
    float in[BLOCK + MARGIN], image[BLOCK], other[BLOCK], grad[BLOCK];
    for (int64_t y = first - REACH; y < last; ++y) {
        const int64_t at = y + TAPS;  // not negative
        if (y < 0 || y >= rows) blurred.clear(at);
        else
            for (int part = 0; part < 3; ++part) {
                const float* row = task.partials + part * size + (plane * rows + y) * windows;
                load_row(row, windows, column - REACH * task.step, BLOCK + MARGIN, in);
                blurred.blur_along(at, part, in, task.window, task.step);
            }
        if (y < first) continue;
        const int64_t place = (plane * task.height + y) * task.row;
        load_row(task.image + place, task.row, column, BLOCK, image);
        load_row(task.other + place, task.row, column, BLOCK, other);
        for (int j = 0; j < BLOCK; j += LANES) {
            const Lane by_mean = blurred.blur_across(at, 0, j, task.window);
            const Lane by_square = blurred.blur_across(at, 1, j, task.window);
            const Lane by_product = blurred.blur_across(at, 2, j, task.window);
            store(grad + j, by_mean + 2.0f * load(image + j) * by_square + load(other + j) * by_product);
        }
        std::memcpy(task.grad + place + column, grad, sizeof(float) * count);
    }
}

}  // namespace

extern "C" {

// Sums of similarities and their derivatives, or the gradient if ``grad`` is there.
void pointsplat_similarity(const Similarity* task, int64_t* next) {
    const int64_t rows = task->grad ? task->height : task->height - REACH;
    const int64_t columns = task->grad ? task->row : task->row - REACH * task->step;
    for (;;) {
        const int64_t number = __atomic_fetch_add(next, 1, __ATOMIC_RELAXED);
        if (number >= task->planes * task->bands) return;
        const int64_t plane = number / task->bands, band = number % task->bands;
        const int64_t first = rows * band / task->bands, last = rows * (band + 1) / task->bands;
        double total = 0.0;
        for (int64_t column = 0; column < columns; column += BLOCK)
            if (task->grad) backward_block(*task, plane, first, last, column);
            else total += forward_block(*task, plane, first, last, column);
        if (!task->grad) task->sums[number] = total;
    }
}

}  // extern "C"
