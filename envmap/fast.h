// The fast way: one bilinear sample a pixel, at its centre. What that gains or loses of the base's
// energy is put right by one factor a channel, where both maps see the whole sphere; hot pixels are
// scattered as ever.
#pragma once

#include "warp.h"

namespace envmap {

class Fast {
 public:
  Fast(const Source& source, const Index* hot, std::size_t count)
      : source_(source),
        from_(source.projection),
        across_((from_.width >> kTile) + 1),
        special_(std::size_t(across_ * ((from_.height >> kTile) + 1))) {
    for (std::size_t k = 0; k < count; ++k)
      mark(hot[k] % from_.width, hot[k] / from_.width);
    if (source.solid.across == 0 && !source.valid) return;
    for (int y = 0; y < from_.height; ++y)
      for (int x = 0; x < from_.width; ++x)
        if (!source.usable({x, y})) mark(x, y);
  }

  // The base of all rows, and the sums of each row, (H, 3).
  void gather(const Projection& to, Solid solid, const Matrix& source_from_target,
              const Band& band) const {
    for_rows(0, to.height, [&](int y) {
      thread_local Rays rays;
      thread_local Places places;
      thread_local float u[kBatch], v[kBatch];
      double* sums = band.energy + 3 * Index(y);
      for (int first = 0; first < to.width; first += kBatch) {
        const int n = std::min(kBatch, to.width - first);
        for (int k = 0; k < n; ++k) u[k] = float(first + k), v[k] = float(y);
        to.unproject(u, v, n, rays);
        // at a disc's rim the nearest point stands for a centre that is outside
        if (to.kind == Projection::Kind::radial) std::fill_n(rays.jacobian, n, 1.f);
        rays.turn(source_from_target, n);
        from_.project(rays, n, places);
        const Index row = Index(y) * to.width + first;
        look(rays, places, n, solid.values + y * solid.down + first * solid.across, solid.across,
             band.radiance + 3 * row, band.coverage + row, sums);
      }
    });
  }

 private:
  static constexpr int kTile = 4;  // tiles of 16 x 16 pixels

  // The tiles from whose pixels a bilinear sample may look at this one are not plain.
  void mark(Index x, Index y) {
    for (Index v = std::max<Index>(y - 1, 0); v <= y; ++v)
      for (Index u = std::max<Index>(x - 1, 0); u <= x; ++u)
        special_[std::size_t((v >> kTile) * across_ + (u >> kTile))] = 1;
  }

  // Between four pixels, and 1: read as they are where nothing is hot, missing or at an edge.
  Float4 sample(int sheet, float px, float py) const {
    const float x = std::floor(px), y = std::floor(py), s = px - x, t = py - y;
    const int i = int(x), j = int(y);
    const Cell c = from_.pixel(sheet, i, j);
    const bool inner = (i >= 0) & (j >= 0) & (i < from_.sheet_width() - 1) &
                       (j < from_.sheet_height() - 1) & (c.y < from_.height - 2);
    if (inner && !special_[std::size_t((c.y >> kTile) * across_ + (c.x >> kTile))]) {
      const float* p = source_.rgb + 3 * source_.index(c);
      const float* q = p + 3 * Index(from_.width);
      const Float4 a = load(p), b = load(q);
      const Float4 top = a + s * (load(p + 3) - a), low = b + s * (load(q + 3) - b);
      Float4 value = top + t * (low - top);
      value[3] = 1;
      return value;
    }
    const auto at = [&](int u, int v) { return source_.beyond(sheet, u, v); };
    return (1 - t) * ((1 - s) * at(i, j) + s * at(i + 1, j)) +
           t * ((1 - s) * at(i, j + 1) + s * at(i + 1, j + 1));
  }

  // Three channels and what follows.
  static Float4 load(const float* p) {
    typedef float Loose __attribute__((vector_size(16), aligned(4), may_alias));
    return *reinterpret_cast<const Loose*>(p);
  }

  void look(const Rays& rays, const Places& p, int n, const float* solid, Index across, float* out,
            float* coverage, double* sums) const {
    Float4 total{};
    for (int k = 0; k < n; ++k) {
      Float4 value{};
      if (p.sheet[k] >= 0 && rays.jacobian[k] > 0 && solid[k * across] > 0)
        value = sample(p.sheet[k], p.x[k], p.y[k]);
      const float seen = value[3];
      total += solid[k * across] * value;
      if (seen > 0 && seen < 1) value = value / seen;
      out[3 * k] = value[0], out[3 * k + 1] = value[1], out[3 * k + 2] = value[2];
      coverage[k] = seen;
    }
    for (int c = 0; c < 3; ++c) sums[c] += total[c];
  }

  const Source& source_;
  const Projection& from_;
  Index across_;
  std::vector<std::uint8_t> special_;
};

}  // namespace envmap
