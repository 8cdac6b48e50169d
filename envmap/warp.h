// Resampling that keeps the energy of small bright lights.
//
// The source is split into L = base + hot. `base` is gathered: L_j = sum_k L(R d_k) J_k / sum_k J_k
// over sub-samples of the target pixel's footprint. `hot`, what rises above a cap, is cut into
// pieces smaller than a target pixel and scattered as energy, L dOmega over the exact Omega_j, so
// that none of it falls between the samples.
#pragma once

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include <limits>
#include <optional>

#include "source.h"

namespace envmap {

inline void for_rows(int first, int last, const auto& body) {
  tbb::parallel_for(tbb::blocked_range<int>(first, last), [&](const auto& rows) {
    for (int y = rows.begin(); y != rows.end(); ++y) body(y);
  });
}

// Rows of the result, from `first` on.
struct Band {
  int first, last;
  float* radiance;
  float* coverage;
  float* variance;  // null: not asked for
  double* energy;   // 4 a row: sums of L times the seen solid angle, and of that
};

// Energy that falls on a pixel, in quanta: integers do not depend on the order of addition.
struct Deposit {
  Index pixel;
  std::array<std::int64_t, 3> energy;
};

struct Tally {
  Index cells = 0;
  std::array<double, 3> outside{};
};

class Warp {
 public:
  Warp(const Source& source, const Projection& to, const Solid& target_solid, const Matrix& rotation,
       float typical, bool smooth, const float* variance)
      : source_(source),
        from_(source.projection),
        to_(to),
        target_solid_(target_solid),
        source_from_target_(rotation),
        target_from_source_(rotation.transposed()),
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

  // Cut the hot cells up; before `settle`.
  void scatter(const Index* hot, std::size_t count) {
    tally_ = {};
    tally_.cells = Index(count);
    std::array<double, 3> energy{};
    for (std::size_t n = 0; n < count; ++n)
      for (std::size_t c = 0; c < 3; ++c) energy[c] += above(hot[n], c);
    scattered_ = energy;
    for (std::size_t c = 0; c < 3; ++c)
      quantum_[c] = std::max(energy[c], std::numeric_limits<double>::min()) * 0x1p-60;
    constexpr std::size_t chunk = 256;
    std::vector<std::vector<Deposit>> parts((count + chunk - 1) / chunk);
    tbb::parallel_for(std::size_t(0), parts.size(), [&](std::size_t part) {
      std::vector<Piece> pieces;
      for (std::size_t n = part * chunk; n < std::min(count, (part + 1) * chunk); ++n)
        scatter_cell(hot[n], pieces, parts[part]);
    });
    deposits_.clear();
    std::size_t all = 0;
    for (const auto& part : parts) all += part.size();
    deposits_.reserve(all);
    for (auto& part : parts) {
      deposits_.insert(deposits_.end(), part.begin(), part.end());
      std::vector<Deposit>().swap(part);
    }
    tbb::parallel_sort(deposits_.begin(), deposits_.end(),
                       [](const Deposit& a, const Deposit& b) { return a.pixel < b.pixel; });
  }

  // Energy above the cap.
  const std::array<double, 3>& scattered() const { return scattered_; }

  // Add what falls on a band whose base is gathered.
  void settle(const Band& band) {
    const Index first = Index(band.first) * to_.width, last = Index(band.last) * to_.width;
    auto d = std::lower_bound(deposits_.begin(), deposits_.end(), first,
                              [](const Deposit& a, Index k) { return a.pixel < k; });
    while (d != deposits_.end() && d->pixel < last) {
      const Index k = d->pixel;
      std::array<std::int64_t, 3> sum{};
      for (; d != deposits_.end() && d->pixel == k; ++d)
        for (std::size_t c = 0; c < 3; ++c) sum[c] += d->energy[c];
      const double solid = target_solid_(k % to_.width, k / to_.width);
      const double seen = solid * band.coverage[k - first];
      for (std::size_t c = 0; c < 3; ++c) {
        const double e = double(sum[c]) * quantum_[c];
        if (seen > 0)
          band.radiance[3 * (k - first) + Index(c)] += float(e / seen);
        else
          tally_.outside[c] += e;
      }
    }
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

  // After all bands: hot energy that the target does not see.
  Tally tally() const {
    Tally result = tally_;
    for (const Deposit& d : deposits_) {
      if (d.pixel >= 0) break;
      for (std::size_t c = 0; c < 3; ++c) result.outside[c] += double(d.energy[c]) * quantum_[c];
    }
    return result;
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
  // A piece of a hot cell: the pixel it lands on, or -1, and its share.
  struct Piece {
    Index pixel;
    float weight;
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

  double above(Index k, std::size_t c) const {
    const float* rgb = source_.rgb + 3 * k;
    return double(rgb[c]) * (1 - base_share(rgb, source_.cap)) *
           double(source_.solid(k % from_.width, k / from_.width));
  }

  void scatter_cell(Index k, std::vector<Piece>& pieces, std::vector<Deposit>& deposits) const {
    pieces.clear();
    cut(float(k % from_.width), float(k / from_.width), 0.5f, 0, pieces);
    double total = 0;
    for (const Piece& piece : pieces) total += piece.weight;
    if (!(total > 0)) pieces.assign(1, {-1, 1.f}), total = 1;
    std::sort(pieces.begin(), pieces.end(),
              [](const Piece& a, const Piece& b) { return a.pixel < b.pixel; });
    for (std::size_t n = 0; n < pieces.size();) {
      const Index pixel = pieces[n].pixel;
      double share = 0;
      for (; n < pieces.size() && pieces[n].pixel == pixel; ++n) share += pieces[n].weight;
      Deposit d{pixel, {}};
      for (std::size_t c = 0; c < 3; ++c)
        d.energy[c] = std::int64_t(share / total * above(k, c) / quantum_[c]);
      deposits.push_back(d);
    }
  }

  // Distance in target pixels, around the seam of a panorama; far where the sheets differ.
  float apart(const Places& p, int a, int b) const {
    if (p.sheet[a] != p.sheet[b]) return std::numeric_limits<float>::max();
    float dx = std::abs(p.x[b] - p.x[a]);
    if (to_.round()) dx = std::min(dx, float(to_.width) - dx);
    return std::max(dx, std::abs(p.y[b] - p.y[a]));
  }

  // Cut a cell into pieces no larger than half a target pixel.
  void cut(float x, float y, float half, int depth, std::vector<Piece>& pieces) const {
    const float e = half * 0.999f;
    const float u[5] = {x, x - e, x + e, x - e, x + e}, v[5] = {y, y - e, y - e, y + e, y + e};
    thread_local Rays rays;
    thread_local Places at;
    from_.unproject(u, v, 5, rays);
    rays.turn(target_from_source_, 5);
    to_.project(rays, 5, at);
    const bool here = rays.jacobian[0] > 0, lands = here && at.sheet[0] >= 0;
    bool fine = depth > 0;  // at least four pieces
    for (int k = 1; depth < 7 && k < 5; ++k) {
      const bool ok = rays.jacobian[k] > 0, in = ok && at.sheet[k] >= 0;
      if (ok != here || in != lands)
        fine = fine && depth >= 3;  // the rim of a lens: a few pieces suffice
      else if (in && apart(at, 0, k) > 0.25f)
        // at the edge of a cube's face small pieces fall on either side
        fine = fine && depth >= 4 && at.sheet[k] != at.sheet[0];
    }
    if (fine || depth >= 7) {
      if (!here) return;
      Index pixel = -1;
      if (lands) {
        const Cell c = to_.nearest(at.sheet[0], at.x[0], at.y[0]);
        if (target_solid_(c.x, c.y) > 0) pixel = Index(c.y) * to_.width + c.x;
      }
      pieces.push_back({pixel, 4 * half * half * rays.jacobian[0]});
      return;
    }
    const float h = half / 2;
    cut(x - h, y - h, h, depth + 1, pieces);
    cut(x + h, y - h, h, depth + 1, pieces);
    cut(x - h, y + h, h, depth + 1, pieces);
    cut(x + h, y + h, h, depth + 1, pieces);
  }

  const Source& source_;
  const Projection& from_;
  const Projection& to_;
  const Solid& target_solid_;
  Matrix source_from_target_, target_from_source_;
  float typical_;
  const float* variance_;  // of the source, (H, W, 3)
  mutable std::optional<Histospline> spline_;
  std::array<double, 3> quantum_{}, scattered_{};
  std::vector<Deposit> deposits_;
  Tally tally_;
};

}  // namespace envmap
