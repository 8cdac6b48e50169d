// The captured light as a list of lamps of about equal power, and for each direction that a
// surface may face a shorter list of what matters there.
#pragma once

#include <atomic>
#include <memory>
#include <span>
#include <vector>

#include "captured.h"

namespace chromeball {

class LightLists {
 public:
  static constexpr int kGrid = 8;                    // cells along a face of the cube of normals
  static constexpr uint32_t kBins = 6 * kGrid * kGrid;
  static constexpr float kSlack = 0.18f;  // sine of the widest angle in a cell
  static constexpr uint32_t kLamps = 8192;

  LightLists(const Captured& captured, uint64_t seed);

  struct Choice {
    Vec3 flux;  // of the lamp, over the expected number of times that it is in the list
    uint32_t lamp;
  };
  struct List {
    std::vector<Choice> choices;             // along the Hilbert curve
    std::vector<float> x, y, z, finite;      // their places
    size_t size() const { return choices.size(); }
  };

  const Lamp& lamp(uint32_t k) const { return lamps_[k]; }
  bool empty() const { return lamps_.empty(); }
  static uint32_t bin_of(Vec3 n);
  static Vec3 middle_of(uint32_t bin);

  // `count` lamps for surfaces within `radius` of x with normals near n: drawn in proportion to
  // what they send there, stratified along the Hilbert curve; `slack` is added to the cosine, for
  // normals that differ from n.
  List draw(Vec3 x, float radius, Vec3 n, float slack, uint32_t count, float u) const;

 private:
  std::vector<Lamp> lamps_;
};

}  // namespace chromeball
