// Polygons as triangles: fans where they are convex, ears where they are not.
#pragma once

#include <cstdint>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "vec.h"

namespace chromeball {

struct Triangulation {
  std::vector<uint32_t> corners;  // (T, 3) places in the polygons' list of corners
  std::vector<uint32_t> faces;    // (T,) the polygon of each triangle
};

class Triangulator {
 public:
  // `corners` are vertex numbers, sizes[k] of them for polygon k.
  Triangulation run(std::span<const float> vertices, std::span<const int32_t> sizes,
                    std::span<const int32_t> corners) {
    const int64_t count = int64_t(vertices.size() / 3);
    size_t first = 0;
    for (size_t face = 0; face < sizes.size(); ++face) {
      const int n = sizes[face];
      if (n < 0 || size_t(n) > corners.size() - first) {
        throw std::invalid_argument("sizes and corners differ");
      }
      if (n < 3) throw std::invalid_argument("a face has fewer than three corners");
      points_.clear();
      for (int k = 0; k < n; ++k) {
        const int64_t v = corners[first + k];
        if (v < 0 || v >= count) {
          throw std::invalid_argument("a face names a vertex that is not among the " +
                                      std::to_string(count));
        }
        points_.push_back(Vec3(&vertices[3 * v]));
      }
      first_ = uint32_t(first);
      face_ = uint32_t(face);
      polygon(n);
      first += size_t(n);
    }
    return std::move(out_);
  }

 private:
  static constexpr int kMostConcave = 512;  // cutting ears takes the cube of it at worst

  void emit(int a, int b, int c) {
    for (const int k : {a, b, c}) out_.corners.push_back(first_ + uint32_t(k));
    out_.faces.push_back(face_);
  }

  // Twice the signed area of a triangle as seen along the polygon's normal.
  double turn(int a, int b, int c) const {
    return (x_[b] - x_[a]) * (y_[c] - y_[a]) - (y_[b] - y_[a]) * (x_[c] - x_[a]);
  }

  void polygon(int n) {
    if (n == 3) return emit(0, 1, 2);
    project(n);
    bool convex = true;
    for (int k = 0; k < n && convex; ++k) convex = turn(k, (k + 1) % n, (k + 2) % n) >= 0;
    if (convex) {
      for (int k = 1; k + 1 < n; ++k) emit(0, k, k + 1);
      return;
    }
    if (n > kMostConcave) {
      throw std::invalid_argument("a face has " + std::to_string(n) +
                                  " corners and is not convex; triangulate the mesh");
    }
    left_.resize(size_t(n));
    for (int k = 0; k < n; ++k) left_[size_t(k)] = k;
    while (left_.size() > 3) {
      const size_t m = left_.size();
      size_t ear = 0;  // where there is none the polygon crosses itself, and any corner will do
      for (size_t k = 0; k < m; ++k) {
        if (is_ear(left_[(k + m - 1) % m], left_[k], left_[(k + 1) % m])) {
          ear = k;
          break;
        }
      }
      emit(left_[(ear + m - 1) % m], left_[ear], left_[(ear + 1) % m]);
      left_.erase(left_.begin() + std::ptrdiff_t(ear));
    }
    emit(left_[0], left_[1], left_[2]);
  }

  bool is_ear(int a, int b, int c) const {
    if (!(turn(a, b, c) > 0)) return false;
    for (const int k : left_) {
      if (k == a || k == b || k == c) continue;
      if (turn(a, b, k) >= 0 && turn(b, c, k) >= 0 && turn(c, a, k) >= 0) return false;
    }
    return true;
  }

  // To the plane that the polygon's normal (Newell's) is nearest to, seen from outside.
  void project(int n) {
    double normal[3] = {0, 0, 0};
    for (int k = 0; k < n; ++k) {
      const Vec3 a = points_[size_t(k)], b = points_[size_t((k + 1) % n)];
      normal[0] += (double(a.y) - b.y) * (double(a.z) + b.z - 2 * double(points_[0].z));
      normal[1] += (double(a.z) - b.z) * (double(a.x) + b.x - 2 * double(points_[0].x));
      normal[2] += (double(a.x) - b.x) * (double(a.y) + b.y - 2 * double(points_[0].y));
    }
    int axis = 0;
    for (int k = 1; k < 3; ++k) {
      if (std::abs(normal[k]) > std::abs(normal[axis])) axis = k;
    }
    x_.resize(size_t(n)), y_.resize(size_t(n));
    for (int k = 0; k < n; ++k) {
      const Vec3 p = points_[size_t(k)];
      const double v[3] = {p.x, p.y, p.z};
      x_[size_t(k)] = v[(axis + 1) % 3];
      y_[size_t(k)] = normal[axis] < 0 ? -v[(axis + 2) % 3] : v[(axis + 2) % 3];
    }
  }

  Triangulation out_;
  std::vector<Vec3> points_;
  std::vector<double> x_, y_;
  std::vector<int> left_;
  uint32_t first_ = 0, face_ = 0;
};

}  // namespace chromeball
