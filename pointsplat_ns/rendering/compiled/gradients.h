// Gradients of the ellipses and of the projection of Gaussians: shared by blending.cpp, projection.cpp and pictures.cpp.
// quadratics.py and ewa.py do the same in torch, explain the formulas, and have the names that are used here.

#pragma once

#include "camera.h"

namespace {

constexpr int MOMENTS = 6;  // w, w^2, dv, dv^2, w dv, 1

// From the moments of one Gaussian, a float each, or of eight to the gradients by what tiles are drawn from.
template <typename Number>
void moments_back(const Number* sum, Number xy, Number yy, Number det, Number alpha, Number (&mean2d)[2],
                  Number (&cov2d)[3], Number& by_det, Number& by_alpha) {
    const Number w = sum[0], ww = sum[1], v = sum[2], vv = sum[3], wv = sum[4], one = sum[5];
    const Number a = yy / det, r = xy / yy, d = 1.0f / yy;
    const Number grad_x = a * w, grad_a = -0.5f * ww, grad_r = a * wv, grad_d = -0.5f * vv;
    mean2d[0] = grad_x, mean2d[1] = d * v - r * grad_x;
    cov2d[0] = Number{}, cov2d[1] = grad_r * d, cov2d[2] = grad_a / det - (grad_r * r + grad_d * d) * d;
    by_det = -grad_a * a / det, by_alpha = one / alpha;
}

// Gradients by what a camera sees of up to eight Gaussians; project_back() makes ``alpha`` that by the opacity, and
// ``direction`` that by the mean.
struct Gradient {
    Lane mean2d[2], depth, cov2d[3], det, alpha, direction[3];
    Lane quat[4], std[3];  // of project_back()
};

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
void covariance_backward(const Camera& camera, const Shape& s, Lane opacity, Gradient& grad, Lane (&grad_p1)[3],
                         Lane (&grad_p2)[3]) {
    Lane grad_det0 = grad.det;
    if (camera.antialiased) {
        const Lane compensation = s.compensation(camera), through = 0.5f * grad.alpha * opacity / compensation;
        const Lane grad_ratio = s.ratio > camera.least_ratio ? through : ZERO;
        grad.alpha *= compensation;
        // 1 - det0 / det as blur / det: the difference has no digit left where the Gaussian is large
        grad_det0 += grad_ratio / s.det * (s.blur / s.det);
        grad.det -= grad_ratio * s.ratio / s.det;
    }
    const Lane gxx = 2.0f * (grad.cov2d[0] + camera.eps2d * grad.det), gxy = grad.cov2d[1];
    const Lane gyy = 2.0f * (grad.cov2d[2] + camera.eps2d * grad.det);
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

// From the gradients by what a camera sees to those by the Gaussians; adds those by the camera to ``sums``, if there are any.
void project_back(const Camera& camera, const Lanes& lanes, const Position& at, const Shape& s, Lane opacity, Gradient& grad,
                  double* sums) {
    Lane grad_p1[3], grad_p2[3];
    covariance_backward(camera, s, opacity, grad, grad_p1, grad_p2);

    // P = reach (R^T a), with reach = f s / z
    Lane grad_turned_a[3], grad_turned_b[3], grad_unit[4], grad_a[3], grad_b[3];
    for (int i = 0; i < 3; ++i) {
        const Lane along_x = grad_p1[i] * (camera.fx * at.rz), along_y = grad_p2[i] * (camera.fy * at.rz);
        grad.std[i] = s.longest[i] ? ZERO : s.turned_a[i] * along_x + s.turned_b[i] * along_y;
        grad_turned_a[i] = along_x * s.std[i], grad_turned_b[i] = along_y * s.std[i];
    }
    rotation_backward(s, grad_turned_a, grad_turned_b, grad_unit);
    for (int i = 0; i < 3; ++i)
        grad_a[i] = dot(s.rotation[i], grad_turned_a), grad_b[i] = dot(s.rotation[i], grad_turned_b);

    // x / z and y / z: once as the image position, once, where it is not clamped, in the Jacobian
    const auto& view = camera.near_view;
    const Lane by_tx = view[2][0] * grad_a[0] + view[2][1] * grad_a[1] + view[2][2] * grad_a[2];
    const Lane by_ty = view[2][0] * grad_b[0] + view[2][1] * grad_b[1] + view[2][2] * grad_b[2];
    const Lane grad_u = camera.fx * grad.mean2d[0] - (s.tx == at.slope_x ? by_tx : ZERO);
    const Lane grad_v = camera.fy * grad.mean2d[1] - (s.ty == at.slope_y ? by_ty : ZERO);
    const Lane along = at.slope_x * grad_u + at.slope_y * grad_v + dot(s.std, grad.std);
    const Lane grad_points[3] = {at.rz * grad_u, at.rz * grad_v, grad.depth - at.rz * along};
    for (int j = 0; j < 3; ++j)
        grad.direction[j] += view[0][j] * grad_points[0] + view[1][j] * grad_points[1] + view[2][j] * grad_points[2];
    if (sums) sum_camera(lanes, at, s, grad_points, grad_a, grad_b, grad.direction, sums);

    // a unit quaternion has no gradient along itself
    const Lane along_itself = dot(s.unit, grad_unit);
    for (int i = 0; i < 4; ++i) {
        const Lane across = (grad_unit[i] - s.unit[i] * along_itself) * s.inverse_length;
        grad.quat[i] = across < -LARGEST ? ZERO - LARGEST : across > LARGEST ? ZERO + LARGEST : across;  // NaN stays
    }
}

}  // namespace
