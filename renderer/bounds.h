// Spheres around the parts of the objects, in a tree, and the cones in which a point sees them.
#pragma once

#include <span>
#include <vector>

#include "sampler.h"
#include "vec.h"

namespace chromeball {

struct Sphere {
  Vec3 centre;
  float radius;
};

class Bounds {
 public:
  static constexpr size_t kFew = 32;
  struct Node {
    Sphere sphere;
    uint32_t left = 0, right = 0;  // 0: a leaf
  };
  Bounds() = default;
  explicit Bounds(std::span<const Sphere> spheres);

  bool empty() const { return nodes_.empty(); }
  std::span<const Sphere> leaves() const { return leaves_; }
  // All leaves, or where they are many some spheres around several each.
  std::span<const Sphere> few() const { return few_; }
  std::span<const Node> nodes() const { return nodes_; }  // the root first
  // Whether the ray, d of unit length, may meet any object.
  bool may_hit(Vec3 o, Vec3 d) const {
    if (leaves_.size() > kNoTree) return may_hit_tree(o, d);
    for (const Sphere& s : leaves_) {
      if (may_hit(s, o, d)) return true;
    }
    return false;
  }

 private:
  static constexpr size_t kNoTree = 8;
  static bool may_hit(const Sphere& s, Vec3 o, Vec3 d) {
    const Vec3 to = s.centre - o;
    const float along = dot(to, d), distance2 = length2(to), r2 = s.radius * s.radius;
    // what rounding may take from the distance between line and centre, seen from far off
    const float slack = 1e-6f * distance2;
    return distance2 <= r2 || (along > 0 && distance2 - along * along <= r2 + slack);
  }
  bool may_hit_tree(Vec3 o, Vec3 d) const;
  uint32_t build(std::span<Sphere> spheres);

  std::vector<Node> nodes_;
  std::vector<Sphere> leaves_, few_;
};

// A mixture over a cut through the tree: uniform in each sphere's cone, or cosine-weighted where
// the point lies inside a sphere. The cut is finest where the objects look largest; spheres
// below the horizon have no part in it.
class Cones {
 public:
  Cones(Vec3 x, Vec3 n, const Bounds& bounds);

  bool empty() const { return count_ == 0; }
  Vec3 sample(Pair u) const;
  float density(Vec3 d) const;  // 1/sr

 private:
  static constexpr int kMost = int(Bounds::kFew);
  struct Cone {
    float x, y, z;  // the axis; no Vec3, whose members would all be set to 0
    float cosine;  // of the half angle
    float weight;
    uint32_t node;
    bool inside;
  };
  void add(Vec3 x, const Sphere& s, uint32_t node);
  void refine(Vec3 x, const Bounds& bounds);

  Cone cone_[kMost];
  int count_ = 0;
  float weights_ = 0;
  Vec3 n_;
};

inline Cones::Cones(Vec3 x, Vec3 n, const Bounds& bounds) : n_(n) {
  if (bounds.leaves().size() <= size_t(kMost)) {
    for (const Sphere& s : bounds.leaves()) add(x, s, 0);
  } else {
    refine(x, bounds);
  }
  for (int k = 0; k < count_; ++k) weights_ += cone_[k].weight;
}

inline void Cones::add(Vec3 x, const Sphere& s, uint32_t node) {
  const Vec3 to = s.centre - x;
  const float height = dot(to, n_), distance2 = length2(to), r2 = s.radius * s.radius;
  if (height <= -s.radius) return;
  if (distance2 <= r2 * 1.0001f) {
    cone_[count_++] = {0, 0, 0, 0, kPi, node, true};
    return;
  }
  const float distance = std::sqrt(distance2), sine2 = r2 / distance2;
  const float cosine = std::sqrt(1 - sine2);
  const float solid_angle = 2 * kPi * sine2 / (1 + cosine);  // 2 pi (1 - cosine)
  const float rise = std::min(1.0f, height / distance + s.radius / distance);
  const Vec3 axis = to * (1 / distance);
  cone_[count_++] = {axis.x, axis.y, axis.z, cosine, solid_angle * rise, node, false};
}

inline Vec3 Cones::sample(Pair u) const {
  float left = u.x * weights_;
  int k = 0;
  while (k + 1 < count_ && left >= cone_[k].weight) left -= cone_[k++].weight;
  const Cone& c = cone_[k];
  const float rest = std::min(left / c.weight, 0x1.fffffep-1f);
  if (c.inside) return Frame(n_).world(sample_cosine(rest, u.y));
  const float z = 1 - rest * (1 - c.cosine);
  const float r = std::sqrt(std::max(0.0f, 1 - z * z)), phi = 2 * kPi * u.y;
  return normalize(Frame({c.x, c.y, c.z}).world({r * std::cos(phi), r * std::sin(phi), z}));
}

inline float Cones::density(Vec3 d) const {
  float sum = 0;
  for (int k = 0; k < count_; ++k) {
    const Cone& c = cone_[k];
    if (c.inside) {
      sum += c.weight * std::max(0.0f, dot(d, n_)) / kPi;
    } else if (d.x * c.x + d.y * c.y + d.z * c.z >= c.cosine) {
      sum += c.weight / (2 * kPi * (1 - c.cosine));
    }
  }
  return sum / weights_;
}

}  // namespace chromeball
