// Moments of a lat-long map over a coarse lattice, and the variance cut on them (Viriyothai and
// Debevec 2009). The moments of a cell, integral of L and of L w over its pixels, are those of
// the pixels: what is bright keeps its place within the cell.
//
// World axes: centre +Z, image right -X, up +Y. A pixel's radiance is constant over the pixel.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>
#include <numeric>
#include <queue>
#include <tuple>
#include <vector>

namespace nb = nanobind;

namespace {

constexpr double kPi = std::numbers::pi;
constexpr int kAlone = 1 << 19;  // pixels that are not worth a second thread
using Index = std::ptrdiff_t;
typedef float Float4 __attribute__((vector_size(16), aligned(4)));
typedef float Float8 __attribute__((vector_size(32)));

using Map = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Cells = nb::ndarray<const double, nb::shape<-1, -1, 12>, nb::c_contig, nb::device::cpu>;
using Out2 = nb::ndarray<nb::numpy, double, nb::ndim<2>>;
using Out3 = nb::ndarray<nb::numpy, double, nb::ndim<3>>;
using Ints = nb::ndarray<nb::numpy, std::int32_t, nb::ndim<2>>;

template <class T, class Array>
Array owned(std::vector<T>&& values, std::initializer_list<std::size_t> shape) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return Array(kept->data(), shape, owner);
}

constexpr double kLuminance[3] = {0.2126, 0.7152, 0.0722};

double luminance(const double* rgb) {
  return kLuminance[0] * rgb[0] + kLuminance[1] * rgb[1] + kLuminance[2] * rgb[2];
}

// Integrals over the pixels of a row: of 1, cos lat and sin lat (each times cos lat dlat).
struct RowWeights {
  float solid, level, up;
};
RowWeights row_weights(Index y, Index height) {
  const double a = kPi * (0.5 - double(y + 1) / double(height));
  const double b = kPi * (0.5 - double(y) / double(height));
  const double middle = (a + b) / 2, half = (b - a) / 2;
  const double solid = 2 * std::cos(middle) * std::sin(half);  // without cancellation
  const double level = half + std::cos(2 * middle) * std::sin(2 * half) / 2;
  return {float(solid), float(level), float(solid * std::sin(middle) * std::cos(half))};
}

// (rows, cols, 12): E, then integral of L x, L y, L z, each in R, G, B.
std::tuple<Out3, std::int64_t> moments(const Map& map, Index rows, Index cols) {
  const Index height = Index(map.shape(0)), width = Index(map.shape(1));
  if (rows < 1 || cols < 1 || rows > height || cols > width)
    throw nb::value_error("more cells than pixels, or none");
  std::vector<double> cells(rows * cols * 12);
  std::int64_t bad = 0;
  {
    nb::gil_scoped_release release;
    // over a pixel: integral of 1, -sin lon and cos lon
    const double step = 2 * kPi / double(width);
    std::vector<float> east(width), ahead(width);
    for (Index x = 0; x < width; ++x) {
      const double lon = (double(x) + 0.5) * step - kPi, chord = 2 * std::sin(step / 2);
      east[x] = float(-chord * std::sin(lon));
      ahead[x] = float(chord * std::cos(lon));
    }
    std::atomic<bool> sound{true};
    tbb::parallel_for(
        tbb::blocked_range<Index>(0, rows, std::max<Index>(1, kAlone / (width * (height / rows)))),
        [&](const tbb::blocked_range<Index>& range) {
          const Index n = 3 * width;
          std::vector<float> sums(3 * (n + 1));
          float *solid = sums.data(), *level = solid + n + 1, *up = level + n + 1;
          for (Index r = range.begin(); r != range.end(); ++r) {
            std::fill(sums.begin(), sums.end(), 0.f);
            std::uint32_t highest = 0;
            for (Index y = r * height / rows; y < (r + 1) * height / rows; ++y) {
              const RowWeights w = row_weights(y, height);
              const float* row = map.data() + y * n;
              for (Index k = 0; k < n; ++k) {
                const float v = row[k];
                solid[k] += w.solid * v;
                level[k] += w.level * v;
                up[k] += w.up * v;
                highest = std::max(highest, std::bit_cast<std::uint32_t>(v));
              }
            }
            if (highest >= 0x7f800000u) sound = false;  // infinite, NaN, or its sign is set
            for (Index c = 0; c < cols; ++c) {
              Float4 e{}, x{}, y{}, z{};
              for (Index i = c * width / cols; i < (c + 1) * width / cols; ++i) {
                const Float4 l = *reinterpret_cast<const Float4*>(level + 3 * i);
                e += *reinterpret_cast<const Float4*>(solid + 3 * i);
                y += *reinterpret_cast<const Float4*>(up + 3 * i);
                x += east[i] * l;
                z += ahead[i] * l;
              }
              double* out = &cells[(r * cols + c) * 12];
              for (int k = 0; k < 3; ++k) {
                out[k] = step * double(e[k]);
                out[3 + k] = double(x[k]);
                out[6 + k] = step * double(y[k]);
                out[9 + k] = double(z[k]);
              }
            }
          }
        });
    if (!sound)
      for (Index k = 0; k < height * width; ++k) {
        const float* rgb = map.data() + 3 * k;
        const auto good = [](float v) { return v >= 0 && v <= std::numeric_limits<float>::max(); };
        bad += !(good(rgb[0]) && good(rgb[1]) && good(rgb[2]));
      }
  }
  return {owned<double, Out3>(std::move(cells), {std::size_t(rows), std::size_t(cols), 12}), bad};
}

// E and integral of L w, luminance.
struct Moment {
  double e = 0, x = 0, y = 0, z = 0;
  Moment operator+(const Moment& o) const { return {e + o.e, x + o.x, y + o.y, z + o.z}; }
  Moment operator-(const Moment& o) const { return {e - o.e, x - o.x, y - o.y, z - o.z}; }
  // E - |m|^2 / E, the energy's variance about its centroid on the sphere.
  double spread() const {
    return e > 0 ? std::max(e - (x * x + y * y + z * z) / e, 0.0) : 0.0;
  }
};
Moment luminous(const double* cell) {
  return {luminance(cell), luminance(cell + 3), luminance(cell + 6), luminance(cell + 9)};
}

struct Region {
  int y0, y1, x0, x1;
};

class VarianceCut {
 public:
  explicit VarianceCut(const Cells& cells)
      : rows_(int(cells.shape(0))), cols_(int(cells.shape(1))), table_((rows_ + 1) * (cols_ + 1)) {
    for (int y = 0; y < rows_; ++y) {
      Moment row;
      for (int x = 0; x < cols_; ++x) {
        row = row + luminous(cells.data() + (Index(y) * cols_ + x) * 12);
        at(y + 1, x + 1) = at(y, x + 1) + row;
      }
    }
  }

  // Always the region of the largest spread is cut, where least is left; `made` settles ties.
  std::vector<Region> run(std::size_t count) {
    struct Open {
      double spread;
      int made;
      Region region;
      bool operator<(const Open& o) const {
        return spread != o.spread ? spread < o.spread : made > o.made;
      }
    };
    std::priority_queue<Open> open;
    std::vector<Region> done;
    int made = 0;
    const Region whole{0, rows_, 0, cols_};
    open.push({sum(whole).spread(), made++, whole});
    const double rounding = 1e-12 * at(rows_, cols_).e;  // what is left of it in one point of light
    while (!open.empty() && open.size() + done.size() < count) {
      const Open top = open.top();
      open.pop();
      Region first, second;
      if (top.spread <= rounding || !cut(top.region, first, second)) {
        done.push_back(top.region);
        continue;
      }
      for (const Region& part : {first, second}) open.push({sum(part).spread(), made++, part});
    }
    for (; !open.empty(); open.pop()) done.push_back(open.top().region);
    std::sort(done.begin(), done.end(), [](const Region& a, const Region& b) {
      return std::tie(a.y0, a.y1, a.x0, a.x1) < std::tie(b.y0, b.y1, b.x0, b.x1);
    });
    return done;
  }

 private:
  Moment& at(int y, int x) { return table_[Index(y) * (cols_ + 1) + x]; }

  Moment sum(const Region& r) {
    return at(r.y1, r.x1) - at(r.y0, r.x1) - at(r.y1, r.x0) + at(r.y0, r.x0);
  }

  bool cut(const Region& r, Region& first, Region& second) {
    const Moment whole = sum(r);
    double best = std::numeric_limits<double>::infinity();
    const auto consider = [&](const Moment& part, const Region& a, const Region& b) {
      const double left = part.spread() + (whole - part).spread();
      if (left < best) best = left, first = a, second = b;
    };
    const Moment above = at(r.y0, r.x1) - at(r.y0, r.x0);
    for (int y = r.y0 + 1; y < r.y1; ++y)
      consider(at(y, r.x1) - at(y, r.x0) - above, {r.y0, y, r.x0, r.x1}, {y, r.y1, r.x0, r.x1});
    const Moment before = at(r.y1, r.x0) - at(r.y0, r.x0);
    for (int x = r.x0 + 1; x < r.x1; ++x)
      consider(at(r.y1, x) - at(r.y0, x) - before, {r.y0, r.y1, r.x0, x}, {r.y0, r.y1, x, r.x1});
    return std::isfinite(best);
  }

  int rows_, cols_;
  std::vector<Moment> table_;
};

// Lloyd's iteration: each cell to the light nearest to its centroid, each light to the centroid of
// its cells. The cut's rectangles of latitude and longitude are a good start and no more.
class Relaxation {
 public:
  Relaxation(const Cells& cells, const std::vector<Region>& regions)
      : cells_(cells.shape(0) * cells.shape(1)), label_(cells_.size()), lights_(regions.size()) {
    const Index rows = Index(cells.shape(0)), cols = Index(cells.shape(1));
    for (Index y = 0; y < rows; ++y)
      for (Index x = 0; x < cols; ++x) {
        const Index k = y * cols + x;
        const double lat = kPi * (0.5 - (double(y) + 0.5) / double(rows));
        Moment m = luminous(cells.data() + 12 * k);
        const double length = std::sqrt(m.x * m.x + m.y * m.y + m.z * m.z);
        if (length > 0) {
          m = {m.e, m.x / length, m.y / length, m.z / length};
        } else {  // dark: its middle
          const double lon = 2 * kPi * (double(x) + 0.5) / double(cols) - kPi;
          m = {0, -std::sin(lon) * std::cos(lat), std::sin(lat), std::cos(lon) * std::cos(lat)};
        }
        cells_[k] = {float(m.e), float(m.x), float(m.y), float(m.z), float(std::cos(lat))};
      }
    for (std::size_t n = 0; n < regions.size(); ++n)
      for (int y = regions[n].y0; y < regions[n].y1; ++y)
        for (int x = regions[n].x0; x < regions[n].x1; ++x) label_[y * cols + x] = int(n);
    move();
  }

  std::vector<std::int32_t> run(int steps) {
    for (bool moved = true; moved && steps > 0; --steps) {
      neighbours();
      moved = false;
      for (std::size_t k = 0; k < cells_.size(); ++k) {
        const Cell& c = cells_[k];
        const Near& near = near_[label_[k]];
        const Float8 along = c.x * near.x + c.y * near.y + c.z * near.z;
        int best = 0;
        float closest = along[0];
        for (int i = 1; i < kNear; ++i) {
          best = along[i] > closest ? i : best;
          closest = std::max(closest, along[i]);
        }
        moved |= best != 0;
        label_[k] = near.light[best];
      }
      move();
    }
    return label_;
  }

 private:
  struct Cell {
    float e, x, y, z, area;
  };
  struct Light {
    float x, y, z;
  };
  static constexpr int kNear = 8;
  struct Near {
    Float8 x, y, z;
    int light[kNear];
  };

  void move() {
    struct Sum {
      double lit[3]{}, middle[3]{};
    };
    std::vector<Sum> sums(lights_.size());
    for (std::size_t k = 0; k < cells_.size(); ++k) {
      const Cell& c = cells_[k];
      Sum& s = sums[label_[k]];
      const double d[3] = {c.x, c.y, c.z};
      for (int i = 0; i < 3; ++i) s.lit[i] += double(c.e) * d[i], s.middle[i] += double(c.area) * d[i];
    }
    for (std::size_t n = 0; n < sums.size(); ++n) {
      const auto square = [](const double* v) { return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]; };
      const double* v = square(sums[n].lit) > 0 ? sums[n].lit : sums[n].middle;
      const double length = std::sqrt(square(v));
      if (length > 0) lights_[n] = {float(v[0] / length), float(v[1] / length), float(v[2] / length)};
    }
  }

  // The lights nearest to each, itself first (and again where there are fewer).
  void neighbours() {
    near_.resize(lights_.size());
    std::vector<std::pair<float, int>> order(lights_.size());
    for (std::size_t a = 0; a < lights_.size(); ++a) {
      const Light& p = lights_[a];
      for (std::size_t b = 0; b < lights_.size(); ++b) {
        const Light& q = lights_[b];
        order[b] = {a == b ? -2.f : -(p.x * q.x + p.y * q.y + p.z * q.z), int(b)};
      }
      const int count = std::min(kNear, int(order.size()));
      std::partial_sort(order.begin(), order.begin() + count, order.end());
      for (int i = 0; i < kNear; ++i) {
        const int n = order[i < count ? i : 0].second;
        near_[a].light[i] = n;
        near_[a].x[i] = lights_[n].x, near_[a].y[i] = lights_[n].y, near_[a].z[i] = lights_[n].z;
      }
    }
  }

  std::vector<Cell> cells_;
  std::vector<std::int32_t> label_;
  std::vector<Light> lights_;
  std::vector<Near> near_;
};

// The light of each cell, (rows, cols), and the lights' moments (N, 12), summed from the cells.
std::tuple<Ints, Out2> variance_cut(const Cells& cells, std::size_t count, int relax) {
  const std::size_t size = cells.shape(0) * cells.shape(1);
  if (size > std::size_t(1) << 26) throw nb::value_error("too many cells");
  std::vector<std::int32_t> labels;
  std::vector<double> sums;
  {
    nb::gil_scoped_release release;
    const std::vector<Region> found = VarianceCut(cells).run(count);
    labels = Relaxation(cells, found).run(relax);
    std::vector<std::int32_t> number(found.size());  // of those lights that kept a cell
    for (const auto n : labels) number[n] = 1;
    std::exclusive_scan(number.begin(), number.end(), number.begin(), 0);
    for (auto& n : labels) n = number[n];
    sums.resize(std::size_t(1 + *std::max_element(labels.begin(), labels.end())) * 12);
    for (std::size_t k = 0; k < size; ++k)
      for (int i = 0; i < 12; ++i) sums[labels[k] * 12 + i] += cells.data()[12 * k + i];
  }
  const std::size_t n = sums.size() / 12;
  return {owned<std::int32_t, Ints>(std::move(labels), {cells.shape(0), cells.shape(1)}),
          owned<double, Out2>(std::move(sums), {n, 12})};
}

// Real spherical harmonics of order 2 of the map, (9, 3), from the cells: bands 0 and 1 are the
// moments themselves; band 2 at each cell's centroid, less what the cell's own extent takes off
// (1 - l (l + 1) / 4 sigma^2). And the irradiance on +X -X +Y -Y +Z -Z, (6, 3).
std::tuple<Out2, Out2> summary(const Cells& cells) {
  double energy[3]{}, second_band[15]{}, positive[9]{}, negative[9]{};
  const double b = std::sqrt(15 / (4 * kPi)), flat = std::sqrt(5 / (16 * kPi));
  for (std::size_t k = 0; k < cells.shape(0) * cells.shape(1); ++k) {
    const double* cell = cells.data() + 12 * k;
    const Moment m = luminous(cell);
    if (!(m.e > 0)) continue;
    const double m2 = m.x * m.x + m.y * m.y + m.z * m.z;
    for (int i = 0; i < 9; ++i) {
      positive[i] += std::max(cell[3 + i], 0.0);
      negative[i] -= std::min(cell[3 + i], 0.0);
    }
    const double extent = std::max(1 - m2 / (m.e * m.e), 0.0);
    const double scale = m2 > 0 ? std::max(1 - 1.5 * extent, 0.0) / m2 : 0;
    const double second[5] = {b * m.x * m.y, b * m.y * m.z, flat * (3 * m.z * m.z - m2),
                              b * m.x * m.z, b / 2 * (m.x * m.x - m.y * m.y)};
    for (int c = 0; c < 3; ++c) energy[c] += cell[c];
    for (int j = 0; j < 5; ++j)
      for (int c = 0; c < 3; ++c) second_band[3 * j + c] += second[j] * scale * cell[c];
  }
  const double zeroth = 1 / std::sqrt(4 * kPi), first = std::sqrt(3 / (4 * kPi));
  std::vector<double> harmonics, irradiance;
  for (int c = 0; c < 3; ++c) harmonics.push_back(zeroth * energy[c]);
  for (const int axis : {1, 2, 0})
    for (int c = 0; c < 3; ++c)
      harmonics.push_back(first * (positive[3 * axis + c] - negative[3 * axis + c]));
  harmonics.insert(harmonics.end(), second_band, second_band + 15);
  for (int axis = 0; axis < 3; ++axis)
    for (const double* side : {positive, negative})
      irradiance.insert(irradiance.end(), side + 3 * axis, side + 3 * axis + 3);
  return {owned<double, Out2>(std::move(harmonics), {9, 3}),
          owned<double, Out2>(std::move(irradiance), {6, 3})};
}

}  // namespace

NB_MODULE(lights_kernel, m) {
  m.def("moments", &moments);
  m.def("variance_cut", &variance_cut);
  m.def("summary", &summary);
}
