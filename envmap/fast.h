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
    if (!source.solid.holes && !source.valid) return;
    for (int y = 0; y < from_.height; ++y)
      for (int x = 0; x < from_.width; ++x)
        if (!source.usable({x, y})) mark(x, y);
  }

  // The base of all rows, and the sums of each row, (H, 3).
  void gather(const Projection& to, const Solid& solid, const Matrix& source_from_target,
              const Band& band) const {
    for_rows(0, to.height, [&](int y) {
      thread_local Rays rays;
      thread_local Places places;
      thread_local float u[kBatch], v[kBatch];
      thread_local std::vector<float> solids;
      solids.resize(std::size_t(to.width));
      solid.row(y, solids.data());
      double* sums = band.energy + 4 * Index(y);
      constexpr int batch = 128;
      for (int first = 0; first < to.width; first += batch) {
        const int n = std::min(batch, to.width - first);
        const Index row = Index(y) * to.width + first;
        const float* omega = solids.data() + first;
        if (!solid.even && std::all_of(omega, omega + n, [](float o) { return !(o > 0); })) {
          std::fill_n(band.radiance + 3 * row, 3 * n, 0.f);  // beside the cross, around the disc
          std::fill_n(band.coverage + row, n, 0.f);
          continue;
        }
        for (int k = 0; k < n; ++k) u[k] = float(first + k), v[k] = float(y);
        to.unproject(u, v, n, rays);
        // at a disc's rim the nearest point stands for a centre that is outside
        if (to.kind == Projection::Kind::radial) std::fill_n(rays.jacobian, n, 1.f);
        rays.turn(source_from_target, n);
        from_.project(rays, n, places);
        look(rays, places, n, omega, band.radiance + 3 * row, band.coverage + row, sums);
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

  // Between four pixels where one may be hot, missing, or over the edge; and the seen share.
  Float4 with_care(int sheet, float px, float py) const {
    const float x = std::floor(px), y = std::floor(py), s = px - x, t = py - y;
    const int i = int(x), j = int(y);
    const auto at = [&](int u, int v) { return source_.beyond(sheet, u, v); };
    return (1 - t) * ((1 - s) * at(i, j) + s * at(i + 1, j)) +
           t * ((1 - s) * at(i, j + 1) + s * at(i + 1, j + 1));
  }

  // Three channels and what follows.
  static Float4 load(const float* p) {
    typedef float Loose __attribute__((vector_size(16), aligned(4), may_alias));
    return *reinterpret_cast<const Loose*>(p);
  }

  void look(const Rays& rays, const Places& p, int n, const float* solid, float* out,
            float* coverage, double* sums) const {
    float s[kBatch], t[kBatch];
    std::int32_t column[kBatch], line[kBatch], inner[kBatch];
    const std::int32_t right = from_.sheet_width() - 1, bottom = from_.sheet_height() - 1;
    const std::int32_t last = from_.height - 2;
    // where the faces stand; all 0 where there is one sheet
    std::int32_t left_of[6]{}, top_of[6]{};
    for (int i = 0; i < from_.sheets(); ++i) {
      const Cell corner = from_.pixel(i, 0, 0);
      left_of[i] = corner.x, top_of[i] = corner.y;
    }
#pragma omp simd
    for (int k = 0; k < n; ++k) {
      const std::int32_t sheet = p.sheet[k] > 0 ? p.sheet[k] : 0;
      const float x = std::floor(p.x[k]), y = std::floor(p.y[k]);
      const std::int32_t i = std::int32_t(x), j = std::int32_t(y);
      s[k] = p.x[k] - x, t[k] = p.y[k] - y;
      column[k] = i + left_of[sheet], line[k] = j + top_of[sheet];
      inner[k] = (p.sheet[k] >= 0) & (i >= 0) & (j >= 0) & (i < right) & (j < bottom) &
                 (line[k] < last) & (rays.jacobian[k] > 0);
    }
    const Index stride = 3 * Index(from_.width);
    Float4 total{};
    for (int k = 0; k < n; ++k) {
      if (const int next = k + 12; next < n && inner[next]) {  // across rows it is far to fetch
        const float* p = source_.rgb + stride * line[next] + 3 * Index(column[next]);
        __builtin_prefetch(p);
        __builtin_prefetch(p + stride);
      }
      Float4 value{};
      const float omega = solid[k];
      if (inner[k] && omega > 0 &&
          !special_[std::size_t((line[k] >> kTile) * across_ + (column[k] >> kTile))]) {
        const float* above = source_.rgb + stride * line[k] + 3 * Index(column[k]);
        const float* below = above + stride;
        const Float4 a = load(above), b = load(below);
        const Float4 top = a + s[k] * (load(above + 3) - a);
        const Float4 low = b + s[k] * (load(below + 3) - b);
        value = top + t[k] * (low - top);
        value[3] = 1;
      } else if (p.sheet[k] >= 0 && rays.jacobian[k] > 0 && omega > 0) {
        value = with_care(p.sheet[k], p.x[k], p.y[k]);
        if (const float seen = value[3]; seen > 0 && seen < 1) {
          value = value / seen;
          value[3] = seen;
        }
      }
      total += (omega * value[3]) * value;
      out[3 * k] = value[0], out[3 * k + 1] = value[1], out[3 * k + 2] = value[2];
      coverage[k] = value[3];
    }
    for (int c = 0; c < 3; ++c) sums[c] += double(total[c]);
  }

  const Source& source_;
  const Projection& from_;
  Index across_;
  std::vector<std::uint8_t> special_;
};

}  // namespace envmap
