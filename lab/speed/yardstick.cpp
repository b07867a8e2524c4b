// A plain single-threaded rasterizer of 3D Gaussians in the classic design, forward and backward: what
// lab/speed/rasterizer.py compares with. Scalar code on one core, nothing of it is used by the package.
//
//   projection: EWA splatting, SH colours of degree 3, a square of `extent` standard deviations around each mean, or,
//               if that is 0, the tight box around the ellipse on which alpha falls to its threshold
//   binning:    16 x 16 tiles; one depth sort of the Gaussians, then a stable counting sort by tile
//   forward:    per pixel front to back, scalar exp, stopped when saturated; what was drawn is kept
//   backward:   per pixel back to front over what was drawn; sums per tile, then per Gaussian
//
// `boxes` turns the loops of blending inside out, which suits a CPU better: within a tile Gaussian by Gaussian, and
// for each only the pixels of its square or box.
//
// Formulas: Zwicker et al., "EWA Splatting" (2002); Kerbl et al., "3D Gaussian Splatting" (2023).

#include <torch/extension.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <numeric>
#include <string>
#include <utility>
#include <vector>

namespace {

constexpr int TILE = 16;
constexpr float SH0 = 0.28209479177387814f, SH1 = 0.4886025119029199f;
constexpr float SH2[3] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
constexpr float SH3[5] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f,
                          1.445305721320277f};

bool cpu_time = false;  // of the process, in place of wall time

double now() {
  if (cpu_time) return (double)std::clock() / CLOCKS_PER_SEC;
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

struct Settings {  // the thresholds, handed over so that both sides have the same ones
  float alpha_min, alpha_max, transmittance_min, eps2d, margin, near_plane, extent;
};

struct Camera {
  float R[3][3], t[3], centre[3];
  float fx, fy, cx, cy;
  int width, height;
};

struct Splat {  // what blending reads of a projected Gaussian
  float x, y, a, b, c, opacity, limit, r, g, bl, rx, ry;  // limit: the sigma at which alpha falls to alpha_min
};

struct SplatGrad {
  float x, y, a, b, c, opacity, r, g, bl;
};

struct Box {
  int x0, x1, y0, y1;  // tiles, end exclusive
};

struct Hit {
  uint32_t place;  // in the tile's list; with `boxes` that times 256, plus the pixel in the tile
  float alpha;
};

float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

void rotation_of(const float* q, float R[3][3]) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  R[0][0] = 1 - 2 * (y * y + z * z), R[0][1] = 2 * (x * y - w * z), R[0][2] = 2 * (x * z + w * y);
  R[1][0] = 2 * (x * y + w * z), R[1][1] = 1 - 2 * (x * x + z * z), R[1][2] = 2 * (y * z - w * x);
  R[2][0] = 2 * (x * z - w * y), R[2][1] = 2 * (y * z + w * x), R[2][2] = 1 - 2 * (x * x + y * y);
}

// Gradient of the unit quaternion from the gradient of its rotation matrix.
void rotation_backward(const float* q, const float G[3][3], float* grad) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  grad[0] = 2 * (x * (G[2][1] - G[1][2]) + y * (G[0][2] - G[2][0]) + z * (G[1][0] - G[0][1]));
  grad[1] = 2 * (y * (G[0][1] + G[1][0]) + z * (G[0][2] + G[2][0]) + w * (G[2][1] - G[1][2])) -
            4 * x * (G[1][1] + G[2][2]);
  grad[2] = 2 * (x * (G[0][1] + G[1][0]) + z * (G[1][2] + G[2][1]) + w * (G[0][2] - G[2][0])) -
            4 * y * (G[0][0] + G[2][2]);
  grad[3] = 2 * (x * (G[0][2] + G[2][0]) + y * (G[1][2] + G[2][1]) + w * (G[1][0] - G[0][1])) -
            4 * z * (G[0][0] + G[1][1]);
}

void sh_basis(const float* d, float* v) {
  const float x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
  v[0] = SH0, v[1] = -SH1 * y, v[2] = SH1 * z, v[3] = -SH1 * x;
  v[4] = SH2[0] * x * y, v[5] = -SH2[0] * y * z, v[6] = SH2[1] * (2 * zz - xx - yy);
  v[7] = -SH2[0] * x * z, v[8] = SH2[2] * (xx - yy);
  v[9] = -SH3[0] * y * (3 * xx - yy), v[10] = SH3[1] * x * y * z, v[11] = -SH3[2] * y * (4 * zz - xx - yy);
  v[12] = SH3[3] * z * (2 * zz - 3 * xx - 3 * yy), v[13] = -SH3[2] * x * (4 * zz - xx - yy);
  v[14] = SH3[4] * z * (xx - yy), v[15] = -SH3[0] * x * (xx - 3 * yy);
}

// Gradient of the direction, where g[k] is the gradient of basis value k.
void sh_backward(const float* d, const float* g, float* grad) {
  const float x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
  grad[0] = -SH1 * g[3] + SH2[0] * (y * g[4] - z * g[7]) - 2 * SH2[1] * x * g[6] + 2 * SH2[2] * x * g[8] -
            SH3[0] * (6 * x * y * g[9] + 3 * (xx - yy) * g[15]) + SH3[1] * y * z * g[10] +
            SH3[2] * (2 * x * y * g[11] - (4 * zz - 3 * xx - yy) * g[13]) - 6 * SH3[3] * x * z * g[12] +
            2 * SH3[4] * x * z * g[14];
  grad[1] = -SH1 * g[1] + SH2[0] * (x * g[4] - z * g[5]) - 2 * SH2[1] * y * g[6] - 2 * SH2[2] * y * g[8] +
            SH3[0] * (6 * x * y * g[15] - 3 * (xx - yy) * g[9]) + SH3[1] * x * z * g[10] +
            SH3[2] * (2 * x * y * g[13] - (4 * zz - xx - 3 * yy) * g[11]) - 6 * SH3[3] * y * z * g[12] -
            2 * SH3[4] * y * z * g[14];
  grad[2] = SH1 * g[2] - SH2[0] * (y * g[5] + x * g[7]) + 4 * SH2[1] * z * g[6] + SH3[1] * x * y * g[10] -
            8 * SH3[2] * z * (y * g[11] + x * g[13]) + SH3[3] * (6 * zz - 3 * xx - 3 * yy) * g[12] +
            SH3[4] * (xx - yy) * g[14];
}

// The chain from one Gaussian to its covariance in the image, shared by forward and backward.
struct Geometry {
  float p[3], rz, tx, ty;  // camera space; tx, ty = x / z, y / z inside the enlarged frustum
  bool free_x, free_y;     // not clamped
  float quat[4], length, R[3][3];
  float T1[3], T2[3];    // rows of J W
  float V[3][3];         // R S
  float P1[3], P2[3];    // rows of J W R S
  float xx, xy, yy, det;
};

bool geometry_of(const float* mean, const float* quat, const float* scale, const Camera& cam, const Settings& s,
                 Geometry& g) {
  for (int i = 0; i < 3; ++i) g.p[i] = dot3(cam.R[i], mean) + cam.t[i];
  if (g.p[2] <= s.near_plane) return false;
  g.rz = 1 / g.p[2];
  const float mx = s.margin * 0.5f * cam.width / cam.fx, my = s.margin * 0.5f * cam.height / cam.fy;
  const float rx = g.p[0] * g.rz, ry = g.p[1] * g.rz;
  g.tx = std::min((cam.width - cam.cx) / cam.fx + mx, std::max(-cam.cx / cam.fx - mx, rx));
  g.ty = std::min((cam.height - cam.cy) / cam.fy + my, std::max(-cam.cy / cam.fy - my, ry));
  g.free_x = g.tx == rx, g.free_y = g.ty == ry;
  g.length = std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
  for (int i = 0; i < 4; ++i) g.quat[i] = quat[i] / g.length;
  rotation_of(g.quat, g.R);
  for (int k = 0; k < 3; ++k) {
    g.T1[k] = cam.fx * g.rz * (cam.R[0][k] - g.tx * cam.R[2][k]);
    g.T2[k] = cam.fy * g.rz * (cam.R[1][k] - g.ty * cam.R[2][k]);
    for (int j = 0; j < 3; ++j) g.V[k][j] = g.R[k][j] * scale[j];
  }
  for (int j = 0; j < 3; ++j) {
    g.P1[j] = g.T1[0] * g.V[0][j] + g.T1[1] * g.V[1][j] + g.T1[2] * g.V[2][j];
    g.P2[j] = g.T2[0] * g.V[0][j] + g.T2[1] * g.V[1][j] + g.T2[2] * g.V[2][j];
  }
  g.xx = dot3(g.P1, g.P1) + s.eps2d, g.yy = dot3(g.P2, g.P2) + s.eps2d, g.xy = dot3(g.P1, g.P2);
  g.det = g.xx * g.yy - g.xy * g.xy;
  return g.det > 0;
}

}  // namespace

class Yardstick {
 public:
  Yardstick(std::vector<double> settings, bool boxes) : boxes_mode_(boxes) {
    TORCH_CHECK(settings.size() == 7, "expected 7 settings, got ", settings.size());
    s_ = {(float)settings[0], (float)settings[1], (float)settings[2], (float)settings[3],
          (float)settings[4], (float)settings[5], (float)settings[6]};
  }

  // Inputs as the package's rasterization takes them (float32, contiguous); `keep` stores what backward needs.
  std::pair<torch::Tensor, torch::Tensor> forward(torch::Tensor means, torch::Tensor quats, torch::Tensor scales,
                                                  torch::Tensor opacities, torch::Tensor sh, torch::Tensor viewmat,
                                                  torch::Tensor K, int width, int height, bool keep) {
    for (const auto& t : {means, quats, scales, opacities, sh, viewmat, K})
      TORCH_CHECK(t.is_contiguous() && t.scalar_type() == torch::kFloat32 && t.is_cpu(), "float32 on the CPU, please");
    TORCH_CHECK(sh.dim() == 3 && sh.size(1) == 16, "expected SH of degree 3");
    means_ = means, quats_ = quats, scales_ = scales, opacities_ = opacities, sh_ = sh;
    set_camera(viewmat, K, width, height);
    const double t0 = now();
    project();
    const double t1 = now();
    bin();
    const double t2 = now();
    auto image = torch::empty({height, width, 3}), through = torch::empty({height, width, 1});
    if (boxes_mode_)
      keep ? blend_boxes<true>(image, through) : blend_boxes<false>(image, through);
    else
      keep ? blend<true>(image, through) : blend<false>(image, through);
    const double t3 = now();
    seconds = {t1 - t0, t2 - t1, t3 - t2, 0, 0};
    return {image, through};
  }

  std::vector<torch::Tensor> backward(torch::Tensor grad_image, torch::Tensor grad_through) {
    TORCH_CHECK(grad_image.is_contiguous() && grad_through.is_contiguous(), "contiguous gradients, please");
    TORCH_CHECK(!hit_offsets_.empty(), "forward was not asked to keep what backward needs");
    const double t0 = now();
    grads_.assign(splats_.size(), SplatGrad{});
    (this->*(boxes_mode_ ? &Yardstick::blend_boxes_backward : &Yardstick::blend_backward))(
        grad_image.data_ptr<float>(), grad_through.data_ptr<float>());
    const double t1 = now();
    auto out = project_backward();
    seconds[3] = t1 - t0, seconds[4] = now() - t1;
    return out;
  }

  std::vector<double> seconds;  // projection, binning, blending, backward of blending, backward of projection

  // visible Gaussians, tile-Gaussian pairs, Gaussian-pixel pairs looked at, pairs drawn
  std::vector<int64_t> counts() const {
    return {(int64_t)ids_.size(), (int64_t)list_.size(), looked_at_, drawn_};
  }

 private:
  void set_camera(const torch::Tensor& viewmat, const torch::Tensor& K, int width, int height) {
    const float* v = viewmat.data_ptr<float>();
    const float* k = K.data_ptr<float>();
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) cam_.R[i][j] = v[4 * i + j];
      cam_.t[i] = v[4 * i + 3];
    }
    for (int j = 0; j < 3; ++j)
      cam_.centre[j] = -(cam_.R[0][j] * cam_.t[0] + cam_.R[1][j] * cam_.t[1] + cam_.R[2][j] * cam_.t[2]);
    cam_.fx = k[0], cam_.fy = k[4], cam_.cx = k[2], cam_.cy = k[5];
    cam_.width = width, cam_.height = height;
    columns_ = (width + TILE - 1) / TILE, rows_ = (height + TILE - 1) / TILE;
  }

  void project() {
    const float *means = means_.data_ptr<float>(), *quats = quats_.data_ptr<float>();
    const float *scales = scales_.data_ptr<float>(), *opacities = opacities_.data_ptr<float>();
    const float* sh = sh_.data_ptr<float>();
    ids_.clear(), splats_.clear(), boxes_.clear(), depths_.clear(), clipped_.clear();
    Geometry g;
    for (int64_t i = 0; i < means_.size(0); ++i) {
      if (opacities[i] < s_.alpha_min) continue;
      if (!geometry_of(means + 3 * i, quats + 4 * i, scales + 3 * i, cam_, s_, g)) continue;
      const float x = cam_.fx * g.p[0] * g.rz + cam_.cx, y = cam_.fy * g.p[1] * g.rz + cam_.cy;
      const float mid = 0.5f * (g.xx + g.yy), half = 0.5f * (g.xx - g.yy);
      const float radius = std::ceil(s_.extent * std::sqrt(mid + std::sqrt(half * half + g.xy * g.xy)));
      const float level = 2 * std::log(opacities[i] / s_.alpha_min);
      const float rx = s_.extent > 0 ? radius : std::sqrt(level * g.xx), ry = s_.extent > 0 ? radius : std::sqrt(level * g.yy);
      auto tile = [](float at, int end) { return (int)std::floor(std::min((float)end, std::max(0.0f, at / TILE))); };
      const Box box{tile(x - rx, columns_), std::min(columns_, tile(x + rx, columns_) + 1),
                    tile(y - ry, rows_), std::min(rows_, tile(y + ry, rows_) + 1)};
      if (x + rx < 0 || y + ry < 0 || box.x0 >= box.x1 || box.y0 >= box.y1) continue;
      float d[3], basis[16], color[3];
      for (int k = 0; k < 3; ++k) d[k] = means[3 * i + k] - cam_.centre[k];
      const float length = std::sqrt(dot3(d, d));
      for (float& v : d) v /= length;
      sh_basis(d, basis);
      uint8_t clipped = 0;
      for (int c = 0; c < 3; ++c) {
        float sum = 0.5f;
        for (int k = 0; k < 16; ++k) sum += basis[k] * sh[48 * i + 3 * k + c];
        if (sum < 0) clipped |= 1 << c;
        color[c] = std::max(0.0f, sum);
      }
      const float o = opacities[i], r = 1 / g.det;
      splats_.push_back({x, y, g.yy * r, -g.xy * r, g.xx * r, o, std::log(o / s_.alpha_min) + 1e-4f, color[0],
                         color[1], color[2], rx, ry});
      ids_.push_back(i), boxes_.push_back(box), depths_.push_back(g.p[2]), clipped_.push_back(clipped);
    }
  }

  void bin() {
    std::vector<std::pair<float, int32_t>> order(splats_.size());
    for (size_t i = 0; i < order.size(); ++i) order[i] = {depths_[i], (int32_t)i};
    std::sort(order.begin(), order.end());
    offsets_.assign((size_t)columns_ * rows_ + 1, 0);
    for (const Box& b : boxes_)
      for (int y = b.y0; y < b.y1; ++y)
        for (int x = b.x0; x < b.x1; ++x) ++offsets_[y * columns_ + x + 1];
    std::partial_sum(offsets_.begin(), offsets_.end(), offsets_.begin());
    list_.resize(offsets_.back());
    std::vector<int64_t> next(offsets_.begin(), offsets_.end() - 1);
    for (const auto& [depth, i] : order) {
      const Box& b = boxes_[i];
      for (int y = b.y0; y < b.y1; ++y)
        for (int x = b.x0; x < b.x1; ++x) list_[next[y * columns_ + x]++] = i;
    }
  }

  template <bool keep>
  void blend(torch::Tensor image, torch::Tensor through) {
    float *out = image.data_ptr<float>(), *final = through.data_ptr<float>();
    const int width = cam_.width, height = cam_.height;
    hits_.clear(), hit_offsets_.clear();
    if (keep) hit_offsets_.reserve((size_t)width * height + 1), hit_offsets_.push_back(0);
    looked_at_ = drawn_ = 0;
    std::vector<Splat> local;
    for (int tile = 0; tile < rows_ * columns_; ++tile) {
      local.clear();
      for (int64_t k = offsets_[tile]; k < offsets_[tile + 1]; ++k) local.push_back(splats_[list_[k]]);
      const Splat* splats = local.data();
      const int count = (int)local.size(), x0 = tile % columns_ * TILE, y0 = tile / columns_ * TILE;
      for (int py = y0; py < std::min(height, y0 + TILE); ++py)
        for (int px = x0; px < std::min(width, x0 + TILE); ++px) {
          float T = 1, r = 0, g = 0, b = 0;
          int k = 0;
          for (; k < count; ++k) {
            const Splat& s = splats[k];
            const float dx = px + 0.5f - s.x, dy = py + 0.5f - s.y;
            const float sigma = 0.5f * (s.a * dx * dx + s.c * dy * dy) + s.b * dx * dy;
            if (sigma < 0 || sigma > s.limit) continue;
            const float alpha = std::min(s_.alpha_max, s.opacity * std::exp(-sigma));
            if (alpha < s_.alpha_min) continue;
            const float next = T * (1 - alpha);
            if (next <= s_.transmittance_min) break;
            const float weight = alpha * T;
            r += weight * s.r, g += weight * s.g, b += weight * s.bl;
            T = next;
            ++drawn_;
            if (keep) hits_.push_back({(uint32_t)k, alpha});
          }
          looked_at_ += std::min(count, k + 1);
          const int64_t at = (int64_t)py * width + px;
          out[3 * at] = r, out[3 * at + 1] = g, out[3 * at + 2] = b, final[at] = T;
          if (keep) hit_offsets_.push_back((int64_t)hits_.size());
        }
    }
    if (keep) final_ = through;
  }

  void blend_backward(const float* grad_image, const float* grad_through) {
    const float* final = final_.data_ptr<float>();
    const int width = cam_.width, height = cam_.height;
    std::vector<Splat> local;
    std::vector<SplatGrad> sums;
    size_t pixel = 0;
    for (int tile = 0; tile < rows_ * columns_; ++tile) {
      local.clear();
      for (int64_t k = offsets_[tile]; k < offsets_[tile + 1]; ++k) local.push_back(splats_[list_[k]]);
      sums.assign(local.size(), SplatGrad{});
      const int x0 = tile % columns_ * TILE, y0 = tile / columns_ * TILE;
      for (int py = y0; py < std::min(height, y0 + TILE); ++py)
        for (int px = x0; px < std::min(width, x0 + TILE); ++px, ++pixel) {
          const int64_t at = (int64_t)py * width + px;
          const float gr = grad_image[3 * at], gg = grad_image[3 * at + 1], gb = grad_image[3 * at + 2];
          float T = final[at];
          float behind = T * grad_through[at];  // what lies behind, times its gradient
          for (int64_t h = hit_offsets_[pixel + 1] - 1; h >= hit_offsets_[pixel]; --h) {
            const Hit hit = hits_[h];
            hit_backward(local[hit.place], hit.alpha, px + 0.5f, py + 0.5f, gr, gg, gb, T, behind, sums[hit.place]);
          }
        }
      add_sums(tile, local, sums);
    }
  }

  // One drawn pair: steps transmittance and what lies behind towards the front, and adds to the Gaussian's sums.
  void hit_backward(const Splat& s, float alpha, float x, float y, float gr, float gg, float gb, float& T,
                    float& behind, SplatGrad& sum) const {
    const float rest = 1 / (1 - alpha);
    T *= rest;
    const float weight = alpha * T, shade = s.r * gr + s.g * gg + s.bl * gb;
    sum.r += weight * gr, sum.g += weight * gg, sum.bl += weight * gb;
    const float grad_alpha = T * shade - behind * rest;
    behind += weight * shade;
    if (alpha >= s_.alpha_max) return;
    const float dx = x - s.x, dy = y - s.y, grad_log = alpha * grad_alpha;
    sum.opacity += grad_log;  // divided by the opacity when the tile is done
    sum.x += grad_log * (s.a * dx + s.b * dy), sum.y += grad_log * (s.b * dx + s.c * dy);
    sum.a -= 0.5f * grad_log * dx * dx, sum.b -= grad_log * dx * dy, sum.c -= 0.5f * grad_log * dy * dy;
  }

  void add_sums(int tile, const std::vector<Splat>& local, const std::vector<SplatGrad>& sums) {
    for (size_t k = 0; k < sums.size(); ++k) {
      SplatGrad& to = grads_[list_[offsets_[tile] + k]];
      const SplatGrad& from = sums[k];
      to.x += from.x, to.y += from.y, to.a += from.a, to.b += from.b, to.c += from.c;
      to.opacity += from.opacity / local[k].opacity, to.r += from.r, to.g += from.g, to.bl += from.bl;
    }
  }

  template <bool keep>
  void blend_boxes(torch::Tensor image, torch::Tensor through) {
    float *out = image.data_ptr<float>(), *final = through.data_ptr<float>();
    const int width = cam_.width, height = cam_.height;
    hits_.clear(), hit_offsets_.clear();
    if (keep) hit_offsets_.push_back(0);
    looked_at_ = drawn_ = 0;
    for (int tile = 0; tile < rows_ * columns_; ++tile) {
      const int x0 = tile % columns_ * TILE, y0 = tile / columns_ * TILE;
      const int x1 = std::min(width, x0 + TILE), y1 = std::min(height, y0 + TILE);
      float T[TILE * TILE], color[TILE * TILE][3] = {};
      bool done[TILE * TILE] = {};
      int open = (x1 - x0) * (y1 - y0);
      std::fill(T, T + TILE * TILE, 1.0f);
      for (int64_t k = offsets_[tile]; k < offsets_[tile + 1] && open > 0; ++k) {
        const Splat& s = splats_[list_[k]];
        auto from = [](float at, int low, int high) { return (int)std::min((float)high, std::max((float)low, at)); };
        const int px0 = from(std::ceil(s.x - s.rx - 0.5f), x0, x1);
        const int px1 = from(std::floor(s.x + s.rx + 0.5f), x0, x1);
        const int py0 = from(std::ceil(s.y - s.ry - 0.5f), y0, y1);
        const int py1 = from(std::floor(s.y + s.ry + 0.5f), y0, y1);
        for (int py = py0; py < py1; ++py) {
          const float dy = py + 0.5f - s.y, half_c = 0.5f * s.c * dy * dy;
          looked_at_ += px1 - px0;
          for (int px = px0; px < px1; ++px) {
            const float dx = px + 0.5f - s.x, sigma = half_c + dx * (0.5f * s.a * dx + s.b * dy);
            if (sigma < 0 || sigma > s.limit) continue;
            const int at = (py - y0) * TILE + px - x0;
            if (done[at]) continue;
            const float alpha = std::min(s_.alpha_max, s.opacity * std::exp(-sigma));
            if (alpha < s_.alpha_min) continue;
            const float next = T[at] * (1 - alpha);
            if (next <= s_.transmittance_min) {
              done[at] = true, --open;
              continue;
            }
            const float weight = alpha * T[at];
            color[at][0] += weight * s.r, color[at][1] += weight * s.g, color[at][2] += weight * s.bl;
            T[at] = next;
            ++drawn_;
            if (keep) hits_.push_back({(uint32_t)((k - offsets_[tile]) << 8 | at), alpha});
          }
        }
      }
      for (int py = y0; py < y1; ++py)
        for (int px = x0; px < x1; ++px) {
          const int64_t to = (int64_t)py * width + px, at = (py - y0) * TILE + px - x0;
          out[3 * to] = color[at][0], out[3 * to + 1] = color[at][1], out[3 * to + 2] = color[at][2];
          final[to] = T[at];
        }
      if (keep) hit_offsets_.push_back((int64_t)hits_.size());
    }
    if (keep) final_ = through;
  }

  void blend_boxes_backward(const float* grad_image, const float* grad_through) {
    const float* final = final_.data_ptr<float>();
    const int width = cam_.width, height = cam_.height;
    std::vector<Splat> local;
    std::vector<SplatGrad> sums;
    for (int tile = 0; tile < rows_ * columns_; ++tile) {
      local.clear();
      for (int64_t k = offsets_[tile]; k < offsets_[tile + 1]; ++k) local.push_back(splats_[list_[k]]);
      sums.assign(local.size(), SplatGrad{});
      const int x0 = tile % columns_ * TILE, y0 = tile / columns_ * TILE;
      float T[TILE * TILE], behind[TILE * TILE], grad[TILE * TILE][3];
      for (int py = y0; py < std::min(height, y0 + TILE); ++py)
        for (int px = x0; px < std::min(width, x0 + TILE); ++px) {
          const int64_t of = (int64_t)py * width + px, at = (py - y0) * TILE + px - x0;
          T[at] = final[of], behind[at] = T[at] * grad_through[of];
          for (int c = 0; c < 3; ++c) grad[at][c] = grad_image[3 * of + c];
        }
      for (int64_t h = hit_offsets_[tile + 1] - 1; h >= hit_offsets_[tile]; --h) {
        const Hit hit = hits_[h];
        const int k = hit.place >> 8, at = hit.place & 255;
        hit_backward(local[k], hit.alpha, x0 + at % TILE + 0.5f, y0 + at / TILE + 0.5f, grad[at][0], grad[at][1],
                     grad[at][2], T[at], behind[at], sums[k]);
      }
      add_sums(tile, local, sums);
    }
  }

  // Gradients of means, quats, scales, opacities and SH.
  std::vector<torch::Tensor> project_backward() {
    std::vector<torch::Tensor> out = {torch::zeros_like(means_), torch::zeros_like(quats_), torch::zeros_like(scales_),
                                      torch::zeros_like(opacities_), torch::zeros_like(sh_)};
    const float *means = means_.data_ptr<float>(), *quats = quats_.data_ptr<float>();
    const float *scales = scales_.data_ptr<float>(), *sh = sh_.data_ptr<float>();
    float *grad_means = out[0].data_ptr<float>(), *grad_quats = out[1].data_ptr<float>();
    float *grad_scales = out[2].data_ptr<float>(), *grad_opacities = out[3].data_ptr<float>();
    float* grad_sh = out[4].data_ptr<float>();
    Geometry g;
    for (size_t m = 0; m < ids_.size(); ++m) {
      const int64_t i = ids_[m];
      const SplatGrad& in = grads_[m];
      geometry_of(means + 3 * i, quats + 4 * i, scales + 3 * i, cam_, s_, g);
      grad_opacities[i] = in.opacity;

      // conic = cov^-1, so grad cov = -conic grad conic
      const float r = 1 / g.det, a = g.yy * r, b = -g.xy * r, c = g.xx * r, hb = 0.5f * in.b;
      const float l00 = a * in.a + b * hb, l01 = a * hb + b * in.c, l10 = b * in.a + c * hb, l11 = b * hb + c * in.c;
      const float gxx = -(l00 * a + l01 * b), gxy = -2 * (l00 * b + l01 * c), gyy = -(l10 * b + l11 * c);
      float dP1[3], dP2[3], dT1[3], dT2[3], dR[3][3];
      for (int j = 0; j < 3; ++j) {
        dP1[j] = 2 * gxx * g.P1[j] + gxy * g.P2[j];
        dP2[j] = 2 * gyy * g.P2[j] + gxy * g.P1[j];
      }
      for (int j = 0; j < 3; ++j) {
        float sum = 0;
        for (int k = 0; k < 3; ++k) {
          const float dV = g.T1[k] * dP1[j] + g.T2[k] * dP2[j];
          sum += dV * g.R[k][j];
          dR[k][j] = dV * scales[3 * i + j];
        }
        grad_scales[3 * i + j] = sum;
        dT1[j] = dot3(dP1, g.V[j]), dT2[j] = dot3(dP2, g.V[j]);
      }
      float dq[4];
      rotation_backward(g.quat, dR, dq);
      const float along = dq[0] * g.quat[0] + dq[1] * g.quat[1] + dq[2] * g.quat[2] + dq[3] * g.quat[3];
      for (int k = 0; k < 4; ++k) grad_quats[4 * i + k] = (dq[k] - along * g.quat[k]) / g.length;

      // camera space: through the mean's place, the focal scale f / z and the ratios x / z, y / z
      const float jx = cam_.fx * g.rz, jy = cam_.fy * g.rz;
      const float dtx = g.free_x ? -jx * dot3(dT1, cam_.R[2]) : 0, dty = g.free_y ? -jy * dot3(dT2, cam_.R[2]) : 0;
      const float du = in.x * cam_.fx + dtx, dv = in.y * cam_.fy + dty;
      const float dp[3] = {du * g.rz, dv * g.rz,
                           -g.rz * (g.rz * (du * g.p[0] + dv * g.p[1]) + dot3(dT1, g.T1) + dot3(dT2, g.T2))};

      float d[3], basis[16], grad_basis[16], grad_d[3];
      for (int k = 0; k < 3; ++k) d[k] = means[3 * i + k] - cam_.centre[k];
      const float length = std::sqrt(dot3(d, d));
      for (float& v : d) v /= length;
      sh_basis(d, basis);
      const float color[3] = {clipped_[m] & 1 ? 0 : in.r, clipped_[m] & 2 ? 0 : in.g, clipped_[m] & 4 ? 0 : in.bl};
      for (int k = 0; k < 16; ++k) {
        grad_basis[k] = dot3(color, sh + 48 * i + 3 * k);
        for (int ch = 0; ch < 3; ++ch) grad_sh[48 * i + 3 * k + ch] = basis[k] * color[ch];
      }
      sh_backward(d, grad_basis, grad_d);
      const float radial = dot3(grad_d, d);
      for (int k = 0; k < 3; ++k)
        grad_means[3 * i + k] = cam_.R[0][k] * dp[0] + cam_.R[1][k] * dp[1] + cam_.R[2][k] * dp[2] +
                                (grad_d[k] - radial * d[k]) / length;
    }
    return out;
  }

  bool boxes_mode_;
  Settings s_;
  Camera cam_;
  int columns_ = 0, rows_ = 0;
  torch::Tensor means_, quats_, scales_, opacities_, sh_, final_;
  std::vector<int64_t> ids_, offsets_, hit_offsets_;
  std::vector<Splat> splats_;
  std::vector<SplatGrad> grads_;
  std::vector<Box> boxes_;
  std::vector<float> depths_;
  std::vector<uint8_t> clipped_;
  std::vector<int32_t> list_;
  std::vector<Hit> hits_;
  int64_t looked_at_ = 0, drawn_ = 0;
};

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  m.def("use_cpu_time", [] { cpu_time = true; });
  pybind11::class_<Yardstick>(m, "Yardstick")
      .def(pybind11::init<std::vector<double>, bool>())
      .def("forward", &Yardstick::forward)
      .def("backward", &Yardstick::backward)
      .def("counts", &Yardstick::counts)
      .def_readonly("seconds", &Yardstick::seconds);
}
