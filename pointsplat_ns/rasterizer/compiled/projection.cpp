// Projection of Gaussians into the image of one camera, for float32 on a CPU, and its gradient.
//
// projection.py calls this file where it was built; ewa.py does the same in torch,
// explains the formulas, and has the names that are used here. Threads take ranges of Gaussians of fixed size, and nothing
// is summed across ranges, so that the number of threads changes nothing.

#include "camera.h"

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

// Gradient by the unit quaternion, of a rotation with the gradient a grad_a^T + b grad_b^T.
void rotation_backward(const Shape& s, const Lane (&grad_a)[3], const Lane (&grad_b)[3], Lane (&out)[4]) {
    const auto entry = [&](int i, int j) { return s.a[i] * grad_a[j] + s.b[i] * grad_b[j]; };
    const Lane w = s.unit[0], x = s.unit[1], y = s.unit[2], z = s.unit[3];
    const Lane g00 = entry(0, 0), g11 = entry(1, 1), g22 = entry(2, 2);
    const Lane g01 = entry(0, 1), g10 = entry(1, 0), g02 = entry(0, 2);
    const Lane g20 = entry(2, 0), g12 = entry(1, 2), g21 = entry(2, 1);
    const Lane curl_x = g21 - g12, curl_y = g02 - g20, curl_z = g10 - g01;
    const Lane sum_xy = g01 + g10, sum_xz = g02 + g20, sum_yz = g12 + g21;
    out[0] = 2.0f * (x * curl_x + y * curl_y + z * curl_z);
    out[1] = 2.0f * (w * curl_x + y * sum_xy + z * sum_xz - 2.0f * x * (g11 + g22));
    out[2] = 2.0f * (w * curl_y + x * sum_xy + z * sum_yz - 2.0f * y * (g00 + g22));
    out[3] = 2.0f * (w * curl_z + x * sum_xz + y * sum_yz - 2.0f * z * (g00 + g11));
}

// Gradient of P = J W R S from that of the covariance and its determinant; that of the opacity in place.
void covariance_backward(const ProjectionGradient& task, const Lanes& lanes, const Lanes& rows, const Shape& s,
                         Lane& grad_alpha, Lane (&grad_p1)[3], Lane (&grad_p2)[3]) {
    const Camera& camera = task.camera;
    Lane grad_cov[3], grad_det = rows.load(task.grad_det), grad_det0 = grad_det;
    rows.load(task.grad_cov2d, grad_cov);
    if (camera.antialiased) {
        const Lane compensation = s.compensation(camera), opacity = lanes.load(task.scene.opacities);
        const Lane through = 0.5f * grad_alpha * opacity / compensation;
        const Lane grad_ratio = s.ratio > camera.least_ratio ? through : ZERO;
        grad_alpha *= compensation;
        // 1 - det0 / det as blur / det: the difference has no digit left where the Gaussian is large
        grad_det0 += grad_ratio / s.det * (s.blur / s.det);
        grad_det -= grad_ratio * s.ratio / s.det;
    }
    const Lane gxx = 2.0f * (grad_cov[0] + camera.eps2d * grad_det), gxy = grad_cov[1];
    const Lane gyy = 2.0f * (grad_cov[2] + camera.eps2d * grad_det);
    Lane normal[3], by_p1[3], by_p2[3];
    for (int i = 0; i < 3; ++i) normal[i] = s.normal[i] * (2.0f * grad_det0);
    cross(s.p2, normal, by_p1);
    cross(s.p1, normal, by_p2);
    for (int i = 0; i < 3; ++i) {
        grad_p1[i] = s.p1[i] * gxx + s.p2[i] * gxy + by_p1[i];
        grad_p2[i] = s.p2[i] * gyy + s.p1[i] * gxy - by_p2[i];
    }
}

void sum_camera(const Lanes& lanes, const Position& at, const Shape& s, const Lane (&grad_points)[3],
                const Lane (&grad_a)[3], const Lane (&grad_b)[3], const Lane (&grad_direction)[3], double* sums) {
    for (int j = 0; j < 3; ++j) {
        const Lane direction = narrow(at.direction[j]);
        const Lane parts[4] = {grad_points[0] * direction + grad_a[j], grad_points[1] * direction + grad_b[j],
                               grad_points[2] * direction - grad_a[j] * s.tx - grad_b[j] * s.ty, -grad_direction[j]};
        for (int i = 0; i < 4; ++i)
            for (int lane = 0; lane < lanes.count; ++lane) sums[3 * i + j] += parts[i][lane];
    }
}

// The gradients of up to eight Gaussians: ``lanes`` are their rows in the scene, ``rows`` in the output of the projection.
void differentiate_lanes(const ProjectionGradient& task, const Lanes& lanes, const Lanes& rows, double* sums) {
    const Camera& camera = task.camera;
    const Position at(camera, lanes, task.scene.means);
    const Shape s(camera, at, lanes, task.scene);
    Lane grad_alpha = rows.load(task.grad_opacities), grad_p1[3], grad_p2[3];
    covariance_backward(task, lanes, rows, s, grad_alpha, grad_p1, grad_p2);

    // P = reach (R^T a), with reach = f s / z
    Lane grad_std[3], grad_turned_a[3], grad_turned_b[3], grad_unit[4], grad_a[3], grad_b[3];
    for (int i = 0; i < 3; ++i) {
        const Lane along_x = grad_p1[i] * (camera.fx * at.rz), along_y = grad_p2[i] * (camera.fy * at.rz);
        grad_std[i] = s.longest[i] ? ZERO : s.turned_a[i] * along_x + s.turned_b[i] * along_y;
        grad_turned_a[i] = along_x * s.std[i], grad_turned_b[i] = along_y * s.std[i];
    }
    rotation_backward(s, grad_turned_a, grad_turned_b, grad_unit);
    for (int i = 0; i < 3; ++i)
        grad_a[i] = dot(s.rotation[i], grad_turned_a), grad_b[i] = dot(s.rotation[i], grad_turned_b);

    // x / z and y / z: once as the image position, once, where it is not clamped, in the Jacobian
    const auto& view = camera.near_view;
    Lane grad_mean2d[2], grad_direction[3];
    rows.load(task.grad_means2d, grad_mean2d);
    rows.load(task.grad_directions, grad_direction);
    const Lane by_tx = view[2][0] * grad_a[0] + view[2][1] * grad_a[1] + view[2][2] * grad_a[2];
    const Lane by_ty = view[2][0] * grad_b[0] + view[2][1] * grad_b[1] + view[2][2] * grad_b[2];
    const Lane grad_u = camera.fx * grad_mean2d[0] - (s.tx == at.slope_x ? by_tx : ZERO);
    const Lane grad_v = camera.fy * grad_mean2d[1] - (s.ty == at.slope_y ? by_ty : ZERO);
    const Lane along = at.slope_x * grad_u + at.slope_y * grad_v + dot(s.std, grad_std);
    const Lane grad_points[3] = {at.rz * grad_u, at.rz * grad_v, rows.load(task.grad_depths) - at.rz * along};
    for (int j = 0; j < 3; ++j)
        grad_direction[j] += view[0][j] * grad_points[0] + view[1][j] * grad_points[1] + view[2][j] * grad_points[2];
    if (sums) sum_camera(lanes, at, s, grad_points, grad_a, grad_b, grad_direction, sums);

    // a unit quaternion has no gradient along itself
    const Lane along_itself = dot(s.unit, grad_unit);
    for (int i = 0; i < 4; ++i) {
        const Lane grad = (grad_unit[i] - s.unit[i] * along_itself) * s.inverse_length;
        grad_unit[i] = grad < -LARGEST ? ZERO - LARGEST : grad > LARGEST ? ZERO + LARGEST : grad;  // NaN stays
    }
    lanes.store(task.means, grad_direction);
    lanes.store(task.quats, grad_unit);
    lanes.store(task.scales, grad_std);
    lanes.store(task.opacities, grad_alpha);
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
