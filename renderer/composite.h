// The compositor: synthetic objects in a captured set, in one pass (seeds P7, P8, P17, F10-F13).
#pragma once

#include <atomic>
#include <vector>

#include "captured.h"
#include "irradiance.h"
#include "mesh.h"
#include "path.h"

namespace chromeball {

struct Sphere {
  Vec3 centre;
  float radius;
};

// What the passes have added up, a row a pixel. Sums over the sub-samples:
struct Film {
  enum Channel {
    kObject = 0,     // 3: radiance of objects
    kCoverage = 3,   // 1: sub-samples that meet an object
    kChange = 4,     // 3: dE / E_without on support
    kDifference = 7, // 3: L_cap dE / E_without on support
    kSupport = 10,   // 1: sub-samples on support
    kDepth = 11,     // 1: distance of the first surface
    kSurfaces = 12,  // 1: sub-samples that meet any surface
    kSquare = 13,    // 1: square of the brightness, for the standard error
    kBrightness = 14,// 1
    kSamples = 15,   // 1: sub-samples so far
    kCount = 16,
  };
};

class Compositor {
 public:
  // `objects` joined, object k being faces first[k] .. first[k + 1].
  Compositor(const Mesh& objects, std::vector<Sphere> bounds, const StandIn& stand_in,
             const Environment& environment, Vec3 origin, int bounces, uint64_t seed,
             uint32_t expected_samples);

  // Adds the next counts (H, W) sub-samples of each pixel to film (H, W, Film::kCount).
  // `plate` (H, W, 3) is only used to know how bright a change is. Returns rays traced.
  uint64_t pass(const PixelRays& rays, Vec3 camera, const float* plate, bool difference,
                const uint16_t* counts, float* film) const;

  // The captured set alone through the camera, mean of `count` sub-samples: a plate.
  void background(const PixelRays& rays, Vec3 camera, uint32_t count, float* radiance) const;

  Vec3 irradiance(Vec3 p, Vec3 n) const { return irradiance_.solve(p, n); }

 private:
  struct Path {
    Sampler& sampler;
    uint64_t rays = 0;
  };
  struct Cones;  // the directions from a point to the objects' bounding spheres

  bool may_hit(Vec3 o, Vec3 d) const;
  Hit meet_object(Vec3 o, Vec3 d, float tfar, Path& path) const;
  Place meet_stand_in(Vec3 o, Vec3 d, float tfar, Path& path) const;

  Vec3 object_radiance(Hit hit, Vec3 d, int bounces, Path& path) const;
  Vec3 diffuse_light(const Surface& s, int bounces, Path& path) const;
  Vec3 stand_in_radiance(const Place& place, Vec3 d, int bounces, Path& path) const;
  Vec3 change(Vec3 x, Vec3 d, float cos, const Hit& hit, const Place& behind, int bounces,
              Path& path) const;
  Vec3 light_change(Vec3 x, Vec3 n, const Cones& cones, float share, int bounces,
                    Path& path) const;
  Vec3 cone_change(Vec3 x, Vec3 n, const Cones& cones, float share, int bounces,
                   Path& path) const;
  Vec3 relative_change(const Place& place, int bounces, bool both, Path& path) const;

  const Mesh objects_;
  const std::vector<Sphere> bounds_;
  Accel accel_;
  Captured captured_;
  Irradiance irradiance_;
  SampleTable table_;
  int bounces_;
  uint64_t seed_;
};

}  // namespace chromeball
