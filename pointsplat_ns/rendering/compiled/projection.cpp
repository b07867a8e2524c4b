// Projection of Gaussians into the image of one camera, for float32 on a CPU, and its gradient.
//
// projection.py calls this file where it was built; ewa.py does the same in torch. Threads take ranges of Gaussians of
// fixed size, and nothing is summed across ranges, so that the number of threads changes nothing.

#include "camera.h"
#include "gradients.h"

extern "C" {

// A Gaussian that is drawn; projection.py takes rows of it apart.
struct Seen {
    double depth;
    int64_t id;
    float mean2d[2], z, cov2d[3], det, opacity, direction[3];
    int32_t radius;
};

struct Projection {
    Camera camera;
    Scene scene;
    Seen* seen;       // [N] each range's from where the range begins
    int64_t* counts;  // [ranges] how many
};

struct ProjectionGradient {
    Camera camera;
    Scene scene;
    const int64_t* ids;  // [M] ascending
    int64_t seen;        // M
    const float *grad_means2d, *grad_depths, *grad_cov2d, *grad_det, *grad_opacities, *grad_directions;  // null: zeros
    float *means, *quats, *scales, *opacities;  // as those of the scene; null where not wanted
    double* sums;                               // [ranges, 12] of view and centre; null where not wanted
};

}  // extern "C"
namespace {

Seen* project_lanes(const Projection& task, const Lanes& lanes, Seen* out) {
    const Camera& camera = task.camera;
    const Position at(camera, lanes, task.scene.means);
    const Flat flat(camera, at, Shape(camera, at, lanes, task.scene), lanes.load(task.scene.opacities));
    const Lane columns[11] = {flat.x, flat.y, at.z, flat.xx, flat.xy, flat.yy, flat.det, flat.alpha,
                              narrow(at.direction[0]), narrow(at.direction[1]), narrow(at.direction[2])};
    float values[11][LANES], radii[LANES];
    std::memcpy(values, columns, sizeof(columns));
    std::memcpy(radii, &flat.radius, sizeof(radii));
    for (int lane = 0; lane < lanes.count; ++lane) {
        if (!flat.drawn[lane]) continue;
        const auto value = [&](int column) { return values[column][lane]; };
        *out++ = {at.point[2][lane], lanes.rows[lane], {value(0), value(1)}, value(2), {value(3), value(4), value(5)},
                  value(6), value(7), {value(8), value(9), value(10)},
                  static_cast<int32_t>(std::min(std::ceil(radii[lane]), 1073741824.0f))};
    }
    return out;
}

// The gradients of up to eight Gaussians: ``lanes`` are their rows in the scene, ``rows`` in the output of the projection.
void differentiate_lanes(const ProjectionGradient& task, const Lanes& lanes, const Lanes& rows, double* sums) {
    const Position at(task.camera, lanes, task.scene.means);
    const Shape shape(task.camera, at, lanes, task.scene);
    Gradient grad;
    rows.load(task.grad_means2d, grad.mean2d);
    rows.load(task.grad_cov2d, grad.cov2d);
    rows.load(task.grad_directions, grad.direction);
    grad.depth = rows.load(task.grad_depths), grad.det = rows.load(task.grad_det);
    grad.alpha = rows.load(task.grad_opacities);
    project_back(task.camera, lanes, at, shape, lanes.load(task.scene.opacities), grad, sums);
    lanes.store(task.means, grad.direction);
    lanes.store(task.quats, grad.quat);
    lanes.store(task.scales, grad.std);
    lanes.store(task.opacities, grad.alpha);
}

}  // namespace

extern "C" {

int64_t pointsplat_range() { return RANGE; }

int64_t pointsplat_seen() { return sizeof(Seen); }

void pointsplat_project(const Projection* task, int64_t* next) {
    each_range(next, task->scene.count, [&](int64_t range, int64_t first, int64_t last) {
        int64_t candidates[RANGE];
        const int64_t number = find_candidates(task->camera, task->scene, first, last, candidates);
        Seen *begin = task->seen + first, *end = begin;
        for (int64_t at = 0; at < number; at += LANES) end = project_lanes(*task, Lanes(candidates + at, number - at), end);
        task->counts[range] = end - begin;
    });
}

void pointsplat_project_backward(const ProjectionGradient* task, int64_t* next) {
    const ProjectionGradient& t = *task;
    const auto clear = [](float* array, int64_t columns, int64_t first, int64_t last) {
        if (array) std::fill(array + first * columns, array + last * columns, 0.0f);
    };
    each_range(next, t.scene.count, [&](int64_t range, int64_t first, int64_t last) {
        clear(t.means, 3, first, last), clear(t.quats, 4, first, last);
        clear(t.scales, 3, first, last), clear(t.opacities, 1, first, last);
        double* sums = t.sums ? t.sums + 12 * range : nullptr;
        if (sums) std::fill(sums, sums + 12, 0.0);
        const int64_t *end = t.ids + t.seen, *from = std::lower_bound(t.ids, end, first);
        const int64_t* to = std::lower_bound(from, end, last);
        for (; from < to; from += LANES)
            differentiate_lanes(t, Lanes(from, to - from), Lanes(from - t.ids, to - from), sums);
    });
}

}  // extern "C"
