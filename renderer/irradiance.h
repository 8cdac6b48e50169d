// E_without: the irradiance that the support surfaces receive in the set as it was captured.
#pragma once

#include <tbb/concurrent_unordered_map.h>

#include <atomic>
#include <memory>

#include "captured.h"

namespace chromeball {

// Solved on a lattice over each support plane where it is asked for, bilinear in between; a cell
// whose nodes differ much is halved, again and again. All points use the same well-spread
// samples, so that what error is left is smooth.
class Irradiance {
 public:
  Irradiance(const Captured& captured, uint64_t seed);

  // At a support place; n is its normal on the side that is lit.
  Vec3 at(const Place& place) const;
  // The same without the lattice; a ray may start at x.
  Vec3 solve(Vec3 x, Vec3 n) const;

 private:
  static constexpr uint32_t kSamples = 256;  // of each of the two strategies
  static constexpr int kCells = 80;          // along the diagonal of a plane
  static constexpr int kLevels = 7;          // of halving
  static constexpr float kSmooth = 1.2f;     // what the nodes of a cell may differ by

  struct Node {
    std::atomic<uint8_t> ready{0};
    Vec3 value;
  };
  struct Lattice {  // on one side of one plane
    Vec3 corner, s, t, n;  // node (i, j) lies at corner + step (i s + j t)
    float step, rise;
    int width, height;
    std::unique_ptr<Node[]> nodes;
    std::unique_ptr<std::atomic<uint8_t>[]> cells;  // 0 unknown, 1 open, 2 cut by a wall

    // of the cells that are halved, by level and place
    std::unique_ptr<tbb::concurrent_unordered_map<uint64_t, Vec3>> finer;

    Vec3 node_place(int i, int j, int level = 0) const {
      const float size = std::ldexp(step, -level);
      return corner + size * (float(i) * s + float(j) * t) + rise * n;
    }
  };
  bool is_open(const Lattice& lattice, int i, int j) const;
  Vec3 node(const Lattice& lattice, int i, int j) const;
  Vec3 finer_node(const Lattice& lattice, int i, int j, int level) const;

  const Captured& captured_;
  SampleTable table_;
  std::vector<uint32_t> group_;  // of each face: its plane
  mutable std::vector<Lattice> lattices_;  // two a plane: along its normal and against it
  std::vector<Vec3> normals_;
};

}  // namespace chromeball
