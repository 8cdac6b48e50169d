// Resampling of environment maps that keeps the energy of small bright lights.
//
// The source is split into L = base + hot. `base` is gathered: L_j = sum_k L(R d_k) J_k / sum_k J_k
// over sub-samples of the target pixel's footprint. `hot`, what rises above a cap, is cut into
// pieces smaller than a target pixel and scattered as energy, L dOmega over the exact Omega_j, so
// that none of it falls between the samples.
//
// Directions are in camera axes (x right, y down, z forward), pixel centres at integers.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>
#include <tuple>
#include <vector>

namespace nb = nanobind;

namespace {

constexpr float kPi = std::numbers::pi_v<float>;
using Index = std::ptrdiff_t;
typedef float Float4 __attribute__((vector_size(16)));

struct Vec {
  float x, y, z;
};
Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec cross(Vec a, Vec b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
float length(Vec a) { return std::sqrt(dot(a, a)); }

struct Matrix {
  Vec row[3];
  Vec operator*(Vec d) const { return {dot(row[0], d), dot(row[1], d), dot(row[2], d)}; }
  Matrix transposed() const {
    return {{{row[0].x, row[1].x, row[2].x},
             {row[0].y, row[1].y, row[2].y},
             {row[0].z, row[1].z, row[2].z}}};
  }
};

// Six faces in camera axes and their places in the horizontal cross.
struct Face {
  Vec forward, right, down;
  int column, row;
};
constexpr Face kFaces[6] = {
    {{0, 0, 1}, {1, 0, 0}, {0, 1, 0}, 1, 1},    // front
    {{1, 0, 0}, {0, 0, -1}, {0, 1, 0}, 2, 1},   // right
    {{0, 0, -1}, {-1, 0, 0}, {0, 1, 0}, 3, 1},  // back
    {{-1, 0, 0}, {0, 0, 1}, {0, 1, 0}, 0, 1},   // left
    {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}, 1, 0},   // up
    {{0, 1, 0}, {1, 0, 0}, {0, 0, -1}, 1, 2},   // down
};

int face_of(Vec d) {
  const float x = std::abs(d.x), y = std::abs(d.y), z = std::abs(d.z);
  if (z >= x && z >= y) return d.z > 0 ? 0 : 2;
  if (x >= y) return d.x > 0 ? 1 : 3;
  return d.y < 0 ? 4 : 5;
}

// Minimax polynomials in place of libm's calls, which would take most of the time; errors below
// 3e-7 rad, float's own size.
template <std::size_t n>
float horner(const float (&c)[n], float s) {
  float p = c[n - 1];
  for (std::size_t k = n - 1; k-- > 0;) p = p * s + c[k];
  return p;
}
float arc_tangent(float y, float x) {
  static constexpr float c[] = {9.999999842e-01f,  -3.333306678e-01f, 1.999248358e-01f,
                                -1.420257051e-01f, 1.063675410e-01f,  -7.495445444e-02f,
                                4.258760747e-02f,  -1.600503050e-02f, 2.834064299e-03f};
  const float ax = std::abs(x), ay = std::abs(y), high = std::max(ax, ay);
  const float t = high > 0 ? std::min(ax, ay) / high : 0.f;
  float angle = t * horner(c, t * t);
  if (ay > ax) angle = kPi / 2 - angle;
  if (x < 0) angle = kPi - angle;
  return y < 0 ? -angle : angle;
}
float sine(float x) {  // within a few turns
  static constexpr float c[] = {1.f,
                                -1.666666662e-01f,
                                8.333330978e-03f,
                                -1.984086155e-04f,
                                2.752528711e-06f,
                                -2.388949816e-08f};
  const float k = std::nearbyint(x / kPi), r = x - k * kPi, value = r * horner(c, r * r);
  return int(k) & 1 ? -value : value;
}
float cosine(float x) { return sine(kPi / 2 - x); }

// Linear interpolation in a table over [0, 1].
float lookup(const std::vector<float>& table, float u) {
  const float s = std::clamp(u, 0.f, 1.f) * float(table.size() - 1);
  const Index i = std::min(Index(s), Index(table.size()) - 2);
  return table[i] + (s - float(i)) * (table[i + 1] - table[i]);
}

using Table = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;

// Where a face of a cube stands in the picture, in faces.
struct Placed {
  Vec forward, right, down;
  float column, row;
};

// One mapping between directions and pixels. Radial ones and arbitrary lenses come as tables.
struct Projection {
  enum class Kind { latlong, cube, octahedral, radial, table } kind{};
  int width = 0, height = 0;
  // cube: pixels a side of a face
  int face = 0;
  std::array<Placed, 6> faces{};
  // radial: pixel = centre + (fx, fy) * r(theta) * (cos phi, sin phi)
  float fx = 1, fy = 1, cx = 0, cy = 0, max_angle = 0, rim = 0;
  std::vector<float> radius;          // r over theta / max_angle
  std::vector<float> angle, density;  // theta and dOmega / dA over u = 1 - sqrt(1 - r / rim)
  // table: pixels over the six faces (6, n, n, 2), directions of pixel corners (H + 1, W + 1, 3)
  int nodes = 0;
  std::vector<float> pixels, directions;

  bool inside(float x, float y) const {
    return x >= -0.5f && y >= -0.5f && x <= float(width) - 0.5f && y <= float(height) - 0.5f;
  }

  bool project(Vec d, float& x, float& y) const {
    switch (kind) {
      case Kind::latlong:
        x = (arc_tangent(d.x, d.z) / (2 * kPi) + 0.5f) * float(width) - 0.5f;
        y = (arc_tangent(d.y, std::sqrt(d.x * d.x + d.z * d.z)) / kPi + 0.5f) * float(height) - 0.5f;
        return true;
      case Kind::cube: {
        const Placed* best = faces.data();
        for (const Placed& f : faces)
          if (dot(d, f.forward) > dot(d, best->forward)) best = &f;
        const float w = dot(d, best->forward), n = float(face);
        x = (best->column + (dot(d, best->right) / w + 1) / 2) * n - 0.5f;
        y = (best->row + (dot(d, best->down) / w + 1) / 2) * n - 0.5f;
        return true;
      }
      case Kind::octahedral: {
        const float scale = 1 / (std::abs(d.x) + std::abs(d.y) + std::abs(d.z));
        float u = scale * d.x, v = scale * d.y;
        if (d.z < 0) {
          const float p = std::copysign(1 - std::abs(v), u), q = std::copysign(1 - std::abs(u), v);
          u = p, v = q;
        }
        x = (u + 1) / 2 * float(width) - 0.5f;
        y = (v + 1) / 2 * float(height) - 0.5f;
        return true;
      }
      case Kind::radial: {
        const float rho = std::sqrt(d.x * d.x + d.y * d.y);
        const float theta = arc_tangent(rho, d.z);
        if (!(theta <= max_angle)) return false;
        const float s = rho > 0 ? lookup(radius, theta / max_angle) / rho : 0.f;
        x = cx + fx * s * d.x;
        y = cy + fy * s * d.y;
        return inside(x, y);
      }
      case Kind::table: {
        const int k = face_of(d);
        const Face& f = kFaces[k];
        const float w = dot(d, f.forward), last = float(nodes - 1);
        const float a = std::clamp((dot(d, f.right) / w + 1) / 2 * last, 0.f, last);
        const float b = std::clamp((dot(d, f.down) / w + 1) / 2 * last, 0.f, last);
        const int i = std::min(int(a), nodes - 2), j = std::min(int(b), nodes - 2);
        const float u = a - float(i), v = b - float(j);
        const float* p = pixels.data() + 2 * ((Index(k) * nodes + j) * nodes + i);
        const float* q = p + 2 * Index(nodes);
        x = (1 - v) * ((1 - u) * p[0] + u * p[2]) + v * ((1 - u) * q[0] + u * q[2]);
        y = (1 - v) * ((1 - u) * p[1] + u * p[3]) + v * ((1 - u) * q[1] + u * q[3]);
        return inside(x, y);  // false for NaN, too
      }
    }
    return false;
  }

  // Direction through a pixel and dOmega / dA there (up to a factor for the whole map).
  bool unproject(float x, float y, Vec& d, float& jacobian) const {
    switch (kind) {
      case Kind::latlong: {
        const float lon = ((x + 0.5f) / float(width) - 0.5f) * 2 * kPi;
        const float lat = ((y + 0.5f) / float(height) - 0.5f) * kPi;
        const float c = std::max(cosine(lat), 0.f);
        d = {sine(lon) * c, sine(lat), cosine(lon) * c};
        jacobian = c;
        return true;
      }
      case Kind::cube: {
        const float n = float(face), s = (x + 0.5f) / n, t = (y + 0.5f) / n;
        for (const Placed& f : faces) {
          const float a = 2 * (s - f.column) - 1, b = 2 * (t - f.row) - 1;
          if (a < -1 || a >= 1 || b < -1 || b >= 1) continue;
          const float norm = 1 / std::sqrt(1 + a * a + b * b);
          d = norm * (f.forward + a * f.right + b * f.down);
          jacobian = norm * norm * norm;
          return true;
        }
        return false;
      }
      case Kind::octahedral: {
        float u = 2 * (x + 0.5f) / float(width) - 1, v = 2 * (y + 0.5f) / float(height) - 1;
        if (std::abs(u) > 1 || std::abs(v) > 1) return false;
        const float z = 1 - std::abs(u) - std::abs(v);
        if (z < 0) {
          const float p = std::copysign(1 - std::abs(v), u), q = std::copysign(1 - std::abs(u), v);
          u = p, v = q;
        }
        const float norm = 1 / std::sqrt(u * u + v * v + z * z);
        d = {norm * u, norm * v, norm * z};
        jacobian = norm * norm * norm;
        return true;
      }
      case Kind::radial: {
        const float px = (x - cx) / fx, py = (y - cy) / fy, r = std::sqrt(px * px + py * py);
        if (r > rim) return false;
        const float u = 1 - std::sqrt(1 - r / rim);
        const float theta = lookup(angle, u), s = r > 0 ? sine(theta) / r : 0.f;
        d = {s * px, s * py, cosine(theta)};
        jacobian = lookup(density, u);
        return true;
      }
      case Kind::table: {
        const float a = x + 0.5f, b = y + 0.5f;
        if (!(a >= 0 && b >= 0 && a <= float(width) && b <= float(height))) return false;
        const int i = std::min(int(a), width - 1), j = std::min(int(b), height - 1);
        const float u = a - float(i), v = b - float(j);
        const float* p = directions.data() + 3 * (Index(j) * (width + 1) + i);
        const float* q = p + 3 * (Index(width) + 1);
        const Vec p0{p[0], p[1], p[2]}, p1{p[3], p[4], p[5]};
        const Vec q0{q[0], q[1], q[2]}, q1{q[3], q[4], q[5]};
        const Vec top = p0 + u * (p1 - p0), bottom = q0 + u * (q1 - q0);
        const Vec m = top + v * (bottom - top);
        const float norm = length(m);
        if (!(norm > 0)) return false;  // NaN: the lens has no such pixel
        const Vec dx = (1 - v) * (p1 - p0) + v * (q1 - q0);
        d = (1 / norm) * m;
        jacobian = std::abs(dot(m, cross(dx, bottom - top))) / (norm * norm * norm);
        return true;
      }
    }
    return false;
  }
};

using Source = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Plane = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

float largest(const float* rgb) { return std::max({rgb[0], rgb[1], rgb[2]}); }

// The part of a pixel under the cap, its colour kept.
float base_share(const float* rgb, float cap) {
  const float top = largest(rgb);
  return top > cap ? cap / top : 1.f;
}

void for_rows(int count, const auto& body) {
  tbb::parallel_for(tbb::blocked_range<int>(0, count), [&](const tbb::blocked_range<int>& rows) {
    for (int y = rows.begin(); y != rows.end(); ++y) body(y);
  });
}

// The base as a cubic B-spline whose cell averages are the pixels, limited to stay above the
// smallest of the 3 x 3 pixels around (Zhang and Shu): a + t (H - a), which keeps the average.
class Histospline {
 public:
  Histospline(const Source& source, const Mask& valid, const Projection& projection, float cap)
      : width_(projection.width), height_(projection.height), stride_(width_ + 2 * kPad) {
    const Index rows = height_ + 2 * kPad;
    average_.resize(stride_ * rows);
    build_average(source, valid, projection, cap);
    coefficient_ = average_;
    prefilter();
    limit();
  }

  Float4 operator()(float x, float y) const {
    const int i = std::clamp(int(std::floor(x + 0.5f)), 0, width_ - 1);
    const int j = std::clamp(int(std::floor(y + 0.5f)), 0, height_ - 1);
    const Index cell = at(i, j);
    const Float4 a = average_[cell];
    const float t = coefficient_[cell][3];
    const float fx = std::floor(x), fy = std::floor(y);
    float u[4], v[4];
    weights(x - fx, u);
    weights(y - fy, v);
    const Float4* c = &coefficient_[at(int(fx) - 1, int(fy) - 1)];
    Float4 sum{};
    for (int n = 0; n < 4; ++n, c += stride_)
      sum += v[n] * (u[0] * c[0] + u[1] * c[1] + u[2] * c[2] + u[3] * c[3]);
    return a + t * (sum - a);
  }

 private:
  static constexpr int kPad = 16;  // the filter's memory: 0.361^16 = 1e-7

  Index at(int x, int y) const { return (y + kPad) * stride_ + x + kPad; }

  static void weights(float f, float (&w)[4]) {
    const float g = 1 - f;
    w[0] = g * g * g / 6;
    w[1] = 2.f / 3 - f * f * (2 - f) / 2;
    w[2] = 2.f / 3 - g * g * (2 - g) / 2;
    w[3] = f * f * f / 6;
  }

  void build_average(const Source& source, const Mask& valid, const Projection& projection,
                     float cap) {
    std::vector<Index> missing;
    for (int y = 0; y < height_; ++y)
      for (int x = 0; x < width_; ++x) {
        const Index k = Index(y) * width_ + x;
        const float* rgb = source.data() + 3 * k;
        const float s = base_share(rgb, cap);
        if (valid.data()[k])
          average_[at(x, y)] = Float4{s * rgb[0], s * rgb[1], s * rgb[2], 1};
        else
          missing.push_back(k);
      }
    // Grow the valid part, so that nothing dark from outside leaks in over the rim.
    for (int step = 0; step < 4 && !missing.empty(); ++step) {
      std::vector<std::pair<Index, Float4>> grown;
      std::vector<Index> left;
      for (const Index k : missing) {
        const int x = int(k % width_), y = int(k / width_);
        Float4 sum{};
        for (int v = std::max(y - 1, 0); v <= std::min(y + 1, height_ - 1); ++v)
          for (int u = std::max(x - 1, 0); u <= std::min(x + 1, width_ - 1); ++u)
            if (average_[at(u, v)][3] > 0) sum += average_[at(u, v)];
        if (sum[3] > 0)
          grown.emplace_back(at(x, y), sum / sum[3]);
        else
          left.push_back(k);
      }
      for (const auto& [k, value] : grown) average_[k] = value;
      missing.swap(left);
    }
    const bool round = projection.kind == Projection::Kind::latlong;
    for (int y = -kPad; y < height_ + kPad; ++y)
      for (int x = -kPad; x < width_ + kPad; ++x) {
        if (x >= 0 && y >= 0 && x < width_ && y < height_) continue;
        int u = x, v = y;
        if (round) {  // over the pole to the opposite meridian
          if (v < 0) v = -1 - v, u += width_ / 2;
          if (v >= height_) v = 2 * height_ - 1 - v, u += width_ / 2;
          u = ((u % width_) + width_) % width_;
        }
        average_[at(x, y)] =
            average_[at(std::clamp(u, 0, width_ - 1), std::clamp(v, 0, height_ - 1))];
      }
  }

  // Inverse of the cell average of a cubic B-spline, (1, 76, 230, 76, 1) / 384.
  void prefilter() {
    const int rows = height_ + 2 * kPad;
    for_rows(rows, [&](int y) { filter(&coefficient_[y * stride_], stride_, 1, 1); });
    constexpr int block = 16;
    for_rows(int((stride_ + block - 1) / block), [&](int b) {
      const Index first = Index(b) * block;
      filter(&coefficient_[first], rows, stride_, std::min<Index>(block, stride_ - first));
    });
  }

  // `lanes` neighbouring lines of `count` values, `step` apart.
  static void filter(Float4* c, Index count, Index step, Index lanes) {
    for (const float z : {-0.36134122590022f, -0.01372542929734f}) {
      const float gain = (1 - z) * (1 - 1 / z);
      for (Index l = 0; l < lanes; ++l) {
        Float4 start{};
        float power = 1;
        for (Index k = 0; k < std::min<Index>(count, 2 * kPad); ++k, power *= z)
          start += power * c[k * step + l];
        c[l] = start;
      }
      for (Index k = 1; k < count; ++k)
        for (Index l = 0; l < lanes; ++l) c[k * step + l] += z * c[(k - 1) * step + l];
      for (Index l = 0; l < lanes; ++l) {
        Float4& last = c[(count - 1) * step + l];
        last = z / (z * z - 1) * (last + z * c[(count - 2) * step + l]);
      }
      for (Index k = count - 2; k >= 0; --k)
        for (Index l = 0; l < lanes; ++l)
          c[k * step + l] = z * (c[(k + 1) * step + l] - c[k * step + l]);
      for (Index k = 0; k < count; ++k)
        for (Index l = 0; l < lanes; ++l) c[k * step + l] *= gain;
    }
  }

  // t from the Bezier points of the four patches in a cell, whose hull holds the spline.
  void limit() {
    // c(j-2 .. j+2) to the seven Bezier points over [j - 1/2, j + 1/2]
    float bezier[7][5]{};
    for (int k = 0; k < 5; ++k) {
      float c[5]{};
      c[k] = 1;
      const auto span = [&](int i) {  // Bezier points of the patch [i, i + 1]
        return std::array<float, 4>{(c[i - 1] + 4 * c[i] + c[i + 1]) / 6, (2 * c[i] + c[i + 1]) / 3,
                                    (c[i] + 2 * c[i + 1]) / 3, (c[i] + 4 * c[i + 1] + c[i + 2]) / 6};
      };
      const auto left = span(1), right = span(2);
      bezier[0][k] = (left[0] + 3 * left[1] + 3 * left[2] + left[3]) / 8;
      bezier[1][k] = (left[1] + 2 * left[2] + left[3]) / 4;
      bezier[2][k] = (left[2] + left[3]) / 2;
      bezier[3][k] = left[3];
      bezier[4][k] = (right[0] + right[1]) / 2;
      bezier[5][k] = (right[0] + 2 * right[1] + right[2]) / 4;
      bezier[6][k] = (right[0] + 3 * right[1] + 3 * right[2] + right[3]) / 8;
    }
    std::vector<float> t(Index(width_) * height_);
    for_rows(height_, [&](int y) {
      for (int x = 0; x < width_; ++x) {
        Float4 lowest = average_[at(x, y)];
        for (int v = -1; v <= 1; ++v)
          for (int u = -1; u <= 1; ++u) lowest = lower(lowest, average_[at(x + u, y + v)]);
        Float4 hull = average_[at(x, y)];
        for (const auto& across : bezier) {
          Float4 column[5];
          for (int v = 0; v < 5; ++v) {
            const Float4* c = &coefficient_[at(x - 2, y - 2 + v)];
            column[v] = across[0] * c[0] + across[1] * c[1] + across[2] * c[2] +
                        across[3] * c[3] + across[4] * c[4];
          }
          for (const auto& down : bezier)
            hull = lower(hull, down[0] * column[0] + down[1] * column[1] + down[2] * column[2] +
                                   down[3] * column[3] + down[4] * column[4]);
        }
        const Float4 a = average_[at(x, y)];
        float share = 1;
        for (int c = 0; c < 3; ++c)
          if (hull[c] < lowest[c]) share = std::min(share, (a[c] - lowest[c]) / (a[c] - hull[c]));
        t[Index(y) * width_ + x] = share;
      }
    });
    for_rows(height_, [&](int y) {
      for (int x = 0; x < width_; ++x) coefficient_[at(x, y)][3] = t[Index(y) * width_ + x];
    });
  }

  static Float4 lower(Float4 a, Float4 b) { return a < b ? a : b; }

  int width_, height_;
  Index stride_;
  std::vector<Float4> average_, coefficient_;  // w: validity; the limiter's t
};

// A piece of a hot cell: where it lands in the target, if it does, and its share.
struct Piece {
  float x, y;
  bool lands;
  float weight;
};

struct Warp {
  const Source& source;
  const Mask& valid;
  const Plane& source_solid;
  const Plane& target_solid;
  const Projection& from;
  const Projection& to;
  Matrix source_from_target;
  float cap;

  Index source_cell(float x, float y) const {
    int i = int(std::floor(x + 0.5f)), j = int(std::floor(y + 0.5f));
    if (i == from.width) i = from.kind == Projection::Kind::latlong ? 0 : from.width - 1;
    return Index(std::clamp(j, 0, from.height - 1)) * from.width + std::max(i, 0);
  }

  // Whether neither the middle nor the corners of a target pixel see the source. A pixel at the
  // target's own rim, of which only a sliver is valid, is for `gather` to decide.
  bool unseen(float x, float y) const {
    bool known = false;
    for (const auto& [u, v] : {std::pair{0.f, 0.f}, {-.49f, -.49f}, {.49f, -.49f}, {-.49f, .49f},
                               {.49f, .49f}}) {
      Vec d;
      float j, p, q;
      if (!to.unproject(x + u, y + v, d, j)) continue;
      known = true;
      if (from.project(source_from_target * d, p, q)) return false;
    }
    return known;
  }

  // Sub-samples across and down a target pixel: so many that no source pixel is passed over.
  std::pair<int, int> samples(int x, int y, float solid, float typical, bool smooth) const {
    const float fx = float(x), fy = float(y), density = smooth ? 2.f : 1.6f;
    Vec c, e, w, n, s;
    float j, u, v, cell = typical;
    const bool seen = to.unproject(fx, fy, c, j);
    if (seen && from.project(source_from_target * c, u, v)) {
      const float there = source_solid.data()[source_cell(u, v)];
      if (there > 0) cell = there;
    }
    float across = 2 * std::sqrt(solid), down = across;
    constexpr float h = 0.499f;
    if (to.unproject(fx + h, fy, e, j) && to.unproject(fx - h, fy, w, j) &&
        to.unproject(fx, fy + h, s, j) && to.unproject(fx, fy - h, n, j)) {
      across = length(e - w);
      down = length(s - n);
    }
    const float least = smooth ? 3.f : 2.f, scale = density / std::sqrt(cell);
    float nx = std::clamp(scale * across, least, 256.f);
    float ny = std::clamp(scale * down, least, 256.f);
    // Stretched pixels on a diagonal: bound the work by what the area needs.
    const float bound = 16 * std::max(4.f, solid / cell);
    if (nx * ny > bound) {
      const float shrink = std::sqrt(bound / (nx * ny));
      nx = std::max(least, nx * shrink);
      ny = std::max(least, ny * shrink);
    }
    return {int(std::ceil(nx)), int(std::ceil(ny))};
  }

  // The base in a direction of the target, and 1 in the fourth place; false where unseen.
  bool base(Vec d, const Histospline* spline, Float4& value) const {
    float x, y;
    if (!from.project(source_from_target * d, x, y)) return false;
    const Index cell = source_cell(x, y);
    if (!valid.data()[cell]) return false;
    if (spline) {
      value = (*spline)(x, y);
    } else {
      const float* rgb = source.data() + 3 * cell;
      const float s = base_share(rgb, cap);
      value = Float4{s * rgb[0], s * rgb[1], s * rgb[2], 1};
    }
    value[3] = 1;
    return true;
  }

  // A sliver at a disc's rim that all sub-samples miss takes the radiance of the nearest point.
  void at_rim(int x, int y, const Histospline* spline, double (&sum)[3], double& got,
              double& all) const {
    if (to.kind != Projection::Kind::radial) return;
    const float px = (float(x) - to.cx) / to.fx, py = (float(y) - to.cy) / to.fy;
    const float s = 0.99999f * to.rim / std::sqrt(px * px + py * py);
    Vec d;
    float jacobian;
    Float4 value;
    if (!to.unproject(to.cx + s * px * to.fx, to.cy + s * py * to.fy, d, jacobian)) return;
    all = 1;
    if (!base(d, spline, value)) return;
    got = 1;
    for (int c = 0; c < 3; ++c) sum[c] = value[c];
  }

  void gather(const Histospline* spline, float* out, float* coverage) const {
    double sum_solid = 0;
    Index seen = 0;
    for (Index k = 0; k < Index(from.width) * from.height; ++k)
      if (valid.data()[k] && source_solid.data()[k] > 0) sum_solid += source_solid.data()[k], ++seen;
    const float typical = seen ? float(sum_solid / double(seen)) : 1.f;
    for_rows(to.height, [&](int y) {
      for (int x = 0; x < to.width; ++x) {
        const Index k = Index(y) * to.width + x;
        const float solid = target_solid.data()[k];
        if (!(solid > 0) || unseen(float(x), float(y))) continue;
        const auto [nx, ny] = samples(x, y, solid, typical, spline != nullptr);
        double sum[3]{}, got = 0, all = 0;
        for (int b = 0; b < ny; ++b) {
          Float4 row{};
          float row_all = 0;
          const float v = float(y) - 0.5f + (float(b) + 0.5f) / float(ny);
          for (int a = 0; a < nx; ++a) {
            const float u = float(x) - 0.5f + (float(a) + 0.5f) / float(nx);
            Vec d;
            float jacobian;
            if (!to.unproject(u, v, d, jacobian)) continue;
            row_all += jacobian;
            Float4 value;
            if (base(d, spline, value)) row += jacobian * value;
          }
          for (int c = 0; c < 3; ++c) sum[c] += row[c];
          got += row[3];
          all += row_all;
        }
        if (all == 0) at_rim(x, y, spline, sum, got, all);
        if (got <= 0) continue;
        for (int c = 0; c < 3; ++c) out[3 * k + c] = float(std::max(sum[c] / got, 0.0));
        coverage[k] = float(std::min(got / all, 1.0));
      }
    });
  }

  // Distance in target pixels, around the seam of a panorama.
  float apart(float x0, float y0, float x1, float y1) const {
    float dx = std::abs(x1 - x0);
    if (to.kind == Projection::Kind::latlong) dx = std::min(dx, float(to.width) - dx);
    return std::max(dx, std::abs(y1 - y0));
  }

  // Cut a cell into pieces no larger than half a target pixel.
  void cut(float x, float y, float half, int depth, const Matrix& target_from_source,
           std::vector<Piece>& pieces) const {
    Vec d;
    float j, u = 0, v = 0;
    const bool here = from.unproject(x, y, d, j);
    const bool lands = here && to.project(target_from_source * d, u, v);
    bool fine = depth > 0;  // at least four pieces
    if (depth < 7) {
      for (const auto& [sx, sy] : {std::pair{-1.f, -1.f}, {1.f, -1.f}, {-1.f, 1.f}, {1.f, 1.f}}) {
        Vec corner;
        float jc, uc, vc;
        const float inset = half * 0.999f;
        const bool ok = from.unproject(x + sx * inset, y + sy * inset, corner, jc);
        const bool in = ok && to.project(target_from_source * corner, uc, vc);
        if (ok != here || in != lands) {
          fine = fine && depth >= 3;  // the rim of a lens: a few pieces suffice
        } else if (in && apart(u, v, uc, vc) > 0.25f) {
          fine = false;
        }
      }
    } else {
      fine = true;
    }
    if (fine) {
      if (here) pieces.push_back({u, v, lands, 4 * half * half * j});
      return;
    }
    const float h = half / 2;
    cut(x - h, y - h, h, depth + 1, target_from_source, pieces);
    cut(x + h, y - h, h, depth + 1, target_from_source, pieces);
    cut(x - h, y + h, h, depth + 1, target_from_source, pieces);
    cut(x + h, y + h, h, depth + 1, target_from_source, pieces);
  }

  struct Tally {
    Index cells = 0;
    double energy[3]{}, outside[3]{};
  };

  // Energy above the cap, cell by cell. Integer sums do not depend on the order of threads.
  Tally scatter(float* out, const float* coverage) const {
    Tally tally;
    std::vector<Index> hot;
    for (Index k = 0; k < Index(from.width) * from.height; ++k) {
      const float* rgb = source.data() + 3 * k;
      if (!valid.data()[k] || !(largest(rgb) > cap) || !(source_solid.data()[k] > 0)) continue;
      hot.push_back(k);
      for (int c = 0; c < 3; ++c)
        tally.energy[c] += double(rgb[c]) * (1 - base_share(rgb, cap)) * source_solid.data()[k];
    }
    tally.cells = Index(hot.size());
    if (hot.empty()) return tally;
    double quantum[3];
    for (int c = 0; c < 3; ++c)
      quantum[c] = std::max(tally.energy[c], std::numeric_limits<double>::min()) * 0x1p-60;
    const Index pixels = Index(to.width) * to.height;
    std::vector<std::int64_t> energy(3 * (pixels + 1));  // the last one: outside the target
    const Matrix target_from_source = source_from_target.transposed();
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, hot.size()), [&](const auto& range) {
      std::vector<Piece> pieces;
      for (std::size_t n = range.begin(); n != range.end(); ++n) {
        const Index k = hot[n];
        pieces.clear();
        cut(float(k % from.width), float(k / from.width), 0.5f, 0, target_from_source, pieces);
        double total = 0;
        for (const Piece& piece : pieces) total += piece.weight;
        const float* rgb = source.data() + 3 * k;
        const double above = (1 - base_share(rgb, cap)) * source_solid.data()[k];
        const auto add = [&](Index pixel, double share) {
          for (int c = 0; c < 3; ++c)
            std::atomic_ref(energy[3 * pixel + c])
                .fetch_add(std::int64_t(share * rgb[c] * above / quantum[c]),
                           std::memory_order_relaxed);
        };
        if (!(total > 0)) add(pixels, 1);
        for (const Piece& piece : pieces) {
          Index pixel = pixels;
          if (piece.lands) {
            int i = int(std::floor(piece.x + 0.5f)), j = int(std::floor(piece.y + 0.5f));
            if (i == to.width) i = to.kind == Projection::Kind::latlong ? 0 : to.width - 1;
            pixel = Index(std::clamp(j, 0, to.height - 1)) * to.width + std::max(i, 0);
            if (!(target_solid.data()[pixel] > 0 && coverage[pixel] > 0)) pixel = pixels;
          }
          if (total > 0) add(pixel, piece.weight / total);
        }
      }
    });
    for_rows(to.height, [&](int y) {
      for (Index k = Index(y) * to.width; k < Index(y + 1) * to.width; ++k)
        for (int c = 0; c < 3; ++c)
          if (const auto e = energy[3 * k + c])
            out[3 * k + c] += float(double(e) * quantum[c] /
                                    (double(target_solid.data()[k]) * coverage[k]));
    });
    for (int c = 0; c < 3; ++c) tally.outside[c] = double(energy[3 * pixels + c]) * quantum[c];
    return tally;
  }
};

template <class T>
T* zeros(std::size_t count) {
  return new T[count]();
}

auto warp(const Source& source, const Mask& valid, const Plane& source_solid,
          const Plane& target_solid, const Projection& from, const Projection& to,
          const nb::ndarray<const double, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>& rotation,
          float cap, bool smooth) {
  const auto same = [](const auto& array, const Projection& p) {
    return array.shape(0) == std::size_t(p.height) && array.shape(1) == std::size_t(p.width);
  };
  if (!same(source, from) || !same(valid, from) || !same(source_solid, from) ||
      !same(target_solid, to))
    throw nb::value_error("arrays and projections differ in size");
  Matrix m{};
  for (int i = 0; i < 3; ++i)
    m.row[i] = {float(rotation(i, 0)), float(rotation(i, 1)), float(rotation(i, 2))};
  const std::size_t pixels = std::size_t(to.width) * to.height;
  float* out = zeros<float>(3 * pixels);
  nb::capsule out_owner(out, [](void* p) noexcept { delete[] static_cast<float*>(p); });
  float* coverage = zeros<float>(pixels);
  nb::capsule coverage_owner(coverage, [](void* p) noexcept { delete[] static_cast<float*>(p); });
  Warp::Tally tally;
  {
    nb::gil_scoped_release release;
    const Warp w{source, valid, source_solid, target_solid, from, to, m, cap};
    if (smooth) {
      const Histospline spline(source, valid, from, cap);
      w.gather(&spline, out, coverage);
    } else {
      w.gather(nullptr, out, coverage);
    }
    tally = w.scatter(out, coverage);
  }
  using Rgb = nb::ndarray<nb::numpy, float, nb::ndim<3>>;
  using Grey = nb::ndarray<nb::numpy, float, nb::ndim<2>>;
  const std::size_t h = std::size_t(to.height), w = std::size_t(to.width);
  return std::tuple(Rgb(out, {h, w, 3}, out_owner), Grey(coverage, {h, w}, coverage_owner),
                    tally.cells,
                    std::tuple(tally.energy[0], tally.energy[1], tally.energy[2]),
                    std::tuple(tally.outside[0], tally.outside[1], tally.outside[2]));
}

std::vector<float> copy(const Table& table) {
  return {table.data(), table.data() + table.size()};
}

using Doubles = nb::ndarray<const double, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Result = nb::ndarray<nb::numpy, double, nb::ndim<2>>;

}  // namespace

NB_MODULE(kernel, m) {
  nb::set_leak_warnings(false);  // a mapping kept in a global is no leak
  nb::class_<Projection>(m, "Projection")
      .def_static("latlong",
                  [](int width, int height) {
                    return Projection{.kind = Projection::Kind::latlong, .width = width,
                                      .height = height};
                  })
      .def_static("octahedral",
                  [](int width, int height) {
                    return Projection{.kind = Projection::Kind::octahedral, .width = width,
                                      .height = height};
                  })
      .def_static("cube",
                  [](int width, int height, int face, const Table& axes, const Table& places) {
                    if (axes.size() != 54 || places.size() != 12)
                      throw nb::value_error("a cube has six faces");
                    Projection p{.kind = Projection::Kind::cube, .width = width, .height = height,
                                 .face = face};
                    for (std::size_t k = 0; k < 6; ++k) {
                      const float *a = axes.data() + 9 * k, *q = places.data() + 2 * k;
                      p.faces[k] = {{a[0], a[1], a[2]}, {a[3], a[4], a[5]}, {a[6], a[7], a[8]},
                                    q[0], q[1]};
                    }
                    return p;
                  })
      .def_static("radial",
                  [](int width, int height, float fx, float fy, float cx, float cy,
                     float max_angle, float rim, const Table& radius, const Table& angle,
                     const Table& density) {
                    return Projection{.kind = Projection::Kind::radial, .width = width,
                                      .height = height, .fx = fx, .fy = fy, .cx = cx, .cy = cy,
                                      .max_angle = max_angle, .rim = rim, .radius = copy(radius),
                                      .angle = copy(angle), .density = copy(density)};
                  })
      .def_static("table",
                  [](int width, int height, int nodes, const Table& pixels,
                     const Table& directions) {
                    if (pixels.size() != std::size_t(12) * nodes * nodes ||
                        directions.size() != std::size_t(3) * (width + 1) * (height + 1))
                      throw nb::value_error("tables of the wrong size");
                    return Projection{.kind = Projection::Kind::table, .width = width,
                                      .height = height, .nodes = nodes, .pixels = copy(pixels),
                                      .directions = copy(directions)};
                  })
      .def("project",
           [](const Projection& p, const Doubles& directions) {
             const std::size_t n = directions.shape(0);
             double* out = zeros<double>(2 * n);
             nb::capsule owner(out, [](void* q) noexcept { delete[] static_cast<double*>(q); });
             for (std::size_t k = 0; k < n; ++k) {
               float x, y;
               const Vec d{float(directions(k, 0)), float(directions(k, 1)),
                           float(directions(k, 2))};
               const bool ok = p.project(d, x, y);
               out[2 * k] = ok ? x : NAN;
               out[2 * k + 1] = ok ? y : NAN;
             }
             return Result(out, {n, 2}, owner);
           })
      .def("unproject", [](const Projection& p, const Doubles& pixels) {
        const std::size_t n = pixels.shape(0);
        double* out = zeros<double>(4 * n);
        nb::capsule owner(out, [](void* q) noexcept { delete[] static_cast<double*>(q); });
        for (std::size_t k = 0; k < n; ++k) {
          Vec d{};
          float j = NAN;
          const bool ok = p.unproject(float(pixels(k, 0)), float(pixels(k, 1)), d, j);
          const double values[4] = {d.x, d.y, d.z, j};
          for (int c = 0; c < 4; ++c) out[4 * k + c] = ok ? values[c] : NAN;
        }
        return Result(out, {n, 4}, owner);
      });
  m.def("warp", &warp);
}
