// Light that was traced from its sources to where it lands, gathered by density (Jensen 1996).
#pragma once

#include <cstdint>
#include <vector>

#include "vec.h"

namespace chromeball {

struct Photon {
  Vec3 p;
  Vec3 n;     // unit normal of the surface, on the side that it lit
  Vec3 flux;  // watts, where radiance is in W/m^2/sr
};

// Several maps in one, each an estimate of its own: their mean has the radii of progressive
// photon mapping (Knaus and Zwicker 2011), so that it converges as maps are added.
class Photons {
 public:
  Photons() = default;
  // photons[k] and radius[k] are map k's.
  Photons(std::vector<std::vector<Photon>> photons, std::vector<float> radius);

  bool empty() const { return photons_.empty(); }
  uint32_t maps() const { return uint32_t(radius_.size()); }
  // Irradiance at x on a surface with unit normal n, by the photons of one map.
  Vec3 irradiance(Vec3 x, Vec3 n, uint32_t map) const;

 private:
  uint32_t slot(int x, int y, int z, uint32_t map) const;

  std::vector<Photon> photons_;   // by map and cell
  std::vector<uint32_t> starts_;  // of each slot; one more at the end
  std::vector<float> radius_;
  uint32_t mask_ = 0;
};

}  // namespace chromeball
