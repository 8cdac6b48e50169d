// The mappings between directions and pixels, many points at a time. Radial ones and arbitrary
// lenses come as tables. Directions are in camera axes, pixel centres at integers.
//
// A map consists of sheets on which neighbouring pixels are neighbours in the world: the six faces
// of a cube, elsewhere the picture itself.
#pragma once

#include <array>
#include <vector>

#include "vec.h"

namespace envmap {

constexpr int kBatch = 512;

struct Rays {
  float x[kBatch], y[kBatch], z[kBatch];
  float jacobian[kBatch];  // dOmega / dA up to a factor for the whole map; 0: no direction

  void set(int k, Vec d) { x[k] = d.x, y[k] = d.y, z[k] = d.z; }
  Vec at(int k) const { return {x[k], y[k], z[k]}; }
  void turn(const Matrix& m, int n) {
#pragma omp simd
    for (int k = 0; k < n; ++k) {
      const float a = x[k], b = y[k], c = z[k];
      x[k] = m.row[0].x * a + m.row[0].y * b + m.row[0].z * c;
      y[k] = m.row[1].x * a + m.row[1].y * b + m.row[1].z * c;
      z[k] = m.row[2].x * a + m.row[2].y * b + m.row[2].z * c;
    }
  }
};

struct Places {
  float x[kBatch], y[kBatch];   // on the sheet
  std::int32_t sheet[kBatch];   // -1: unseen
};

// A face of a cube: its axes, and its place in the picture, in faces.
struct Face {
  Vec forward, right, down;
  float column, row;
};

inline constexpr Face kFaces[6] = {
    {{0, 0, 1}, {1, 0, 0}, {0, 1, 0}, 1, 1},    // front
    {{1, 0, 0}, {0, 0, -1}, {0, 1, 0}, 2, 1},   // right
    {{0, 0, -1}, {-1, 0, 0}, {0, 1, 0}, 3, 1},  // back
    {{-1, 0, 0}, {0, 0, 1}, {0, 1, 0}, 0, 1},   // left
    {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}, 1, 0},   // up
    {{0, 1, 0}, {1, 0, 0}, {0, 0, -1}, 1, 2},   // down
};

inline int face_of(Vec d) {
  const float x = std::abs(d.x), y = std::abs(d.y), z = std::abs(d.z);
  if (z >= x && z >= y) return d.z > 0 ? 0 : 2;
  if (x >= y) return d.x > 0 ? 1 : 3;
  return d.y < 0 ? 4 : 5;
}

// A pixel of a picture.
struct Cell {
  int x, y;
};

struct Projection {
  enum class Kind { latlong, cube, octahedral, radial, table };
  Kind kind = Kind::latlong;
  int width = 0, height = 0;
  // cube: pixels a side of a face
  int face = 0;
  std::array<Face, 6> faces{};
  // radial: pixel = centre + (fx, fy) * r(theta) * (cos phi, sin phi)
  float fx = 1, fy = 1, cx = 0, cy = 0, max_angle = 0, rim = 0;
  std::vector<float> radius{};            // r over theta / max_angle
  std::vector<float> angle{}, density{};  // theta and dOmega / dA over u = 1 - sqrt(1 - r / rim)
  // table: pixels over the six faces (6, n, n, 2), directions of pixel corners (H + 1, W + 1, 3)
  int nodes = 0;
  std::vector<float> pixels{}, directions{};

  bool cubic() const { return kind == Kind::cube; }
  bool round() const { return kind == Kind::latlong; }
  int sheets() const { return cubic() ? 6 : 1; }
  int sheet_width() const { return cubic() ? face : width; }
  int sheet_height() const { return cubic() ? face : height; }
  // The pixel of the picture that a pixel of a sheet is.
  Cell pixel(int sheet, int x, int y) const {
    if (!cubic()) return {x, y};
    const Face& f = faces[std::size_t(sheet)];
    return {int(f.column) * face + x, int(f.row) * face + y};
  }
  // The nearest pixel of the picture to a place on a sheet.
  Cell nearest(int sheet, float x, float y) const {
    const int w = sheet_width(), h = sheet_height();
    int i = int(std::floor(x + 0.5f)), j = int(std::floor(y + 0.5f));
    if (i >= w) i = round() ? 0 : w - 1;
    if (i < 0) i = round() ? w - 1 : 0;
    return pixel(sheet, i, std::clamp(j, 0, h - 1));
  }

  void project(const Rays& d, int n, Places& p) const {
    switch (kind) {
      case Kind::latlong: {
        const float w = float(width), h = float(height);
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float x = d.x[k], y = d.y[k], z = d.z[k];
          p.x[k] = (arc_tangent(x, z) * (1 / (2 * kPi)) + 0.5f) * w - 0.5f;
          p.y[k] = (arc_tangent(y, std::sqrt(x * x + z * z)) * (1 / kPi) + 0.5f) * h - 0.5f;
          p.sheet[k] = 0;
        }
        return;
      }
      case Kind::cube: {
        const float half = 0.5f * float(face);
        float best[kBatch]{};
        for (std::int32_t i = 0; i < 6; ++i) {
          const Face f = faces[std::size_t(i)];
#pragma omp simd
          for (int k = 0; k < n; ++k) {
            const float x = d.x[k], y = d.y[k], z = d.z[k];
            const float w = f.forward.x * x + f.forward.y * y + f.forward.z * z;
            const float a = f.right.x * x + f.right.y * y + f.right.z * z;
            const float b = f.down.x * x + f.down.y * y + f.down.z * z;
            const bool more = w > best[k];
            best[k] = more ? w : best[k];
            p.x[k] = more ? a : p.x[k];
            p.y[k] = more ? b : p.y[k];
            p.sheet[k] = more ? i : p.sheet[k];
          }
        }
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float scale = best[k] > 0 ? half / best[k] : 0.f;
          p.x[k] = p.x[k] * scale + (half - 0.5f);
          p.y[k] = p.y[k] * scale + (half - 0.5f);
        }
        return;
      }
      case Kind::octahedral: {
        const float half = 0.5f * float(width);
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float x = d.x[k], y = d.y[k], z = d.z[k];
          const float scale = 1 / (std::abs(x) + std::abs(y) + std::abs(z));
          const float u = scale * x, v = scale * y;
          const float s = std::copysign(1 - std::abs(v), u), t = std::copysign(1 - std::abs(u), v);
          p.x[k] = ((z < 0 ? s : u) + 1) * half - 0.5f;
          p.y[k] = ((z < 0 ? t : v) + 1) * half - 0.5f;
          p.sheet[k] = 0;
        }
        return;
      }
      case Kind::radial: {
        const float* table = radius.data();
        const std::int32_t size = std::int32_t(radius.size());
        const float right = float(width) - 0.5f, bottom = float(height) - 0.5f;
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float a = d.x[k], b = d.y[k], rho = std::sqrt(a * a + b * b);
          const float theta = arc_tangent(rho, d.z[k]);
          const float r = lookup(table, size, theta / max_angle);
          const float s = rho > 0 ? r / rho : 0.f;
          const float x = cx + fx * s * a, y = cy + fy * s * b;
          const bool seen = (theta <= max_angle) & (x >= -0.5f) & (y >= -0.5f) & (x <= right) &
                            (y <= bottom);
          p.x[k] = x;
          p.y[k] = y;
          p.sheet[k] = seen ? 0 : -1;
        }
        return;
      }
      case Kind::table: {
        for (int k = 0; k < n; ++k) project_table(d.at(k), p.x[k], p.y[k], p.sheet[k]);
        return;
      }
    }
  }

  // Places in the picture to directions.
  void unproject(const float* px, const float* py, int n, Rays& d) const {
    switch (kind) {
      case Kind::latlong: {
        const float du = 2 * kPi / float(width), dv = kPi / float(height);
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float lon = (px[k] + 0.5f) * du - kPi, lat = (py[k] + 0.5f) * dv - 0.5f * kPi;
          const float c = most(cosine(lat), 0.f);
          d.x[k] = sine(lon) * c;
          d.y[k] = sine(lat);
          d.z[k] = cosine(lon) * c;
          d.jacobian[k] = c;
        }
        return;
      }
      case Kind::cube: {
        const float scale = 2 / float(face);
        std::fill_n(d.jacobian, n, 0.f);
        float left = px[0], right = px[0], top = py[0], bottom = py[0];
#pragma omp simd reduction(min : left, top) reduction(max : right, bottom)
        for (int k = 0; k < n; ++k) {
          left = least(left, px[k]), right = most(right, px[k]);
          top = least(top, py[k]), bottom = most(bottom, py[k]);
        }
        for (const Face f : faces) {
          const float u0 = 2 * f.column + 1, v0 = 2 * f.row + 1;
          const auto apart = [&](float low, float high, float middle) {
            return (low + 0.5f) * scale - middle > 1 || (high + 0.5f) * scale - middle < -1;
          };
          if (apart(left, right, u0) || apart(top, bottom, v0)) continue;
#pragma omp simd
          for (int k = 0; k < n; ++k) {
            const float a = (px[k] + 0.5f) * scale - u0, b = (py[k] + 0.5f) * scale - v0;
            const bool here = (a >= -1) & (a <= 1) & (b >= -1) & (b <= 1);
            const float norm = 1 / std::sqrt(1 + a * a + b * b);
            const float x = f.forward.x + a * f.right.x + b * f.down.x;
            const float y = f.forward.y + a * f.right.y + b * f.down.y;
            const float z = f.forward.z + a * f.right.z + b * f.down.z;
            d.x[k] = here ? norm * x : d.x[k];
            d.y[k] = here ? norm * y : d.y[k];
            d.z[k] = here ? norm * z : d.z[k];
            d.jacobian[k] = here ? norm * norm * norm : d.jacobian[k];
          }
        }
        return;
      }
      case Kind::octahedral: {
        const float scale = 2 / float(width);
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float u = (px[k] + 0.5f) * scale - 1, v = (py[k] + 0.5f) * scale - 1;
          const float z = 1 - std::abs(u) - std::abs(v);
          const float s = std::copysign(1 - std::abs(v), u), t = std::copysign(1 - std::abs(u), v);
          const float x = z < 0 ? s : u, y = z < 0 ? t : v;
          const bool here = (std::abs(u) <= 1) & (std::abs(v) <= 1);
          const float norm = here ? 1 / std::sqrt(x * x + y * y + z * z) : 0.f;
          d.x[k] = norm * x;
          d.y[k] = norm * y;
          d.z[k] = norm * z;
          d.jacobian[k] = norm * norm * norm;
        }
        return;
      }
      case Kind::radial: {
        const float *theta_of = angle.data(), *density_of = density.data();
        const std::int32_t size = std::int32_t(angle.size());
        const float ax = 1 / fx, ay = 1 / fy;
#pragma omp simd
        for (int k = 0; k < n; ++k) {
          const float x = (px[k] - cx) * ax, y = (py[k] - cy) * ay, r = std::sqrt(x * x + y * y);
          const float u = 1 - std::sqrt(most(1 - r / rim, 0.f));
          const float theta = lookup(theta_of, size, u), s = r > 0 ? sine(theta) / r : 0.f;
          const bool here = r <= rim;
          d.x[k] = s * x;
          d.y[k] = s * y;
          d.z[k] = cosine(theta);
          d.jacobian[k] = here ? lookup(density_of, size, u) : 0.f;
        }
        return;
      }
      case Kind::table: {
        for (int k = 0; k < n; ++k) {
          Vec v{0, 0, 1};
          d.jacobian[k] = unproject_table(px[k], py[k], v);
          d.set(k, v);
        }
        return;
      }
    }
  }

 private:
  void project_table(Vec d, float& x, float& y, std::int32_t& sheet) const {
    const int k = face_of(d);
    const Face& f = kFaces[k];
    const float w = dot(d, f.forward), last = float(nodes - 1);
    const float a = within((dot(d, f.right) / w + 1) / 2 * last, 0.f, last);
    const float b = within((dot(d, f.down) / w + 1) / 2 * last, 0.f, last);
    const int i = std::min(int(a), nodes - 2), j = std::min(int(b), nodes - 2);
    const float u = a - float(i), v = b - float(j);
    const float* p = pixels.data() + 2 * ((Index(k) * nodes + j) * nodes + i);
    const float* q = p + 2 * Index(nodes);
    x = (1 - v) * ((1 - u) * p[0] + u * p[2]) + v * ((1 - u) * q[0] + u * q[2]);
    y = (1 - v) * ((1 - u) * p[1] + u * p[3]) + v * ((1 - u) * q[1] + u * q[3]);
    const bool seen = x >= -0.5f && y >= -0.5f && x <= float(width) - 0.5f &&
                      y <= float(height) - 0.5f;  // false for NaN, too
    sheet = seen ? 0 : -1;
  }

  float unproject_table(float x, float y, Vec& d) const {
    const float a = x + 0.5f, b = y + 0.5f;
    if (!(a >= 0 && b >= 0 && a <= float(width) && b <= float(height))) return 0;
    const int i = std::min(int(a), width - 1), j = std::min(int(b), height - 1);
    const float u = a - float(i), v = b - float(j);
    const float* p = directions.data() + 3 * (Index(j) * (width + 1) + i);
    const float* q = p + 3 * (Index(width) + 1);
    const Vec p0{p[0], p[1], p[2]}, p1{p[3], p[4], p[5]};
    const Vec q0{q[0], q[1], q[2]}, q1{q[3], q[4], q[5]};
    const Vec top = p0 + u * (p1 - p0), bottom = q0 + u * (q1 - q0);
    const Vec m = top + v * (bottom - top);
    const float norm = length(m);
    if (!(norm > 0)) return 0;  // NaN: the lens has no such pixel
    const Vec dx = (1 - v) * (p1 - p0) + v * (q1 - q0);
    d = (1 / norm) * m;
    return std::abs(dot(m, cross(dx, bottom - top))) / (norm * norm * norm);
  }
};

}  // namespace envmap
