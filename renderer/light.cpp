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

// What each texel has above a share of the mean over the sphere, times its solid angle.
std::vector<float> power_above(float share_of_mean, const std::vector<float>& rgb, int h,
                               int w) {
  std::vector<double> solid_angle(h);  // of a texel of each row
  for (int y = 0; y < h; ++y) {
    solid_angle[y] = 2 * M_PI / w * (std::cos(M_PI * y / h) - std::cos(M_PI * (y + 1) / h));
  }
  std::vector<float> power(rgb.size() / 3);
  double sum = 0;
  for (size_t t = 0; t < power.size(); ++t) sum += mean(Vec3(&rgb[3 * t])) * solid_angle[t / w];
  const double level = sum / (4 * M_PI) * share_of_mean;
  for (size_t t = 0; t < power.size(); ++t) {
    power[t] = float(std::max(0.0, mean(Vec3(&rgb[3 * t])) - level) * solid_angle[t / w]);
  }
  return power;
}

std::vector<float> reordered(const std::vector<float>& x, const std::vector<uint32_t>& order) {
  std::vector<float> y(x.size());
  for (size_t k = 0; k < x.size(); ++k) y[k] = x[order[k]];
  return y;
}

using Pixel = Environment::Pixel;

Pixel pixel_of(Vec3 d, int h, int w) {
  const float lon = std::atan2(-d.x, d.z), lat = std::asin(std::clamp(-d.y, -1.0f, 1.0f));
  return {(lon / (2 * kPi) + 0.5f) * w - 0.5f, (lat / kPi + 0.5f) * h - 0.5f};
}

Vec3 direction_of(Pixel p, int h, int w) {
  const float lon = ((p.u + 0.5f) / w - 0.5f) * 2 * kPi, polar = (p.v + 0.5f) / h * kPi;
  const float r = std::sin(polar);
  return {-r * std::sin(lon), std::cos(polar), r * std::cos(lon)};
}

}  // namespace

Environment::Environment(const float* rgb, int h, int w)
    : h_(h),
      w_(w),
      rgb_(rgb, rgb + size_t(3) * h * w),
      probability_(power_above(1 + 1e-5f, rgb_, h, w)),  // rounding does not count as light
      whole_(power_above(0, rgb_, h, w)),
      order_(hilbert_order(h, w)),
      distribution_(reordered(probability_, order_)),
      power_(reordered(whole_, order_)) {
  const auto normalise = [](std::vector<float>& p, double sum) {
    for (float& v : p) v = sum > 0 ? float(v / sum) : 0.0f;
  };
  normalise(probability_, distribution_.sum());
  normalise(whole_, power_.sum());
}

Environment::Footprint Environment::footprint(float u, float v) const {
  v = std::clamp(v, 0.0f, float(h_ - 1));
  const int x = int(std::floor(u)), y = std::min(int(v), h_ - 1);
  const float a = u - x, b = v - y;
  const uint32_t x0 = x < 0 ? x + w_ : x, x1 = x + 1 < w_ ? x + 1 : 0;
  const uint32_t r0 = uint32_t(y) * w_, r1 = uint32_t(std::min(y + 1, h_ - 1)) * w_;
  return {{r0 + x0, r0 + x1, r1 + x0, r1 + x1},
          {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b}};
}

Vec3 Environment::radiance(Vec3 d) const {
  const Pixel p = pixel_of(d, h_, w_);
  const Footprint f = footprint(p.u, p.v);
  Vec3 sum;
  for (int k = 0; k < 4; ++k) sum += f.weight[k] * Vec3(&rgb_[3 * size_t(f.texel[k])]);
  return sum;
}

uint32_t Environment::texel_of(Vec3 d) const {
  const Pixel p = pixel_of(d, h_, w_);
  const int x = std::clamp(int(p.u + 0.5f), 0, w_ - 1);
  const int y = std::clamp(int(p.v + 0.5f), 0, h_ - 1);
  return uint32_t(y) * w_ + x;
}

Vec3 Environment::texel_direction(uint32_t t) const {
  return direction_of({float(t % w_), float(t / w_)}, h_, w_);
}

// The bilinear probability per texel area over the solid angle of that area.
float Environment::density_at(const std::vector<float>& probability, float u, float v) const {
  const Footprint f = footprint(u, v);
  float p = 0;
  for (int k = 0; k < 4; ++k) p += f.weight[k] * probability[f.texel[k]];
  const float r = std::sin((v + 0.5f) / h_ * kPi);
  return r > 0 ? p * w_ * h_ / (2 * kPi * kPi * r) : 0;
}

float Environment::density(Vec3 d) const {
  const Pixel p = pixel_of(d, h_, w_);
  return density_at(probability_, p.u, p.v);
}

// A texel by its probability, then a tent around it: the density is the bilinear map itself.
Environment::Sample Environment::sample(uint32_t bits, float v) const {
  return sample(distribution_, probability_, bits, v);
}

Environment::Sample Environment::sample_power(uint32_t bits, float v) const {
  return sample(power_, whole_, bits, v);
}

Environment::Sample Environment::sample(const Distribution& distribution,
                                        const std::vector<float>& probability, uint32_t bits,
                                        float v) const {
  const auto pick = distribution.sample(bits);
  const Pixel p = around(order_[pick.index], pick.rest, v);
  return {direction_of(p, h_, w_), density_at(probability, p.u, p.v), texel_at(p)};
}

Environment::Pixel Environment::around(uint32_t texel, float u, float v) const {
  const auto tent = [](float x) {
    return x < 0.5f ? std::sqrt(2 * x) - 1 : 1 - std::sqrt(2 - 2 * x);
  };
  Pixel p{float(texel % w_) + tent(u), float(texel / w_) + tent(v)};
  // beyond the first and last row's centres the map is constant up to the pole
  if (p.v < 0) p.v = -v;
  if (p.v > float(h_ - 1)) p.v = float(h_ - 1) + (1 - v);
  if (p.u < -0.5f) p.u += w_;
  if (p.u >= w_ - 0.5f) p.u -= w_;
  return p;
}

uint32_t Environment::texel_at(Pixel p) const {
  const int x = std::clamp(int(p.u + 0.5f), 0, w_ - 1);
  const int y = std::clamp(int(p.v + 0.5f), 0, h_ - 1);
  return uint32_t(y) * w_ + x;
}

Peaks::Peaks(const Environment& environment) : environment_(environment) {
  const int h = environment.h_, w = environment.w_;
  std::vector<double> row(h);  // each sums its own texels: the same on any number of threads
  tbb::parallel_for(0, h, [&](int y) {
    for (int x = 0; x < w; ++x) row[y] += mean(environment.texel(uint32_t(y) * w + x));
    row[y] *= environment.solid_angle(y);
  });
  level_ = kLevel * float(std::accumulate(row.begin(), row.end(), 0.0) / (4 * M_PI));
  std::vector<float> weight;
  for (const uint32_t t : environment.order_) {
    const float power = (mean(environment.texel(t)) - level_) * environment.solid_angle(t / w);
    if (!(power > 0)) continue;
    texels_.push_back(t);
    weight.push_back(power);
  }
  picks_ = Distribution(weight);
}

Peaks::Value Peaks::at(float u, float v) const {
  const Environment::Footprint f = environment_.footprint(u, v);
  Value value;
  for (int k = 0; k < 4; ++k) {
    const Vec3 L = environment_.texel(f.texel[k]);
    const float excess = std::max(0.0f, mean(L) - level_);
    if (excess == 0) continue;
    value.radiance += (f.weight[k] * share(L)) * L;
    value.power += f.weight[k] * excess * environment_.solid_angle(f.texel[k] / environment_.w_);
  }
  return value;
}

Vec3 Peaks::radiance(Vec3 d) const {
  const Environment::Pixel p = pixel_of(d, environment_.h_, environment_.w_);
  return at(p.u, p.v).radiance;
}

Peaks::Sample Peaks::sample(Pair u) const {
  const int h = environment_.h_, w = environment_.w_;
  const auto pick = picks_.sample(u.bits);
  const Environment::Pixel p = environment_.around(texels_[pick.index], pick.rest, u.y);
  const Value value = at(p.u, p.v);
  const float r = std::sin((p.v + 0.5f) / h * kPi);
  const float density = value.power / float(picks_.sum()) * w * h / (2 * kPi * kPi * r);
  return {direction_of(p, h, w), density, environment_.texel_at(p), value.radiance};
}

}  // namespace chromeball
