// Irradiance and GGX-prefiltered radiance of a lat-long map, from the moments of its cells
// (lights_kernel): each cell's energy is counted once, so that no sun is missed or found twice.
//
// World axes: centre +Z, image right -X, up +Y.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <vector>

namespace nb = nanobind;

namespace {

constexpr double kPi = std::numbers::pi;
constexpr double kLuminance[3] = {0.2126, 0.7152, 0.0722};
using Index = std::ptrdiff_t;
using Cells = nb::ndarray<const double, nb::shape<-1, -1, 12>, nb::c_contig, nb::device::cpu>;
using Vectors = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Out2 = nb::ndarray<nb::numpy, double, nb::ndim<2>>;
using Out3 = nb::ndarray<nb::numpy, double, nb::ndim<3>>;

template <class Array>
Array owned(std::vector<double>&& values, std::initializer_list<std::size_t> shape) {
  auto* kept = new std::vector<double>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
  return Array(kept->data(), shape, owner);
}

// E(n) = sum over rows of n . (integral of L w over the part of the row above the horizon): exact
// but for the one cell at either end of each row, of which a part is taken.
Out2 irradiance(const Cells& cells, const Vectors& normals) {
  const Index rows = Index(cells.shape(0)), cols = Index(cells.shape(1));
  const Index count = Index(normals.shape(0));
  std::vector<double> out(3 * count);
  {
    nb::gil_scoped_release release;
    std::vector<double> before(rows * (cols + 1) * 9);  // sums along each row
    for (Index y = 0; y < rows; ++y)
      for (Index x = 0; x < cols; ++x) {
        const double* cell = cells.data() + (y * cols + x) * 12 + 3;
        double* sum = &before[(y * (cols + 1) + x) * 9];
        for (int k = 0; k < 9; ++k) sum[9 + k] = sum[k] + cell[k];
      }
    tbb::parallel_for(tbb::blocked_range<Index>(0, count, 64), [&](const auto& range) {
      for (Index i = range.begin(); i != range.end(); ++i) {
        const double nx = normals(i, 0), ny = normals(i, 1), nz = normals(i, 2);
        const double flat = std::hypot(nx, nz), lon = std::atan2(-nx, nz);
        for (Index y = 0; y < rows; ++y) {
          const double lat = kPi * (0.5 - (double(y) + 0.5) / double(rows));
          const double a = ny * std::sin(lat), b = flat * std::cos(lat);
          if (a <= -b) continue;
          const double half = a >= b ? kPi : std::acos(-a / b);
          double m[9]{};
          const auto add = [&](double at, double sign) {
            const double u = std::clamp(at, 0.0, double(cols));
            const Index x = std::min(Index(u), cols - 1);
            const double* p = &before[(y * (cols + 1) + x) * 9];
            for (int k = 0; k < 9; ++k) m[k] += sign * (p[k] + (u - double(x)) * (p[9 + k] - p[k]));
          };
          const auto pixel = [&](double angle) { return (angle / (2 * kPi) + 0.5) * double(cols); };
          const double from = pixel(lon - half), to = pixel(lon + half), w = double(cols);
          add(to, 1), add(from, -1);
          if (from < 0) add(w, 1), add(from + w, -1);  // around the seam
          if (to > w) add(to - w, 1), add(0, -1);
          for (int c = 0; c < 3; ++c) out[3 * i + c] += nx * m[c] + ny * m[3 + c] + nz * m[6 + c];
        }
        for (int c = 0; c < 3; ++c) out[3 * i + c] = std::max(out[3 * i + c], 0.0);
      }
    });
  }
  return owned<Out2>(std::move(out), {std::size_t(count), 3});
}

// A tree over the cells, each node with its energy at the energy's centroid.
class Tree {
 public:
  struct Node {
    float energy[3];
    float x, y, z;     // of the energy
    float solid;       // steradians
    float u, v, w;     // their middle
    float radius2;     // square of the farthest that light of it lies from its centroid
    float pad;
  };

  explicit Tree(const Cells& cells) {
    const int rows = int(cells.shape(0)), cols = int(cells.shape(1));
    sizes_.push_back({rows, cols, 0});
    while (sizes_.back().rows % 2 == 0 && sizes_.back().rows > 2)
      sizes_.push_back({sizes_.back().rows / 2, sizes_.back().cols / 2, 0});
    Index total = 0;
    for (Size& size : sizes_) size.first = total, total += Index(size.rows) * size.cols;
    nodes_.resize(total);
    std::vector<double> sums(cells.data(), cells.data() + cells.size());
    for (std::size_t level = 0; level < sizes_.size(); ++level) {
      const Size& size = sizes_[level];
      if (level > 0) {
        const Size& fine = sizes_[level - 1];
        std::vector<double> next(Index(size.rows) * size.cols * 12);
        for (int y = 0; y < fine.rows; ++y)
          for (int x = 0; x < fine.cols; ++x)
            for (int k = 0; k < 12; ++k)
              next[(Index(y / 2) * size.cols + x / 2) * 12 + k] +=
                  sums[(Index(y) * fine.cols + x) * 12 + k];
        sums.swap(next);
      }
      for (int y = 0; y < size.rows; ++y)
        for (int x = 0; x < size.cols; ++x)
          nodes_[size.first + Index(y) * size.cols + x] =
              node(&sums[(Index(y) * size.cols + x) * 12], y, x, size);
    }
  }

  // Sum of K(q) E and of K(q) Omega with q = 1 - cos: the GGX lobe of n = v = r, D(h) G2 / (n.v)
  // with Smith's height-correlated G2; sin^2 of h is q / 2.
  void gather(const float (&d)[3], float alpha2, float opening2, double (&sum)[4]) const {
    struct Place {
      int level, y, x;
    };
    Place stack[256];
    const float width2 = 4 * std::min(alpha2, 0.04f);  // of the lobe, where it is narrow
    int depth = 0;
    const int top = int(sizes_.size()) - 1;
    for (int y = 0; y < sizes_[top].rows; ++y)
      for (int x = 0; x < sizes_[top].cols; ++x) {
        stack[depth++] = {top, y, x};
        while (depth > 0) {
          const Place p = stack[--depth];
          const Size& size = sizes_[p.level];
          const Node& n = nodes_[size.first + Index(p.y) * size.cols + p.x];
          const auto away = [&](float a, float b, float c) {
            a -= d[0], b -= d[1], c -= d[2];
            return (a * a + b * b + c * c) / 2;
          };
          const float middle = away(n.u, n.v, n.w);
          if (p.level > 0 && n.radius2 > opening2 * (2 * middle + width2)) {
            for (int j = 0; j < 4; ++j)
              stack[depth++] = {p.level - 1, 2 * p.y + j / 2, 2 * p.x + j % 2};
            continue;
          }
          const auto lobe = [&](float q) {
            if (!(q < 1)) return 0.f;
            const float t = alpha2 + q / 2 * (1 - alpha2), nl = 1 - q;
            return nl / (t * t * (nl + std::sqrt(nl * nl * (1 - alpha2) + alpha2)));
          };
          const float k = lobe(away(n.x, n.y, n.z));
          for (int c = 0; c < 3; ++c) sum[c] += double(k * n.energy[c]);
          sum[3] += double(lobe(middle) * n.solid);
        }
      }
  }

 private:
  struct Size {
    int rows, cols;
    Index first;
  };

  static Node node(const double* m, int y, int x, const Size& size) {
    const double top = kPi * (0.5 - double(y) / size.rows), step = 2 * kPi / size.cols;
    const double bottom = top - kPi / size.rows, lon = (double(x) + 0.5) * step - kPi;
    const double lat = (top + bottom) / 2, half = (top - bottom) / 2;
    Node n{};
    for (int c = 0; c < 3; ++c) n.energy[c] = float(m[c]);
    n.solid = float(2 * std::cos(lat) * std::sin(half) * step);
    const double level = half + std::cos(2 * lat) * std::sin(2 * half) / 2;
    const double chord = 2 * std::sin(step / 2);
    const double mid[3] = {-level * chord * std::sin(lon),
                           std::cos(lat) * std::sin(half) * 2 * std::sin(lat) * std::cos(half) * step,
                           level * chord * std::cos(lon)};
    double lit[3]{};
    for (int c = 0; c < 3; ++c)
      for (int k = 0; k < 3; ++k) lit[k] += kLuminance[c] * m[3 + 3 * k + c];
    const auto length = [](const double* v) {
      return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    };
    const double l = length(mid), e = length(lit);
    n.u = float(mid[0] / l), n.v = float(mid[1] / l), n.w = float(mid[2] / l);
    const double* at = e > 0 ? lit : mid;
    const double s = e > 0 ? e : l;
    n.x = float(at[0] / s), n.y = float(at[1] / s), n.z = float(at[2] / s);
    const bool equator = top > 0 && bottom < 0;
    const double wide = equator ? 1 : std::max(std::cos(top), std::cos(bottom));
    const double off = std::sqrt((n.x - n.u) * (n.x - n.u) + (n.y - n.v) * (n.y - n.v) +
                                 (n.z - n.w) * (n.z - n.w));
    const double radius = std::sqrt(half * half + wide * wide * step * step / 4) + off;
    n.radius2 = float(radius * radius);
    return n;
  }

  std::vector<Size> sizes_;
  std::vector<Node> nodes_;
};

// Radiance seen in the lobe of roughness alpha about `directions` (N, S, 3), mean over the S.
Out2 prefilter(const Cells& cells,
               const nb::ndarray<const double, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>&
                   directions,
               double alpha, double opening) {
  const Index count = Index(directions.shape(0)), samples = Index(directions.shape(1));
  if (cells.shape(0) < 1 || cells.shape(1) != 2 * cells.shape(0))
    throw nb::value_error("cells must be 2:1");
  std::vector<double> out(3 * count);
  {
    nb::gil_scoped_release release;
    const Tree tree(cells);
    tbb::parallel_for(tbb::blocked_range<Index>(0, count, 16), [&](const auto& range) {
      for (Index i = range.begin(); i != range.end(); ++i)
        for (Index s = 0; s < samples; ++s) {
          const double* d = directions.data() + 3 * (i * samples + s);
          double sum[4]{};
          tree.gather({float(d[0]), float(d[1]), float(d[2])}, float(alpha * alpha),
                      float(opening * opening), sum);
          for (int c = 0; c < 3; ++c) out[3 * i + c] += sum[c] / sum[3] / double(samples);
        }
    });
  }
  return owned<Out2>(std::move(out), {std::size_t(count), 3});
}

// The path integral itself, cell by cell: integral of L D G / (4 n.v) times 1 - Fc and Fc, with
// Fc = (1 - v.h)^5 and Smith's height-correlated G; (N, 2, 3).
Out3 reflected(const Cells& cells, const Vectors& normals, const Vectors& views, double alpha) {
  const Index rows = Index(cells.shape(0)), cols = Index(cells.shape(1));
  const Index count = Index(normals.shape(0));
  if (Index(views.shape(0)) != count) throw nb::value_error("as many views as normals");
  std::vector<double> out(6 * count);
  {
    nb::gil_scoped_release release;
    struct Source {
      double d[3], e[3];
    };
    std::vector<Source> sources;
    for (Index k = 0; k < rows * cols; ++k) {
      const double* m = cells.data() + 12 * k;
      Source s{};
      double length = 0;
      for (int axis = 0; axis < 3; ++axis) {
        for (int c = 0; c < 3; ++c) s.d[axis] += kLuminance[c] * m[3 + 3 * axis + c];
        length += s.d[axis] * s.d[axis];
      }
      if (!(length > 0)) continue;
      for (double& v : s.d) v /= std::sqrt(length);
      for (int c = 0; c < 3; ++c) s.e[c] = m[c];
      sources.push_back(s);
    }
    const double a2 = alpha * alpha;
    tbb::parallel_for(tbb::blocked_range<Index>(0, count, 1), [&](const auto& range) {
      for (Index i = range.begin(); i != range.end(); ++i) {
        const double n[3] = {normals(i, 0), normals(i, 1), normals(i, 2)};
        const double v[3] = {views(i, 0), views(i, 1), views(i, 2)};
        const double nv = n[0] * v[0] + n[1] * v[1] + n[2] * v[2];
        double sum[6]{};
        for (const Source& s : sources) {
          const double nl = n[0] * s.d[0] + n[1] * s.d[1] + n[2] * s.d[2];
          if (!(nl > 0 && nv > 0)) continue;
          const double vl = v[0] * s.d[0] + v[1] * s.d[1] + v[2] * s.d[2];
          const double length = std::sqrt(2 + 2 * vl);
          const double nh = (nl + nv) / length, vh = length / 2;
          // 1 - nh^2 from the difference, for narrow lobes
          double sin2 = 0;
          for (int k = 0; k < 3; ++k) {
            const double t = (s.d[k] + v[k]) / length - nh * n[k];
            sin2 += t * t;
          }
          const double t = a2 * nh * nh + sin2;
          const double smith = nl * std::sqrt(nv * nv * (1 - a2) + a2) +
                               nv * std::sqrt(nl * nl * (1 - a2) + a2);
          // D G2 / (4 nl nv) nl, with G2 = 2 nl nv / smith
          const double f = a2 / (kPi * t * t) / (2 * smith) * nl;
          const double fc = std::pow(1 - vh, 5);
          for (int c = 0; c < 3; ++c) {
            sum[c] += f * (1 - fc) * s.e[c];
            sum[3 + c] += f * fc * s.e[c];
          }
        }
        std::copy(sum, sum + 6, &out[6 * i]);
      }
    });
  }
  return owned<Out3>(std::move(out), {std::size_t(count), 2, 3});
}

}  // namespace

NB_MODULE(convolve_kernel, m) {
  m.def("irradiance", &irradiance);
  m.def("prefilter", &prefilter);
  m.def("reflected", &reflected);
}
