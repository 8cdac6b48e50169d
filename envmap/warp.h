// Resampling that keeps the energy of small bright lights.
//
// The source is split into L = base + hot. `base` is gathered: L_j = sum_k L(R d_k) J_k / sum_k J_k
// over sub-samples of the target pixel's footprint. `hot`, what rises above a cap, is scattered.
#pragma once

#include <optional>

#include "scatter.h"

namespace envmap {

class Warp {
 public:
  Warp(const Source& source, const Projection& to, const Solid& target_solid, const Matrix& rotation,
       float typical, bool smooth, const float* variance)
      : source_(source),
        from_(source.projection),
        to_(to),
        target_solid_(target_solid),
        source_from_target_(rotation),
        typical_(typical),
        variance_(variance) {
    if (smooth) spline_.emplace(source);
  }

  void forget() {
    if (spline_) spline_->forget();
  }

  // Rows of the base.
  void gather(const Band& band) const {
    for_rows(band.first, band.last, [&](int y) {
      const Index row = Index(y - band.first) * to_.width;
      gather_row(y, band.radiance + 3 * row, band.coverage + row,
                 band.variance ? band.variance + 3 * row : nullptr);
    });
  }

  // Sums of a band that is settled.
  void add_up(const Band& band) const {
    for_rows(band.first, band.last, [&](int y) {
      const Index row = Index(y - band.first) * to_.width;
      const float *rgb = band.radiance + 3 * row, *seen = band.coverage + row;
      const float* omega = solids_of(y);
      double red = 0, green = 0, blue = 0, covered = 0;
#pragma omp simd reduction(+ : red, green, blue, covered)
      for (Index x = 0; x < to_.width; ++x) {
        const double w = double(omega[x]) * double(seen[x]);
        covered += w;
        red += w * double(rgb[3 * x]);
        green += w * double(rgb[3 * x + 1]);
        blue += w * double(rgb[3 * x + 2]);
      }
      double* sum = band.energy + 4 * (y - band.first);
      sum[0] = red, sum[1] = green, sum[2] = blue, sum[3] = covered;
    });
  }

 private:
  // The solid angles of a row of the target.
  const float* solids_of(int y) const {
    thread_local std::vector<float> row;
    row.resize(std::size_t(to_.width));
    target_solid_.row(y, row.data());
    return row.data();
  }

  struct Sampling {
    int across, down;
  };
  // Weights of source pixels in one target pixel, by an open hash.
  struct Weights {
    static constexpr std::size_t kSlots = 1 << 18;  // a pixel has at most 2^16 samples
    int pixel = -1;
    std::vector<Index> key{};
    std::vector<float> weight{};
    std::vector<std::size_t> used{};

    void add(Index cell, float w) {
      std::size_t slot = (std::size_t(cell) * 0x9E3779B97F4A7C15u) >> 46;
      while (key[slot] != cell && key[slot] >= 0) slot = (slot + 1) % kSlots;
      if (key[slot] < 0) {
        if (used.size() > kSlots / 2) throw std::length_error("a pixel sees too many pixels");
        key[slot] = cell, weight[slot] = 0, used.push_back(slot);
      }
      weight[slot] += w;
    }
    void open(int x) {
      if (key.empty()) key.assign(kSlots, -1), weight.resize(kSlots);
      for (const std::size_t slot : used) key[slot] = -1;
      used.clear();
      pixel = x;
    }
  };
  // What one row works with.
  struct Desk {
    Rays rays;
    Places places;
    float u[kBatch], v[kBatch];
    int pixel[kBatch];
    std::vector<double> sum;  // 5 a pixel: radiance, seen J, all J
    Weights weights;
  };

  // Sub-samples across and down the pixels of a row: so many that no source pixel is passed over.
  void samplings(int y, std::vector<Sampling>& result, Desk& desk) const {
    constexpr int group = kBatch / 5;
    constexpr float h = 0.499f;
    const float density = spline_ ? 1.5f : 1.6f, least_ = 2.f;
    const float* solids = solids_of(y);
    for (int first = 0; first < to_.width; first += group) {
      const int n = std::min(group, to_.width - first);
      for (int k = 0; k < n; ++k) {
        const float x = float(first + k);
        const float du[5] = {0, h, -h, 0, 0}, dv[5] = {0, 0, 0, h, -h};
        for (int c = 0; c < 5; ++c) desk.u[c * n + k] = x + du[c], desk.v[c * n + k] = float(y) + dv[c];
      }
      Rays& r = desk.rays;
      to_.unproject(desk.u, desk.v, 5 * n, r);
      float across[group], down[group];
      for (int k = 0; k < n; ++k) {
        const bool there = r.jacobian[n + k] > 0 && r.jacobian[2 * n + k] > 0 &&
                           r.jacobian[3 * n + k] > 0 && r.jacobian[4 * n + k] > 0;
        const float rough = 2 * std::sqrt(solids[first + k]);
        across[k] = there ? length(r.at(n + k) - r.at(2 * n + k)) : rough;
        down[k] = there ? length(r.at(3 * n + k) - r.at(4 * n + k)) : rough;
      }
      r.turn(source_from_target_, n);
      from_.project(r, n, desk.places);
      for (int k = 0; k < n; ++k) {
        const float solid = solids[first + k];
        float cell = typical_;
        if (r.jacobian[k] > 0 && desk.places.sheet[k] >= 0) {
          const Cell c = from_.nearest(desk.places.sheet[k], desk.places.x[k], desk.places.y[k]);
          if (const float there = source_.solid(c.x, c.y); there > 0) cell = there;
        }
        const float scale = density / std::sqrt(cell);
        float nx = within(scale * across[k], least_, 256.f);
        float ny = within(scale * down[k], least_, 256.f);
        // Stretched pixels on a diagonal: bound the work by what the area needs.
        const float bound = 16 * most(4.f, solid / cell);
        if (nx * ny > bound) {
          const float shrink = std::sqrt(bound / (nx * ny));
          nx = most(least_, nx * shrink);
          ny = most(least_, ny * shrink);
        }
        result[std::size_t(first + k)] = solid > 0
                                             ? Sampling{int(std::ceil(nx)), int(std::ceil(ny))}
                                             : Sampling{0, 0};
      }
    }
  }

  // Sample a of n across a pixel, -1/2 .. 1/2; two stand at Gauss's points, right for cubics.
  static float offset(int a, int n) {
    if (n == 2) return a ? 0.28867513f : -0.28867513f;
    return (float(a) + 0.5f) / float(n) - 0.5f;
  }

  void gather_row(int y, float* out, float* coverage, float* variance) const {
    thread_local Desk desk;
    thread_local std::vector<Sampling> counts;
    desk.sum.assign(5 * std::size_t(to_.width), 0.0);
    counts.resize(std::size_t(to_.width));
    samplings(y, counts, desk);
    int n = 0;
    for (int x = 0; x < to_.width; ++x) {
      const auto [nx, ny] = counts[std::size_t(x)];
      for (int b = 0; b < ny; ++b) {
        const float v = float(y) + offset(b, ny);
        for (int a = 0; a < nx; ++a) {
          desk.u[n] = float(x) + offset(a, nx);
          desk.v[n] = v;
          desk.pixel[n] = x;
          if (++n == kBatch) look(desk, n, variance), n = 0;
        }
      }
    }
    look(desk, n, variance);
    if (variance) close_pixel(desk, variance);
    for (int x = 0; x < to_.width; ++x) {
      double* s = &desk.sum[5 * std::size_t(x)];
      if (counts[std::size_t(x)].across && s[4] == 0) at_rim(x, y, desk, s);
      if (!(s[3] > 0)) continue;
      for (int c = 0; c < 3; ++c) out[3 * x + c] = float(std::max(s[c] / s[3], 0.0));
      coverage[x] = float(std::min(s[3] / s[4], 1.0));
    }
  }

  // The base at a place, and 1; zeros where unseen.
  Float4 base(const Places& p, int k) const {
    if (p.sheet[k] < 0) return Float4{};
    if (spline_) return (*spline_)(p.sheet[k], p.x[k], p.y[k]);
    return source_.base(from_.nearest(p.sheet[k], p.x[k], p.y[k]));
  }

  // Add a batch of samples to their pixels.
  void look(Desk& desk, int n, float* variance) const {
    if (n == 0) return;
    to_.unproject(desk.u, desk.v, n, desk.rays);
    desk.rays.turn(source_from_target_, n);
    from_.project(desk.rays, n, desk.places);
    for (int k = 0; k < n;) {
      const int x = desk.pixel[k];
      Float4 sum{};
      float all = 0;
      for (; k < n && desk.pixel[k] == x; ++k) {
        const float j = desk.rays.jacobian[k];
        if (j == 0) continue;
        all += j;
        sum += j * base(desk.places, k);
        if (variance) {
          if (desk.weights.pixel != x) close_pixel(desk, variance), desk.weights.open(x);
          weigh(desk.places, k, j, desk.weights);
        }
      }
      double* s = &desk.sum[5 * std::size_t(x)];
      for (int c = 0; c < 4; ++c) s[c] += sum[c];
      s[4] += all;
    }
  }

  // A sliver at a disc's rim that all sub-samples miss takes the radiance of the nearest point.
  void at_rim(int x, int y, Desk& desk, double* sum) const {
    if (to_.kind != Projection::Kind::radial) return;
    const float px = (float(x) - to_.cx) / to_.fx, py = (float(y) - to_.cy) / to_.fy;
    const float s = 0.99999f * to_.rim / std::sqrt(px * px + py * py);
    const float u = to_.cx + s * px * to_.fx, v = to_.cy + s * py * to_.fy;
    to_.unproject(&u, &v, 1, desk.rays);
    if (desk.rays.jacobian[0] == 0) return;
    sum[4] = 1;
    desk.rays.turn(source_from_target_, 1);
    from_.project(desk.rays, 1, desk.places);
    const Float4 value = base(desk.places, 0);
    for (int c = 0; c < 4; ++c) sum[c] = value[c];
  }

  // The weights that a sample gives to the source's pixels: those of its cell, or the spline's,
  // which reach over the inverse filter as far as it matters (0.361^4 squared is 3e-4).
  void weigh(const Places& p, int k, float j, Weights& weights) const {
    const int sheet = p.sheet[k];
    if (sheet < 0) return;
    const Cell own = from_.nearest(sheet, p.x[k], p.y[k]);
    if (!source_.usable(own)) return;
    if (!spline_) return weights.add(source_.index(own), j);
    const float t = spline_->limiter(sheet, p.x[k], p.y[k]);
    float u[10], v[10];
    Histospline::cardinal(p.x[k], u);
    Histospline::cardinal(p.y[k], v);
    const int x0 = int(std::floor(p.x[k])) - 4, y0 = int(std::floor(p.y[k])) - 4;
    float rest = 1 - t;  // of pixels that are not there
    for (int b = 0; b < 10; ++b)
      for (int a = 0; a < 10; ++a) {
        int x = x0 + a;
        if (from_.round()) x = (x % from_.width + from_.width) % from_.width;
        x = std::clamp(x, 0, from_.sheet_width() - 1);
        const Cell cell = from_.pixel(sheet, x, std::clamp(y0 + b, 0, from_.sheet_height() - 1));
        if (source_.usable(cell))
          weights.add(source_.index(cell), j * t * u[a] * v[b]);
        else
          rest += t * u[a] * v[b];
      }
    weights.add(source_.index(own), j * rest);
  }

  // Variances of independent pixels add up with the squares of their weights.
  void close_pixel(Desk& desk, float* variance) const {
    Weights& w = desk.weights;
    double sum[3]{}, all = 0;
    for (const std::size_t slot : w.used) {
      const double weight = w.weight[slot];
      all += weight;
      for (int c = 0; c < 3; ++c) sum[c] += weight * weight * variance_[3 * w.key[slot] + c];
    }
    if (all > 0)
      for (int c = 0; c < 3; ++c) variance[3 * w.pixel + c] = float(sum[c] / (all * all));
    w.open(-1);
  }

  const Source& source_;
  const Projection& from_;
  const Projection& to_;
  const Solid& target_solid_;
  Matrix source_from_target_;
  float typical_;
  const float* variance_;  // of the source, (H, W, 3)
  mutable std::optional<Histospline> spline_;
};

}  // namespace envmap
