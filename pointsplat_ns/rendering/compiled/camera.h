// Cameras, the projection of up to eight Gaussians, and which of them are drawn: shared by projection.cpp and
// pictures.cpp. ewa.py does the same in torch, explains the formulas, and has the names that are used here.

#pragma once

#include "lanes.h"

extern "C" {

// A camera: ewa.Lens, and numbers derived from it.
struct Camera {
    double view[3][3], centre[3];
    float near_view[3][3];  // view in float32
    float fx, fy, cx, cy, width, height, near_plane, far_plane, radius_clip, eps2d;
    float alpha_min, least_ratio;        // the square of the least compensation
    float steepness, longest;            // bound of |J| z, pixels; of a standard deviation / z
    float low_x, high_x, low_y, high_y;  // bounds of x / z and y / z in the Jacobian
    int64_t antialiased;
};

struct Scene {
    const float *means, *quats, *scales, *opacities;  // [N, 3], [N, 4], [N, 3], [N]
    int64_t count;
};

}  // extern "C"

namespace {
constexpr float LARGEST = std::numeric_limits<float>::max();

struct Position {
    Wide direction[3], point[3];  // from the camera's centre, along the axes of the world and of the camera
    Lane z, rz, slope_x, slope_y;

    Position(const Camera& camera, const Lanes& lanes, const float* means) {
        Lane mean[3];
        lanes.load(means, mean);
        for (int i = 0; i < 3; ++i) direction[i] = __builtin_convertvector(mean[i], Wide) - camera.centre[i];
        for (int i = 0; i < 3; ++i) {
            const double* row = camera.view[i];
            point[i] = row[0] * direction[0] + row[1] * direction[1] + row[2] * direction[2];
        }
        z = narrow(point[2]);
        rz = 1.0f / z;
        slope_x = narrow(point[0]) * rz, slope_y = narrow(point[1]) * rz;
    }
};

// The projected covariance and its intermediate values.
struct Shape {
    Lane tx, ty, unit[4], inverse_length, std[3], rotation[3][3];
    Mask longest[3];  // axes that are drawn shorter than they are
    Lane a[3], b[3], turned_a[3], turned_b[3], p1[3], p2[3], normal[3];
    Lane xx, xy, yy, det0, blur, det, ratio;  // xx and yy without eps2d

    Shape(const Camera& camera, const Position& at, const Lanes& lanes, const Scene& scene) {
        tx = clamp(at.slope_x, camera.low_x, camera.high_x), ty = clamp(at.slope_y, camera.low_y, camera.high_y);
        lanes.load(scene.quats, unit);
        lanes.load(scene.scales, std);
        inverse_length = normalise(unit);
        for (int i = 0; i < 3; ++i) {
            longest[i] = std[i] >= at.z * camera.longest;
            std[i] = smaller(std[i], at.z * camera.longest);
        }
        rotate();
        const auto& view = camera.near_view;
        for (int i = 0; i < 3; ++i) a[i] = view[0][i] - tx * view[2][i], b[i] = view[1][i] - ty * view[2][i];
        for (int j = 0; j < 3; ++j) {
            turned_a[j] = rotation[0][j] * a[0] + rotation[1][j] * a[1] + rotation[2][j] * a[2];
            turned_b[j] = rotation[0][j] * b[0] + rotation[1][j] * b[1] + rotation[2][j] * b[2];
            const Lane reach = std[j] * at.rz;
            p1[j] = turned_a[j] * reach * camera.fx, p2[j] = turned_b[j] * reach * camera.fy;
        }
        cross(p1, p2, normal);
        xx = dot(p1, p1), xy = dot(p1, p2), yy = dot(p2, p2);
        det0 = dot(normal, normal);
        blur = camera.eps2d * (xx + yy) + camera.eps2d * camera.eps2d;
        det = det0 + blur;
        ratio = det0 / det;
    }

    void rotate() {
        const Lane w = unit[0], x = unit[1], y = unit[2], z = unit[3], x2 = 2.0f * x, y2 = 2.0f * y, z2 = 2.0f * z;
        const Lane xx = x * x2, yy = y * y2, zz = z * z2, xy = x * y2, xz = x * z2, yz = y * z2;
        const Lane wx = w * x2, wy = w * y2, wz = w * z2;
        const Lane rows[3][3] = {{1.0f - (yy + zz), xy - wz, xz + wy},
                                 {xy + wz, 1.0f - (xx + zz), yz - wx},
                                 {xz - wy, yz + wx, 1.0f - (xx + yy)}};
        std::memcpy(rotation, rows, sizeof(rows));
    }

    Lane compensation(const Camera& camera) const { return root(larger(ratio, ZERO + camera.least_ratio)); }
};

// Writes the rows of Gaussians that may touch the image, by a bound on their extent that needs no covariance. Returns
// their number.
int64_t find_candidates(const Camera& camera, const Scene& scene, int64_t first, int64_t last, int64_t* out) {
    int64_t* end = out;
    for (int64_t at = first; at < last; at += LANES) {
        const Lanes lanes(at, last - at);
        const Position place(camera, lanes, scene.means);
        Lane scale[3];
        lanes.load(scene.scales, scale);
        const Lane opacity = lanes.load(scene.opacities), std = larger(larger(scale[0], scale[1]), scale[2]);
        // sqrt(2 ln 255) < 3.33 deviations
        const Lane reach = std * place.rz * (3.4f * camera.steepness) + 3.4f;
        const Lane x = place.slope_x * camera.fx + camera.cx, y = place.slope_y * camera.fy + camera.cy;
        Mask seen = (place.z > camera.near_plane) & (place.z < camera.far_plane) & (opacity >= camera.alpha_min);
        for (const Lane& value : scale) seen &= (value >= 0.0f) & (value < std::numeric_limits<float>::infinity());
        seen &= (x > -reach) & (x < camera.width + reach) & (y > -reach) & (y < camera.height + reach);
        for (int lane = 0; lane < lanes.count; ++lane) {
            *end = at + lane;
            end += seen[lane] & 1;
        }
    }
    return end - out;
}

// The ellipses of Gaussians in the image, and which of them are drawn.
struct Flat {
    Lane x, y, xx, xy, yy, det, alpha, log2_alpha, radius;  // xx and yy with eps2d
    Mask drawn;

    Flat(const Camera& camera, const Position& at, const Shape& shape, Lane opacity) {
        xx = shape.xx + camera.eps2d, xy = shape.xy, yy = shape.yy + camera.eps2d, det = shape.det;
        alpha = camera.antialiased ? opacity * shape.compensation(camera) : opacity;
        x = at.slope_x * camera.fx + camera.cx, y = at.slope_y * camera.fy + camera.cy;
        const Lane half = xx - yy, mid = 0.5f * (xx + yy);
        radius = 3.0f * root(mid + root(0.25f * (half * half) + xy * xy));
        // squared Mahalanobis distance of the 1/255 ellipse
        log2_alpha = each(alpha, [](float value) { return std::log2(value); });
        const Lane level = (log2_alpha - std::log2(camera.alpha_min)) * (2.0f * LN2);
        const Lane half_x = root(larger(level * xx, ZERO)), half_y = root(larger(level * yy, ZERO));
        drawn = (level > 0.0f) & is_finite(level) & is_finite(det) & (det > 0.0f);
        drawn &= (radius > camera.radius_clip) & is_finite(x) & is_finite(y);
        drawn &= (x + half_x >= 0.5f) & (x - half_x <= camera.width - 0.5f);
        drawn &= (y + half_y >= 0.5f) & (y - half_y <= camera.height - 0.5f);
    }
};

}  // namespace
