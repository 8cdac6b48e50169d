// What a source holds: its energy, its mean, what must not be in it, and its hot pixels.
#pragma once

#include <vector>

#include "source.h"

namespace envmap {

// Sums over the usable pixels of a row: solid angle, its product with the largest channel, and
// with each channel. They are added up over all rows at once, so that a map read in parts gives
// the same sums. `bad` counts NaN, infinite and negative pixels.
//
// The second sum takes the largest channel no higher than `cap`: the mean of the base.
struct RowSums {
  double sum[5];
  Index bad;
};

inline RowSums survey_row(const float* rgb, const bool* valid, const float* solid, Index width,
                          float cap) {
  constexpr float kLargest = std::numeric_limits<float>::max();
  double covered = 0, top = 0, red = 0, green = 0, blue = 0;
  std::int32_t bad = 0;
#pragma omp simd reduction(+ : covered, top, red, green, blue, bad)
  for (Index x = 0; x < width; ++x) {
    const float r = rgb[3 * x], g = rgb[3 * x + 1], b = rgb[3 * x + 2], omega = solid[x];
    const bool used = (omega > 0) & (valid ? valid[x] : true);
    // comparisons with NaN are false
    const bool good = (r >= 0) & (r <= kLargest) & (g >= 0) & (g <= kLargest) & (b >= 0) &
                      (b <= kLargest);
    const double w = used & good ? double(omega) : 0.0;
    bad += used & !good ? 1 : 0;
    covered += w;
    top += w > 0 ? w * double(least(most(most(r, g), b), cap)) : 0;
    red += w > 0 ? w * double(r) : 0;
    green += w > 0 ? w * double(g) : 0;
    blue += w > 0 ? w * double(b) : 0;
  }
  return {{covered, top, red, green, blue}, bad};
}

// The same of a row without a mask: lanes of float, gathered in double every 256 pixels. `solid` is
// one for all where the row is `even`. False where a pixel is bad or a sum leaves float's range.
template <bool even>
bool survey_plain_row(const float* rgb, const float* solid, Index width, float cap, RowSums& row) {
  constexpr float kLargest = std::numeric_limits<float>::max();
  row = {{0, 0, 0, 0, 0}, 0};
  for (Index begin = 0; begin < width; begin += 256) {
    const Index end = std::min(width, begin + 256);
    std::int32_t bad = 0;
    float covered = 0, top = 0, red = 0, green = 0, blue = 0;
#pragma omp simd reduction(| : bad)
    for (Index k = 3 * begin; k < 3 * end; ++k) bad |= (rgb[k] >= 0) & (rgb[k] <= kLargest) ? 0 : 1;
    if (bad) return false;
#pragma omp simd reduction(+ : covered, top, red, green, blue)
    for (Index x = begin; x < end; ++x) {
      const float r = rgb[3 * x], g = rgb[3 * x + 1], b = rgb[3 * x + 2];
      const float w = even ? 1.f : solid[x];
      covered += w;
      top += w * least(most(most(r, g), b), cap);
      red += w * r, green += w * g, blue += w * b;
    }
    if (!(top <= kLargest && red <= kLargest && green <= kLargest && blue <= kLargest)) return false;
    row.sum[0] += double(covered), row.sum[1] += double(top), row.sum[2] += double(red);
    row.sum[3] += double(green), row.sum[4] += double(blue);
  }
  if (even)
    for (double& sum : row.sum) sum *= double(*solid);
  return true;
}

inline void find_hot(const Source& source, Index y, std::vector<std::int64_t>& hot) {
  constexpr Index chunk = 64;
  const Index width = source.projection.width;
  const float* rgb = source.rgb + 3 * width * y;
  const float cap = source.cap;
  std::vector<float> solid;
  for (Index begin = 0; begin < width; begin += chunk) {
    const Index end = std::min(width, begin + chunk);
    std::int32_t any = 0;
#pragma omp simd reduction(| : any)
    for (Index k = 3 * begin; k < 3 * end; ++k) any |= rgb[k] > cap ? 1 : 0;
    if (!any) continue;
    if (solid.empty()) solid.resize(std::size_t(width)), source.solid.row(y, solid.data());
    for (Index x = begin; x < end; ++x)
      if (solid[std::size_t(x)] > 0 && (!source.valid || source.valid[width * y + x]) &&
          largest(rgb + 3 * x) > cap)
        hot.push_back(width * y + x);
  }
}

}  // namespace envmap
