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

void Cones::refine(Vec3 x, const Bounds& bounds) {
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

}  // namespace chromeball
