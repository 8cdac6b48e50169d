#include "plate.h"

namespace chromeball {
namespace {

// The octahedral map of directions onto a square (Meyer et al. 2010).
struct Square {
  float x, y;  // -1..1
};

float sign(float v) { return std::copysign(1.0f, v); }

Square to_square(Vec3 d) {
  const float sum = std::abs(d.x) + std::abs(d.y) + std::abs(d.z);
  const Square s{d.x / sum, d.z / sum};
  if (d.y >= 0) return s;
  return {(1 - std::abs(s.y)) * sign(s.x), (1 - std::abs(s.x)) * sign(s.y)};
}

Vec3 from_square(Square s) {
  const float y = 1 - std::abs(s.x) - std::abs(s.y);
  if (y >= 0) return normalize({s.x, y, s.y});
  return normalize({(1 - std::abs(s.y)) * sign(s.x), y, (1 - std::abs(s.x)) * sign(s.y)});
}

}  // namespace

Plate::Plate(const PixelRays& rays, Vec3 eye, const float* rgb)
    : rays_(rays), eye_(eye), rgb_(rgb), starts_(kStarts * kStarts, Position{0, 0}) {
  struct Tried {
    Vec3 d;
    Position at;
  };
  std::vector<Tried> tried;
  for (int y = 0; y <= rays.height; y += std::min(kCoarse, rays.height)) {
    for (int x = 0; x <= rays.width; x += std::min(kCoarse, rays.width)) {
      const Vec3 d = corner(y, x);
      if (is_finite(d)) tried.push_back({normalize(d), {float(x), float(y)}});
    }
  }
  for (int k = 0; k < kStarts * kStarts; ++k) {
    const Vec3 d = from_square({2 * (k % kStarts + 0.5f) / kStarts - 1,
                                2 * (k / kStarts + 0.5f) / kStarts - 1});
    float nearest = -2;
    for (const Tried& t : tried) {
      const float cos = dot(t.d, d);
      if (cos > nearest) nearest = cos, starts_[k] = t.at;
    }
  }
}

// Newton's method on the rays of the corners, bilinear in between: any lens will do.
bool Plate::find(Vec3 d, Position& at) const {
  const Square s = to_square(d);
  const auto bucket = [](float v) {
    return std::clamp(int((0.5f * v + 0.5f) * kStarts), 0, kStarts - 1);
  };
  at = starts_[bucket(s.y) * kStarts + bucket(s.x)];
  const Frame across(d);
  for (int step = 0; step < 12; ++step) {
    const int x = std::clamp(int(at.x), 0, rays_.width - 1);
    const int y = std::clamp(int(at.y), 0, rays_.height - 1);
    const float u = at.x - x, v = at.y - y;
    const Vec3 a = corner(y, x), b = corner(y, x + 1), c = corner(y + 1, x),
               e = corner(y + 1, x + 1);
    const Vec3 D = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * e);
    if (!is_finite(D) || !(dot(D, d) > 0)) return false;
    const Vec3 along_x = (1 - v) * (b - a) + v * (e - c), along_y = (1 - u) * (c - a) + u * (e - b);
    const float xs = dot(along_x, across.s), xt = dot(along_x, across.t);
    const float ys = dot(along_y, across.s), yt = dot(along_y, across.t);
    const float s = dot(D, across.s), t = dot(D, across.t), area = xs * yt - ys * xt;
    const float dx = (ys * t - yt * s) / area, dy = (xt * s - xs * t) / area;
    if (!(std::abs(dx) + std::abs(dy) < 1e5f)) return false;
    at.x = std::clamp(at.x + dx, -1.0f, rays_.width + 1.0f);
    at.y = std::clamp(at.y + dy, -1.0f, rays_.height + 1.0f);
    if (std::abs(dx) + std::abs(dy) < 2e-3f) return true;
  }
  return false;
}

Plate::Seen Plate::at(Vec3 d) const {
  Position p;
  if (!find(d, p)) return {};
  const float inside = std::min(std::min(p.x, rays_.width - p.x), std::min(p.y, rays_.height - p.y));
  if (!(inside > 0)) return {};
  const auto near = [&](float dx, float dy) {
    return is_finite(corner(std::clamp(int(p.y + dy), 0, rays_.height),
                            std::clamp(int(p.x + dx), 0, rays_.width)));
  };
  for (const float k : {-kFeather, kFeather}) {  // the lens may be smaller than the picture
    if (!near(k, 0) || !near(0, k)) return {};
  }
  const float x = p.x - 0.5f, y = p.y - 0.5f;  // pixel centres at integers
  const int x0 = std::clamp(int(std::floor(x)), 0, rays_.width - 1);
  const int y0 = std::clamp(int(std::floor(y)), 0, rays_.height - 1);
  const int x1 = std::min(x0 + 1, rays_.width - 1), y1 = std::min(y0 + 1, rays_.height - 1);
  const float u = std::clamp(x - x0, 0.0f, 1.0f), v = std::clamp(y - y0, 0.0f, 1.0f);
  const Vec3 L = (1 - v) * ((1 - u) * pixel(y0, x0) + u * pixel(y0, x1)) +
                 v * ((1 - u) * pixel(y1, x0) + u * pixel(y1, x1));
  return {L, std::min(1.0f, inside / kFeather)};
}

}  // namespace chromeball
