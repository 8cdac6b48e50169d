// The fast way: one bilinear sample a pixel, at its centre. What that gains or loses of the base's
// energy is put right by one factor a channel, where both maps see the whole sphere; hot pixels are
// scattered as ever.
#pragma once

#include <memory>

#include "warp.h"

namespace envmap {

class Fast {
 public:
  explicit Fast(const Source& source)
      : from_(source.projection),
        stride_(from_.sheet_width() + 2),
        per_sheet_(stride_ * (from_.sheet_height() + 2)),
        pixels_(std::make_unique_for_overwrite<Float4[]>(
            std::size_t(per_sheet_ * from_.sheets()))) {
    const int w = from_.sheet_width(), h = from_.sheet_height(), rows = h + 2;
    for_rows(0, rows * from_.sheets(), [&](int row) {
      const int sheet = row / rows, y = row % rows - 1;
      Float4* out = &pixels_[std::size_t(sheet * per_sheet_ + Index(y + 1) * stride_)];
      const bool edge = y < 0 || y >= h;
      out[0] = source.beyond(sheet, -1, y);
      out[w + 1] = source.beyond(sheet, w, y);
      if (edge)
        for (int x = 0; x < w; ++x) out[x + 1] = source.beyond(sheet, x, y);
      else
        fill(source, from_.pixel(sheet, 0, y), w, out + 1);
    });
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
  static void fill(const Source& source, Cell first, int n, Float4* out) {
    const float* rgb = source.rgb + 3 * source.index(first);
    if (source.solid.across == 0 && !source.valid) {
      for (int x = 0; x < n; ++x, rgb += 3) {
        const float s = base_share(rgb, source.cap);
        out[x] = Float4{s * rgb[0], s * rgb[1], s * rgb[2], 1};
      }
    } else {
      for (int x = 0; x < n; ++x) out[x] = source.base({first.x + x, first.y});
    }
  }

  void look(const Rays& rays, const Places& p, int n, const float* solid, Index across, float* out,
            float* coverage, double* sums) const {
    Float4 total{};
    for (int k = 0; k < n; ++k) {
      Float4 value{};
      if (p.sheet[k] >= 0 && rays.jacobian[k] > 0 && solid[k * across] > 0) {
        const float x = std::floor(p.x[k]), y = std::floor(p.y[k]);
        const float s = p.x[k] - x, t = p.y[k] - y;
        const Float4* c = &pixels_[std::size_t(p.sheet[k] * per_sheet_ +
                                               (Index(y) + 1) * stride_ + Index(x) + 1)];
        const Float4 top = c[0] + s * (c[1] - c[0]);
        const Float4 low = c[stride_] + s * (c[stride_ + 1] - c[stride_]);
        value = top + t * (low - top);
      }
      const float seen = value[3];
      total += solid[k * across] * value;
      if (seen > 0 && seen < 1) value = value / seen;
      out[3 * k] = value[0], out[3 * k + 1] = value[1], out[3 * k + 2] = value[2];
      coverage[k] = seen;
    }
    for (int c = 0; c < 3; ++c) sums[c] += total[c];
  }

  const Projection& from_;
  Index stride_, per_sheet_;
  std::unique_ptr<Float4[]> pixels_;  // of each sheet, with a pixel more around it
};

}  // namespace envmap
