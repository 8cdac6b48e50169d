#include "bounds.h"

#include <algorithm>

namespace chromeball {
namespace {

Sphere merged(const Sphere& a, const Sphere& b) {
  const Vec3 apart = b.centre - a.centre;
  const float distance = length(apart);
  if (distance + b.radius <= a.radius) return a;
  if (distance + a.radius <= b.radius) return b;
  const float radius = 0.5f * (distance + a.radius + b.radius);
  return {a.centre + apart * ((radius - a.radius) / distance), radius * (1 + 1e-6f)};
}

}  // namespace

Bounds::Bounds(std::span<const Sphere> spheres) : leaves_(spheres.begin(), spheres.end()) {
  if (spheres.empty()) return;
  std::vector<Sphere> sorted(spheres.begin(), spheres.end());
  nodes_.reserve(2 * sorted.size());
  build(sorted);
  few_ = leaves_;
  if (leaves_.size() <= kFew) return;
  // a cut through the tree: the largest sphere gives way to its parts
  const auto smaller = [this](uint32_t a, uint32_t b) {
    const Node &x = nodes_[a], &y = nodes_[b];
    return (x.left ? x.sphere.radius : 0) < (y.left ? y.sphere.radius : 0);
  };
  std::vector<uint32_t> cut{0};
  while (cut.size() < kFew) {
    const auto largest = std::max_element(cut.begin(), cut.end(), smaller);
    const Node& node = nodes_[*largest];
    *largest = node.left;
    cut.push_back(node.right);
  }
  few_.clear();
  for (const uint32_t k : cut) few_.push_back(nodes_[k].sphere);
}

uint32_t Bounds::build(std::span<Sphere> spheres) {
  const uint32_t at = uint32_t(nodes_.size());
  nodes_.push_back({spheres[0]});
  if (spheres.size() == 1) return at;
  Vec3 low = spheres[0].centre, high = low;
  for (const Sphere& s : spheres) {
    const Vec3 c = s.centre;
    low = {std::min(low.x, c.x), std::min(low.y, c.y), std::min(low.z, c.z)};
    high = {std::max(high.x, c.x), std::max(high.y, c.y), std::max(high.z, c.z)};
  }
  const Vec3 extent = high - low;
  const int axis = extent.x >= largest(extent) ? 0 : extent.y >= largest(extent) ? 1 : 2;
  const auto along = [axis](const Sphere& s) { return (&s.centre.x)[axis]; };
  const auto middle = spheres.begin() + spheres.size() / 2;
  std::nth_element(spheres.begin(), middle, spheres.end(),
                   [&](const Sphere& a, const Sphere& b) { return along(a) < along(b); });
  const uint32_t left = build(spheres.first(spheres.size() / 2));
  const uint32_t right = build(spheres.subspan(spheres.size() / 2));
  nodes_[at] = {merged(nodes_[left].sphere, nodes_[right].sphere), left, right};
  return at;
}

bool Bounds::may_hit_tree(Vec3 o, Vec3 d) const {
  uint32_t stack[64], *top = stack;  // the tree is balanced
  *top++ = 0;
  while (top != stack) {
    const Node& node = nodes_[*--top];
    if (!may_hit(node.sphere, o, d)) continue;
    if (!node.left) return true;
    *top++ = node.left, *top++ = node.right;
  }
  return false;
}

Cones::Cones(Vec3 x, Vec3 n, const Bounds& bounds) : n_(n) {
  if (bounds.leaves().size() <= size_t(kMost)) {
    for (const Sphere& s : bounds.leaves()) add(x, s, 0);
  } else {
    add(x, bounds.nodes()[0].sphere, 0);
    while (count_ > 0 && count_ < kMost) {
      int widest = -1;
      for (int k = 0; k < count_; ++k) {
        if (bounds.nodes()[cone_[k].node].left &&
            (widest < 0 || cone_[k].weight > cone_[widest].weight)) {
          widest = k;
        }
      }
      if (widest < 0) break;
      const auto& node = bounds.nodes()[cone_[widest].node];
      cone_[widest] = cone_[--count_];
      for (const uint32_t k : {node.left, node.right}) add(x, bounds.nodes()[k].sphere, k);
    }
  }
  for (int k = 0; k < count_; ++k) weights_ += cone_[k].weight;
}

void Cones::add(Vec3 x, const Sphere& s, uint32_t node) {
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

Vec3 Cones::sample(Pair u) const {
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

float Cones::density(Vec3 d) const {
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
