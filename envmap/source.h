// The source of a resampling: pixels under a cap, and a smooth surface through them that is built
// where it is looked at, block by block.
#pragma once

#include <array>
#include <atomic>
#include <memory>
#include <stdexcept>
#include <vector>

#include "projection.h"

namespace envmap {

inline float largest(const float* rgb) { return most(most(rgb[0], rgb[1]), rgb[2]); }

// The part of a pixel under the cap, its colour kept.
inline float base_share(const float* rgb, float cap) {
  const float top = largest(rgb);
  return top > cap ? cap / top : 1.f;
}

// Solid angles of pixels. Rows and columns that are alike share their values: all columns of a
// lat-long, the quarters of a disc, the faces of a cube.
struct Solid {
  const Projection& map;
  const float* values;
  const std::int64_t* line;    // where a row's values begin
  const std::int32_t* column;  // a column's place among them
  bool even;                   // one value a row
  bool holes;                  // some are 0

  // Of a cube's pixel it must lie in a face.
  float operator()(Index x, Index y) const { return values[line[y] + column[x]]; }

  // A whole row, 0 beside a cube's faces.
  void row(Index y, float* out) const {
    const float* own = values + line[y];
    for (Index x = 0; x < map.width; ++x) out[x] = own[column[x]];
    if (!map.cubic()) return;
    for (int left = 0; left < map.width; left += map.face) {
      const auto here = [&](const Face& f) {
        return Index(f.row) == y / map.face && int(f.column) * map.face == left;
      };
      if (std::none_of(map.faces.begin(), map.faces.end(), here))
        std::fill_n(out + left, map.face, 0.f);
    }
  }
};

struct Source {
  const Projection& projection;
  const float* rgb;
  const bool* valid;  // null: all
  const Solid& solid;
  float cap;

  Index index(Cell c) const { return Index(c.y) * projection.width + c.x; }
  bool usable(Cell c) const { return (!valid || valid[index(c)]) && solid(c.x, c.y) > 0; }
  // Base radiance and 1, or zeros where it is not valid.
  Float4 base(Cell c) const {
    if (!usable(c)) return Float4{};
    const float* p = rgb + 3 * index(c);
    const float s = base_share(p, cap);
    return Float4{s * p[0], s * p[1], s * p[2], 1};
  }

  // The base at any pixel of a sheet and beyond its edges, where the world goes on.
  Float4 beyond(int sheet, int x, int y) const {
    const Projection& p = projection;
    const int w = p.sheet_width(), h = p.sheet_height();
    if (x >= 0 && y >= 0 && x < w && y < h) return base(p.pixel(sheet, x, y));
    if (p.cubic()) return on_neighbour(sheet, x, y);
    if (p.round()) {  // over the pole to the opposite meridian
      const int turn = 2 * h;
      y = ((y % turn) + turn) % turn;
      if (y >= h) y = turn - 1 - y, x += w / 2;
      x = ((x % w) + w) % w;
    } else if (p.kind == Projection::Kind::octahedral) {
      // each edge is folded in its middle
      const int across = x < 0 || x >= w, down = y < 0 || y >= h;
      if (across) x = std::clamp(x < 0 ? -1 - x : 2 * w - 1 - x, 0, w - 1);
      if (down) y = std::clamp(y < 0 ? -1 - y : 2 * h - 1 - y, 0, h - 1);
      if (across) y = h - 1 - std::clamp(y, 0, h - 1);
      if (down) x = w - 1 - std::clamp(x, 0, w - 1);
    }
    return base(p.pixel(sheet, std::clamp(x, 0, w - 1), std::clamp(y, 0, h - 1)));
  }

 private:
  // Linear between the pixels of the face that a face's plane goes on over.
  Float4 on_neighbour(int sheet, int x, int y) const {
    const Face& f = projection.faces[std::size_t(sheet)];
    const float n = float(projection.face);
    const float a = 2 * (float(x) + 0.5f) / n - 1, b = 2 * (float(y) + 0.5f) / n - 1;
    const Vec d = f.forward + a * f.right + b * f.down;
    float best = 0, u = 0, v = 0;
    int other = 0;
    for (int i = 0; i < 6; ++i) {
      const Face& g = projection.faces[std::size_t(i)];
      if (const float w = dot(d, g.forward); i != sheet && w > best)
        best = w, other = i, u = dot(d, g.right) / w, v = dot(d, g.down) / w;
    }
    const int last = projection.face - 1;
    const float p = within((u + 1) / 2 * n - 0.5f, 0.f, float(last));
    const float q = within((v + 1) / 2 * n - 0.5f, 0.f, float(last));
    const int i = int(p), j = int(q), i1 = std::min(i + 1, last), j1 = std::min(j + 1, last);
    const float s = p - float(i), t = q - float(j);
    const auto at = [&](int k, int l) { return base(projection.pixel(other, k, l)); };
    const Float4 sum = (1 - t) * ((1 - s) * at(i, j) + s * at(i1, j)) +
                       t * ((1 - s) * at(i, j1) + s * at(i1, j1));
    return sum[3] > 0 ? sum / sum[3] : Float4{};
  }
};

// The base as a cubic B-spline whose cell averages are the pixels, limited to stay above the
// smallest of the 3 x 3 pixels around (Zhang and Shu): a + t (H - a), which keeps the average.
//
// It is made in blocks that do not depend on what is asked for, so that a map made in parts is the
// same, bit for bit, as one made at once.
class Histospline {
 public:
  explicit Histospline(const Source& source)
      : source_(source),
        width_(source.projection.sheet_width()),
        height_(source.projection.sheet_height()),
        across_((width_ + kBlock - 1) / kBlock),
        per_sheet_(across_ * ((height_ + kBlock - 1) / kBlock)),
        blocks_(std::size_t(per_sheet_) * std::size_t(source.projection.sheets())) {}
  ~Histospline() {
    for (auto& slot : blocks_) delete slot.load();
  }
  Histospline(const Histospline&) = delete;
  Histospline& operator=(const Histospline&) = delete;

  // Free the blocks that were not looked at since the last time; nobody may be looking.
  void forget() {
    for (auto& slot : blocks_)
      if (const Block* block = slot.load(); block && block->used.load() != turn_)
        delete slot.exchange(nullptr);
    ++turn_;
  }

  // The surface at a place, and 1; all 0 where the pixel there is not valid.
  Float4 operator()(int sheet, float x, float y) const {
    const int i = std::clamp(int(std::floor(x + 0.5f)), 0, width_ - 1);
    const int j = std::clamp(int(std::floor(y + 0.5f)), 0, height_ - 1);
    const Block& block = at(sheet, i / kBlock, j / kBlock);
    const int x0 = i / kBlock * kBlock, y0 = j / kBlock * kBlock;
    const Float4 a = block.average[std::size_t((j - y0) * kBlock + i - x0)];
    if (a[3] == 0) return Float4{};
    const Float4* own = &block.coefficient[std::size_t((j - y0 + kRim) * kSide + i - x0 + kRim)];
    const float t = (*own)[3];
    // the patch between four pixels that the place is in
    const int left = int(std::floor(x)) - i, top = int(std::floor(y)) - j;  // -1 or 0
    float u[4], v[4];
    weights(x - float(i + left), u);
    weights(y - float(j + top), v);
    const Float4* c = own + (top - 1) * kSide + left - 1;
    Float4 sum{};
    for (int n = 0; n < 4; ++n, c += kSide)
      sum += v[n] * (u[0] * c[0] + u[1] * c[1] + u[2] * c[2] + u[3] * c[3]);
    Float4 value = a + t * (sum - a);
    value[3] = 1;
    return value;
  }

  // The limiter's t at a place.
  float limiter(int sheet, float x, float y) const {
    const int i = std::clamp(int(std::floor(x + 0.5f)), 0, width_ - 1);
    const int j = std::clamp(int(std::floor(y + 0.5f)), 0, height_ - 1);
    const Block& block = at(sheet, i / kBlock, j / kBlock);
    return block.coefficient[std::size_t((j % kBlock + kRim) * kSide + i % kBlock + kRim)][3];
  }

  // Weights of the ten pixels floor(x) - 4 .. floor(x) + 5 in the unlimited spline at x.
  static void cardinal(float x, float (&w)[10]) {
    // the inverse of (1, 76, 230, 76, 1) / 384: c1 z1^|m| + c2 z2^|m|
    static const std::array<float, 15> inverse = [] {
      const double z1 = -0.36134122590022, z2 = -0.01372542929734;
      const auto a = [](double z) { return z + 1 / z; };
      const auto c = [&](double z, double other) {
        return 384 / ((a(z) - a(other)) * (z - 1 / z));
      };
      std::array<float, 15> p{};
      for (int m = -7; m <= 7; ++m)
        p[std::size_t(m + 7)] = float(c(z1, z2) * std::pow(z1, std::abs(m)) +
                                      c(z2, z1) * std::pow(z2, std::abs(m)));
      return p;
    }();
    float spline[4];
    weights(x - std::floor(x), spline);
    for (int q = -4; q <= 5; ++q) {
      float sum = 0;
      for (int m = 0; m < 4; ++m)
        if (const int k = q + 1 - m; k >= -7 && k <= 7) sum += spline[m] * inverse[std::size_t(k + 7)];
      w[q + 4] = sum;
    }
  }

  static void weights(float f, float (&w)[4]) {
    const float g = 1 - f;
    w[0] = g * g * g / 6;
    w[1] = 2.f / 3 - f * f * (2 - f) / 2;
    w[2] = 2.f / 3 - g * g * (2 - g) / 2;
    w[3] = f * f * f / 6;
  }

 private:
  static constexpr int kBlock = 128;
  static constexpr int kRim = 2;                     // of coefficients around a block
  static constexpr int kSide = kBlock + 2 * kRim;
  static constexpr int kPad = 16;                    // the filter's memory: 0.361^14 = 6e-7
  static constexpr int kWide = kBlock + 2 * kPad;

  struct Block {
    std::array<Float4, kBlock * kBlock> average;     // w: 1 where valid
    std::array<Float4, kSide * kSide> coefficient;   // w: the limiter's t of the cell
    mutable std::atomic<std::uint32_t> used = 0;     // the turn in which it was looked at
  };

  const Block& at(int sheet, int bx, int by) const {
    auto& slot = blocks_[std::size_t(sheet * per_sheet_ + by * across_ + bx)];
    if (const Block* block = slot.load(std::memory_order_acquire)) {
      if (block->used.load(std::memory_order_relaxed) != turn_)
        block->used.store(turn_, std::memory_order_relaxed);
      return *block;
    }
    auto made = build(sheet, bx * kBlock, by * kBlock);
    made->used = turn_;
    Block* nothing = nullptr;
    // another thread may have been quicker: its block is the same
    if (slot.compare_exchange_strong(nothing, made.get(), std::memory_order_acq_rel))
      return *made.release();
    return *nothing;
  }

  std::unique_ptr<Block> build(int sheet, int x0, int y0) const {
    std::vector<Float4> c(std::size_t(kWide) * kWide);
    const auto cell = [&](int x, int y) -> Float4& {
      return c[std::size_t((y + kPad) * kWide + x + kPad)];
    };
    bool whole = true;
    for (int y = -kPad; y < kBlock + kPad; ++y)
      for (int x = -kPad; x < kBlock + kPad; ++x) {
        // far outside of a small map nothing is looked at
        const int u = std::min(x0 + x, width_ + kPad - 1), v = std::min(y0 + y, height_ + kPad - 1);
        cell(x, y) = source_.beyond(sheet, u, v);
        whole = whole && cell(x, y)[3] > 0;
      }
    auto block = std::make_unique<Block>();
    for (int y = 0; y < kBlock; ++y)
      for (int x = 0; x < kBlock; ++x) block->average[std::size_t(y * kBlock + x)] = cell(x, y);
    if (!whole) grow(c);
    std::vector<Float4> average = c;
    for (int y = 0; y < kWide; ++y) filter(&c[std::size_t(y * kWide)], 1, 1);
    filter(c.data(), kWide, kWide);
    for (int y = -kRim; y < kBlock + kRim; ++y)
      for (int x = -kRim; x < kBlock + kRim; ++x) {
        Float4& to = block->coefficient[std::size_t((y + kRim) * kSide + x + kRim)];
        to = cell(x, y);
        to[3] = 1;
      }
    limit(*block, average, std::min(kBlock, width_ - x0), std::min(kBlock, height_ - y0));
    return block;
  }

  // Grow the valid part, so that nothing dark from outside leaks in over the rim.
  static void grow(std::vector<Float4>& c) {
    for (int step = 0; step < 4; ++step) {
      std::vector<std::pair<std::size_t, Float4>> grown;
      for (int y = 0; y < kWide; ++y)
        for (int x = 0; x < kWide; ++x) {
          const std::size_t k = std::size_t(y * kWide + x);
          if (c[k][3] > 0) continue;
          Float4 sum{};
          for (int v = std::max(y - 1, 0); v <= std::min(y + 1, kWide - 1); ++v)
            for (int u = std::max(x - 1, 0); u <= std::min(x + 1, kWide - 1); ++u)
              sum += c[std::size_t(v * kWide + u)];
          if (sum[3] > 0) grown.emplace_back(k, sum / sum[3]);
        }
      for (const auto& [k, value] : grown) c[k] = value;
    }
  }

  // Inverse of the cell average of a cubic B-spline, (1, 76, 230, 76, 1) / 384, along `lanes`
  // neighbouring lines whose values are `step` apart.
  static void filter(Float4* c, Index step, Index lanes) {
    for (const float z : {-0.36134122590022f, -0.01372542929734f}) {
      const float gain = (1 - z) * (1 - 1 / z);
      for (Index l = 0; l < lanes; ++l) {
        Float4 start{};
        float power = 1;
        for (Index k = 0; k < 2 * kPad; ++k, power *= z) start += power * c[k * step + l];
        c[l] = start;
      }
      for (Index k = 1; k < kWide; ++k)
        for (Index l = 0; l < lanes; ++l) c[k * step + l] += z * c[(k - 1) * step + l];
      for (Index l = 0; l < lanes; ++l) {
        Float4& last = c[(kWide - 1) * step + l];
        last = z / (z * z - 1) * (last + z * c[(kWide - 2) * step + l]);
      }
      for (Index k = kWide - 2; k >= 0; --k)
        for (Index l = 0; l < lanes; ++l)
          c[k * step + l] = z * (c[(k + 1) * step + l] - c[k * step + l]);
      for (Index k = 0; k < kWide; ++k)
        for (Index l = 0; l < lanes; ++l) c[k * step + l] *= gain;
    }
  }

  // Coefficients c(j-2 .. j+2) to the seven Bezier points over [j - 1/2, j + 1/2].
  static constexpr std::array<std::array<float, 5>, 7> bezier() {
    std::array<std::array<float, 5>, 7> result{};
    for (std::size_t k = 0; k < 5; ++k) {
      float c[5]{};
      c[k] = 1;
      const auto span = [&](int i) {  // Bezier points of the patch [i, i + 1]
        return std::array<float, 4>{(c[i - 1] + 4 * c[i] + c[i + 1]) / 6, (2 * c[i] + c[i + 1]) / 3,
                                    (c[i] + 2 * c[i + 1]) / 3,
                                    (c[i] + 4 * c[i + 1] + c[i + 2]) / 6};
      };
      const auto left = span(1), right = span(2);
      result[0][k] = (left[0] + 3 * left[1] + 3 * left[2] + left[3]) / 8;
      result[1][k] = (left[1] + 2 * left[2] + left[3]) / 4;
      result[2][k] = (left[2] + left[3]) / 2;
      result[3][k] = left[3];
      result[4][k] = (right[0] + right[1]) / 2;
      result[5][k] = (right[0] + 2 * right[1] + right[2]) / 4;
      result[6][k] = (right[0] + 3 * right[1] + 3 * right[2] + right[3]) / 8;
    }
    return result;
  }

  // t from the Bezier points of the four patches in a cell, whose hull holds the spline.
  static void limit(Block& block, const std::vector<Float4>& average, int width, int height) {
    static constexpr auto points = bezier();
    std::vector<Float4> across(std::size_t(7) * kSide);  // a row of cells, all rows around
    std::vector<float> t(std::size_t(kBlock) * kBlock, 1.f);
    for (int x = 0; x < width; ++x) {
      for (int y = 0; y < height + 2 * kRim; ++y) {
        const Float4* c = &block.coefficient[std::size_t(y * kSide + x)];
        for (std::size_t p = 0; p < 7; ++p)
          across[std::size_t(y) * 7 + p] = points[p][0] * c[0] + points[p][1] * c[1] +
                                           points[p][2] * c[2] + points[p][3] * c[3] +
                                           points[p][4] * c[4];
      }
      for (int y = 0; y < height; ++y) {
        const Float4* around = &average[std::size_t((y + kPad) * kWide + x + kPad)];
        const Float4 a = *around;
        Float4 lowest = a, hull = a;
        for (int v = -1; v <= 1; ++v)
          for (int u = -1; u <= 1; ++u) lowest = lower(lowest, around[v * kWide + u]);
        for (std::size_t p = 0; p < 7; ++p) {
          const Float4* c = &across[std::size_t(y) * 7 + p];
          for (const auto& down : points)
            hull = lower(hull, down[0] * c[0] + down[1] * c[7] + down[2] * c[14] +
                                   down[3] * c[21] + down[4] * c[28]);
        }
        float share = 1;
        for (int k = 0; k < 3; ++k)
          if (hull[k] < lowest[k]) share = least(share, (a[k] - lowest[k]) / (a[k] - hull[k]));
        t[std::size_t(y * kBlock + x)] = share;
      }
    }
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        block.coefficient[std::size_t((y + kRim) * kSide + x + kRim)][3] =
            t[std::size_t(y * kBlock + x)];
  }

  static Float4 lower(Float4 a, Float4 b) { return a < b ? a : b; }

  const Source& source_;
  int width_, height_, across_, per_sheet_;
  std::uint32_t turn_ = 0;
  mutable std::vector<std::atomic<Block*>> blocks_;
};

}  // namespace envmap
