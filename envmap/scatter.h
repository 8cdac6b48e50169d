// What rises above a cap is cut into pieces smaller than a target pixel and scattered as energy,
// L dOmega over the exact Omega_j, so that none of it falls between the samples. A piece is a box
// on the target, shared between the pixels that it lies on.
#pragma once

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include <limits>

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

class Scatter {
 public:
  // `reach` is the farthest that a piece's corner may be from its middle, in target pixels.
  Scatter(const Source& source, const Projection& to, const Solid& target_solid,
          const Matrix& source_from_target, float reach)
      : source_(source),
        from_(source.projection),
        to_(to),
        target_solid_(target_solid),
        target_from_source_(source_from_target.transposed()),
        reach_(reach) {}

  // Cut hot cells up; before `settle`.
  void cut_up(const Index* hot, std::size_t count) {
    std::array<double, 3> energy{};
    for (std::size_t n = 0; n < count; ++n) {
      const auto one = above(hot[n]);
      for (std::size_t c = 0; c < 3; ++c) energy[c] += one[c];
    }
    energy_ = energy;
    for (std::size_t c = 0; c < 3; ++c)
      quantum_[c] = std::max(energy[c], std::numeric_limits<double>::min()) * 0x1p-60;
    constexpr std::size_t chunk = 256;
    std::vector<std::vector<Deposit>> parts((count + chunk - 1) / chunk);
    tbb::parallel_for(std::size_t(0), parts.size(), [&](std::size_t part) {
      cut_cells(hot + part * chunk, std::min(chunk, count - part * chunk), parts[part]);
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
    outside_ = {};
    for (const Deposit& d : deposits_) {
      if (d.pixel >= 0) break;
      for (std::size_t c = 0; c < 3; ++c) outside_[c] += double(d.energy[c]) * quantum_[c];
    }
  }

  // Of all cells.
  const std::array<double, 3>& energy() const { return energy_; }
  // What the target does not see, after all bands.
  const std::array<double, 3>& outside() const { return outside_; }

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
          outside_[c] += e;
      }
    }
  }

 private:
  // A piece of a hot cell: the pixel it lands on, or -1, and its share.
  struct Piece {
    Index pixel;
    float weight;
  };
  // A cell is cut into n x n; a piece is a box of these half sizes on the target.
  struct Cuts {
    int n = 0;  // 0: torn
    float wide = 0, high = 0;
  };
  // What one thread works with.
  struct Desk {
    Rays rays;
    Places at;
    float u[kBatch], v[kBatch];
    std::vector<Piece> pieces{};

    void cast(const Scatter& s, int n) {
      s.from_.unproject(u, v, n, rays);
      rays.turn(s.target_from_source_, n);
      s.to_.project(rays, n, at);
    }
  };

  // Energy above the cap.
  std::array<double, 3> above(Index k) const {
    const float* rgb = source_.rgb + 3 * k;
    const double share = (1 - base_share(rgb, source_.cap)) *
                         double(source_.solid(k % from_.width, k / from_.width));
    return {rgb[0] * share, rgb[1] * share, rgb[2] * share};
  }

  // Cells that land whole on one sheet are cut into n x n pieces at once, others again and again.
  void cut_cells(const Index* cells, std::size_t count, std::vector<Deposit>& deposits) const {
    thread_local Desk desk;
    constexpr std::size_t group = kBatch / 5;
    constexpr float e = 0.499f;
    constexpr float du[5] = {0, -e, e, -e, e}, dv[5] = {0, -e, -e, e, e};
    for (std::size_t first = 0; first < count; first += group) {
      const std::size_t n = std::min(group, count - first);
      for (std::size_t k = 0; k < n; ++k) {
        const Index cell = cells[first + k];
        for (std::size_t c = 0; c < 5; ++c) {
          desk.u[5 * k + c] = float(cell % from_.width) + du[c];
          desk.v[5 * k + c] = float(cell / from_.width) + dv[c];
        }
      }
      desk.cast(*this, int(5 * n));
      Cuts cuts[group];
      for (std::size_t k = 0; k < n; ++k) {
        float far = 0;
        for (int c = 0; c < 5; ++c) {
          const int i = int(5 * k) + c;
          const bool seen = desk.rays.jacobian[i] > 0 && desk.at.sheet[i] >= 0;
          far = most(far, seen ? apart(desk.at, int(5 * k), i) : std::numeric_limits<float>::max());
        }
        if (far <= 128 * reach_) cuts[k] = cuts_of(desk.at, int(5 * k), far);
      }
      for (std::size_t k = 0; k < n; ++k) {
        const Index cell = cells[first + k];
        const float x = float(cell % from_.width), y = float(cell / from_.width);
        desk.pieces.clear();
        if (cuts[k].n)
          cut_evenly(x, y, cuts[k], desk);
        else
          cut(x, y, 0.5f, 0, desk);
        deposit(cell, desk.pieces, deposits);
      }
    }
  }

  // From the middle and the corners of a cell that lands whole.
  Cuts cuts_of(const Places& at, int k, float far) const {
    const auto dx = [&](int a, int b) { return across(at.x[k + b] - at.x[k + a]); };
    const auto dy = [&](int a, int b) { return at.y[k + b] - at.y[k + a]; };
    float wide = 0, high = 0;
    for (int c = 1; c < 5; ++c) wide += std::abs(dx(0, c)) / 4, high += std::abs(dy(0, c)) / 4;
    const float area = std::abs(dx(1, 4) * dy(2, 3) - dx(2, 3) * dy(1, 4)) / 2;
    const int n = std::max(1, int(std::ceil(far / reach_)));
    // a box of the same area and about the same shape
    const float scale = wide * high > 0 ? std::sqrt(area / (4 * wide * high)) : 0.f;
    return {n, least(scale * wide / float(n), 0.5f), least(scale * high / float(n), 0.5f)};
  }

  // Where the point of a cell that was thrown lands: a pixel, or -1.
  Index landing(const Places& at, int k) const {
    if (at.sheet[k] < 0) return -1;
    const Cell c = to_.nearest(at.sheet[k], at.x[k], at.y[k]);
    return target_solid_(c.x, c.y) > 0 ? Index(c.y) * to_.width + c.x : -1;
  }

  // The two pixels that an interval lies on, and the share of the first.
  struct Share {
    int first, second;
    float weight;
  };
  static Share share(float x, float half) {
    const int first = int(std::floor(x - half + 0.5f)), second = int(std::floor(x + half + 0.5f));
    const float weight = first == second ? 1.f : (float(first) + 0.5f - x + half) / (2 * half);
    return {first, second, within(weight, 0.f, 1.f)};
  }

  void put(const Places& at, int k, float weight, const Cuts& cuts,
           std::vector<Piece>& pieces) const {
    const Index middle = landing(at, k);
    if (middle < 0) return pieces.push_back({-1, weight});
    const Share x = share(at.x[k], cuts.wide), y = share(at.y[k], cuts.high);
    for (const auto& [j, v] : {std::pair{y.first, y.weight}, std::pair{y.second, 1 - y.weight}})
      for (const auto& [i, u] : {std::pair{x.first, x.weight}, std::pair{x.second, 1 - x.weight}}) {
        if (!(u * v > 0)) continue;
        const Cell c = to_.nearest(at.sheet[k], float(i), float(j));
        const bool there = target_solid_(c.x, c.y) > 0;
        pieces.push_back({there ? Index(c.y) * to_.width + c.x : middle, u * v * weight});
      }
  }

  void cut_evenly(float x, float y, const Cuts& cuts, Desk& desk) const {
    const int n = cuts.n;
    const float size = 1 / float(n);
    int filled = 0;
    const auto land = [&] {
      desk.cast(*this, filled);
      for (int k = 0; k < filled; ++k)
        if (desk.rays.jacobian[k] > 0)
          put(desk.at, k, desk.rays.jacobian[k], cuts, desk.pieces);
      filled = 0;
    };
    for (int b = 0; b < n; ++b)
      for (int a = 0; a < n; ++a) {
        desk.u[filled] = x + (float(a) + 0.5f) * size - 0.5f;
        desk.v[filled] = y + (float(b) + 0.5f) * size - 0.5f;
        if (++filled == kBatch) land();
      }
    if (filled) land();
  }

  // The energy of a cell to the pixels of its pieces.
  void deposit(Index cell, std::vector<Piece>& pieces, std::vector<Deposit>& deposits) const {
    double total = 0;
    for (const Piece& piece : pieces) total += piece.weight;
    if (!(total > 0)) pieces.assign(1, {-1, 1.f}), total = 1;
    std::sort(pieces.begin(), pieces.end(),
              [](const Piece& a, const Piece& b) { return a.pixel < b.pixel; });
    const std::array<double, 3> energy = above(cell);
    for (std::size_t n = 0; n < pieces.size();) {
      const Index pixel = pieces[n].pixel;
      double share = 0;
      for (; n < pieces.size() && pieces[n].pixel == pixel; ++n) share += pieces[n].weight;
      Deposit d{pixel, {}};
      for (std::size_t c = 0; c < 3; ++c)
        d.energy[c] = std::int64_t(share / total * energy[c] / quantum_[c]);
      deposits.push_back(d);
    }
  }

  // Distance in target pixels, around the seam of a panorama; far where the sheets differ.
  float apart(const Places& p, int a, int b) const {
    if (p.sheet[a] != p.sheet[b]) return std::numeric_limits<float>::max();
    return std::max(std::abs(across(p.x[b] - p.x[a])), std::abs(p.y[b] - p.y[a]));
  }
  float across(float dx) const {
    const float w = float(to_.width);
    return to_.round() && std::abs(dx) > w / 2 ? dx - std::copysign(w, dx) : dx;
  }

  // Cut a cell that is torn into pieces small enough.
  void cut(float x, float y, float half, int depth, Desk& desk) const {
    const float e = half * 0.999f;
    const float u[5] = {x, x - e, x + e, x - e, x + e}, v[5] = {y, y - e, y - e, y + e, y + e};
    std::copy_n(u, 5, desk.u), std::copy_n(v, 5, desk.v);
    desk.cast(*this, 5);
    const Places& at = desk.at;
    const float jacobian = desk.rays.jacobian[0];
    const bool here = jacobian > 0, lands = here && at.sheet[0] >= 0;
    bool fine = depth > 0;  // at least four pieces
    for (int k = 1; depth < 7 && k < 5; ++k) {
      const bool ok = desk.rays.jacobian[k] > 0, in = ok && at.sheet[k] >= 0;
      if (ok != here || in != lands)
        fine = fine && depth >= 3;  // the rim of a lens: a few pieces suffice
      else if (in && apart(at, 0, k) > reach_)
        // at the edge of a cube's face small pieces fall on either side
        fine = fine && depth >= 4 && at.sheet[k] != at.sheet[0];
    }
    if (fine || depth >= 7) {
      if (here) desk.pieces.push_back({lands ? landing(at, 0) : -1, 4 * half * half * jacobian});
      return;
    }
    const float h = half / 2;
    cut(x - h, y - h, h, depth + 1, desk);
    cut(x + h, y - h, h, depth + 1, desk);
    cut(x - h, y + h, h, depth + 1, desk);
    cut(x + h, y + h, h, depth + 1, desk);
  }

  const Source& source_;
  const Projection& from_;
  const Projection& to_;
  const Solid& target_solid_;
  Matrix target_from_source_;
  float reach_;
  std::array<double, 3> quantum_{}, energy_{}, outside_{};
  std::vector<Deposit> deposits_;
};

}  // namespace envmap
