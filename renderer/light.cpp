#include "light.h"

#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include <numeric>

namespace chromeball {
namespace {

// Distance along the Hilbert curve of a 2^16 square.
uint32_t hilbert(uint32_t x, uint32_t y) {
  uint32_t d = 0;
  for (uint32_t s = 1u << 15; s > 0; s /= 2) {
    const uint32_t rx = (x & s) > 0, ry = (y & s) > 0;
    d += s * s * ((3 * rx) ^ ry);
    if (ry == 0) {
      if (rx == 1) x = 65535 - x, y = 65535 - y;
      std::swap(x, y);
    }
  }
  return d;
}

std::vector<uint32_t> hilbert_order(int h, int w) {
  std::vector<uint64_t> key(size_t(h) * w);
  tbb::parallel_for(0, h, [&](int y) {
    for (int x = 0; x < w; ++x) {
      const uint32_t t = uint32_t(y) * w + x;
      key[t] = uint64_t(hilbert(x, y)) << 32 | t;
    }
  });
  tbb::parallel_sort(key.begin(), key.end());
  std::vector<uint32_t> order(key.size());
  std::transform(key.begin(), key.end(), order.begin(), [](uint64_t k) { return uint32_t(k); });
  return order;
}

std::vector<float> row_solid_angles(int h, int w) {
  std::vector<float> angle(h);
  for (int y = 0; y < h; ++y) {
    angle[y] = float(2 * M_PI / w * (std::cos(M_PI * y / h) - std::cos(M_PI * (y + 1) / h)));
  }
  return angle;
}

// Mean over each texel of the bilinear picture's brightness, the tent 1/8, 6/8, 1/8.
std::vector<float> brightness(const std::vector<float>& rgb, int h, int w) {
  std::vector<float> b(size_t(h) * w);
  const auto at = [&](int y, int x) {
    y = std::clamp(y, 0, h - 1), x = (x + w) % w;
    return mean(Vec3(&rgb[3 * (size_t(y) * w + x)]));
  };
  tbb::parallel_for(0, h, [&](int y) {
    for (int x = 0; x < w; ++x) {
      float sum = 0;
      for (int j = -1; j <= 1; ++j) {
        for (int i = -1; i <= 1; ++i) {
          sum += (j ? 1.0f / 8 : 6.0f / 8) * (i ? 1.0f / 8 : 6.0f / 8) * at(y + j, x + i);
        }
      }
      b[size_t(y) * w + x] = sum;
    }
  });
  return b;
}

std::vector<float> ordered_power(const std::vector<float>& b,
                                 const std::vector<float>& solid_angle,
                                 const std::vector<uint32_t>& order, int w) {
  std::vector<float> power(order.size());
  for (size_t k = 0; k < order.size(); ++k) power[k] = b[order[k]] * solid_angle[order[k] / w];
  return power;
}

}  // namespace

Environment::Environment(const float* rgb, int h, int w)
    : h_(h),
      w_(w),
      rgb_(rgb, rgb + size_t(3) * h * w),
      density_(brightness(rgb_, h, w)),
      solid_angle_(row_solid_angles(h, w)),
      order_(hilbert_order(h, w)),
      distribution_(ordered_power(density_, solid_angle_, order_, w)) {
  const float scale = dark() ? 0.0f : float(1.0 / distribution_.sum());
  for (float& d : density_) d *= scale;  // p(omega) = L / sum(L Omega)
}

uint32_t Environment::texel_of(Vec3 d) const {
  const float lon = std::atan2(-d.x, d.z), lat = std::asin(std::clamp(-d.y, -1.0f, 1.0f));
  const int x = std::clamp(int((lon / (2 * kPi) + 0.5f) * w_), 0, w_ - 1);
  const int y = std::clamp(int((lat / kPi + 0.5f) * h_), 0, h_ - 1);
  return uint32_t(y) * w_ + x;
}

Vec3 Environment::radiance(Vec3 d) const {
  const float lon = std::atan2(-d.x, d.z), lat = std::asin(std::clamp(-d.y, -1.0f, 1.0f));
  const float u = (lon / (2 * kPi) + 0.5f) * w_ - 0.5f;
  const float v = std::clamp((lat / kPi + 0.5f) * h_ - 0.5f, 0.0f, float(h_ - 1));
  const int x = int(std::floor(u)), y = std::min(int(v), h_ - 1);
  const float a = u - x, b = v - y;
  const int x0 = x < 0 ? x + w_ : x, x1 = x0 + 1 < w_ ? x0 + 1 : 0, y1 = std::min(y + 1, h_ - 1);
  const size_t r0 = size_t(y) * w_, r1 = size_t(y1) * w_;
  const auto at = [&](size_t t) { return Vec3(&rgb_[3 * t]); };
  return (1 - b) * ((1 - a) * at(r0 + x0) + a * at(r0 + x1)) +
         b * ((1 - a) * at(r1 + x0) + a * at(r1 + x1));
}

Vec3 Environment::texel_direction(uint32_t t, float u, float v) const {
  const int x = t % w_, y = t / w_;
  const float lon = ((x + u) / w_ - 0.5f) * 2 * kPi;
  // uniform in solid angle: the height is uniform
  const float top = std::cos(kPi * y / h_), bottom = std::cos(kPi * (y + 1) / h_);
  const float up = top + v * (bottom - top);
  const float r = std::sqrt(std::max(0.0f, 1 - up * up));
  return {-r * std::sin(lon), up, r * std::cos(lon)};
}

Environment::Sample Environment::sample(uint32_t bits, float v) const {
  const auto pick = distribution_.sample(bits);
  const uint32_t t = order_[pick.index];
  return {texel_direction(t, pick.rest, v), density_[t], t};
}

}  // namespace chromeball
