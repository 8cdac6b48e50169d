// The compositor: synthetic objects in a captured set, in one pass (seeds P7, P8, P17, F10-F13).
#pragma once

#include <atomic>
#include <vector>

#include "bounds.h"
#include "captured.h"
#include "irradiance.h"
#include "path.h"
#include "photons.h"
#include "plate.h"
#include "world.h"

namespace chromeball {

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
  friend class Direct;

 public:
  Compositor(World& objects, const StandIn& stand_in, const Environment& environment,
             Vec3 origin, int bounces, uint64_t seed, uint32_t expected_samples);

  // Other objects.
  void place(World& objects);
  // A new place for an object.
  void move(uint32_t object, const double* matrices, size_t steps = 1);

  // Caustics by photons: a pass takes the maps `first` and on, `maps` of them, one a sub-sample,
  // each of `count` photons. Without photons light is found from where it lands alone.
  struct Caustics {
    uint32_t first = 0, maps = 0, count = 0;
  };
  // Adds the next counts (H, W) sub-samples of each pixel to film (H, W, Film::kCount).
  // `plate` (H, W, 3) tells how bright a change is, and is seen in sharp reflections where it
  // `reflects_plate`. Returns rays traced.
  uint64_t pass(const Camera& camera, const float* plate, bool difference,
                bool reflects_plate, const uint16_t* counts, const Caustics& caustics, float* film);

  // What support surfaces have beside their diffuse part: none, or a dielectric's gloss of this
  // reflectance at normal incidence (0..1) and roughness.
  void set_gloss(float reflectance, float roughness);
  void set_others(std::vector<OtherProbe> others) { captured_.set_others(std::move(others)); }

  // The captured set alone through the camera, mean of `count` sub-samples: a plate.
  void background(const Camera& camera, uint32_t count, float* radiance) const;

  // At a point on or near a surface.
  Vec3 irradiance(Vec3 p, Vec3 n) const {
    return irradiance_.solve(p + 8 * kLift * largest_magnitude(p) * n, n);
  }

 private:
  struct Path {
    Sampler& sampler;
    uint64_t rays = 0;
    float time = 0;  // of the shutter's opening
    const Photons* photons = nullptr;  // none: no peaks of light come by photons
    uint32_t map = 0;
    const Plate* plate = nullptr;  // what sharp reflections see; none: the map alone
  };

  // The first object that does not let the ray through; multiplies `share` by what comes through
  // those that do, so that its mean is right.
  Hit meet_object(Vec3 o, Vec3 d, float tfar, Vec3& share, Path& path) const;
  Place meet_stand_in(Vec3 o, Vec3 d, float tfar, Path& path) const;

  // The first object or the first place of the set on a ray, whichever comes first.
  struct Meeting {
    Hit hit;
    Place place;  // only where it comes before the object
  };
  Meeting meet(Vec3 o, Vec3 d, Vec3& share, Path& path) const;

  // Where a path to an object comes from.
  struct Trail {
    int bounces;            // interreflections left
    bool from_set = false;  // from a surface of the set, where photons may land
    float share = 0;        // of the picture's light that it carries; 0: it is never split
    bool sharp = true;      // no surface before has blurred what it sees
  };
  Vec3 object_radiance(Hit hit, Vec3 d, Trail trail, Path& path) const;
  Vec3 object_radiance(Hit hit, Vec3 d, int bounces, Path& path) const {
    return object_radiance(hit, d, Trail{bounces, false, 1}, path);
  }
  Vec3 beyond(const Surface& s, Vec3 d, Trail trail, Path& path) const;
  Vec3 direct_light(const Surface& s, Vec3 wo, int bounces, bool plate, Path& path) const;
  Vec3 captured_light(const Surface& s, Vec3 wo, int bounces, bool plate, Path& path) const;
  float lamp_density(const Surface& s, const Hit& hit, Vec3 from, Vec3 d) const;
  Vec3 delta_light(const Surface& s, Vec3 wo, Path& path) const;
  Vec3 delta_change(Vec3 x, Vec3 n, Path& path) const;
  bool in_shadow_of_set(Vec3 x, const DeltaLight& light, const DeltaLight::Incident& in,
                        Path& path) const;
  // How a ray looks at the set: by all strategies for the change, or one; as the plate shows it.
  struct Look {
    bool all = false, plate = false;
  };
  Vec3 stand_in_radiance(const Place& place, Vec3 d, int bounces, Look look, Path& path) const;
  Vec3 plate_radiance(const Place& place, Vec3 captured, Path& path) const;

  // The strategies for dE at x on a support with normal n.
  Vec3 change(Vec3 x, Vec3 n, Vec3 d, const Hit& hit, Vec3 share, const Place& behind,
              const Cones& cones, float light, int bounces, Path& path) const;
  Vec3 light_change(Vec3 x, Vec3 n, const Cones& cones, int bounces, Path& path) const;
  Vec3 cone_change(Vec3 x, Vec3 n, Vec3 d, const Cones& cones, int bounces, Path& path) const;
  Vec3 lamp_change(Vec3 x, Vec3 n, const Cones& cones, int bounces, Path& path) const;
  Vec3 relative_change(const Place& place, int bounces, bool all, Path& path) const;

  // What objects change of what the support's gloss at a place sends back along d (seeds P17):
  // along directions that meet an object, and of lights without size.
  Vec3 gloss_change(const Place& place, Vec3 d, int bounces, Path& path) const;
  struct Along {  // a direction from the support
    Vec3 difference;  // of radiance with objects and without; 0 where no object is met
    float lights = 0; // the density with which light sampling picks it
    float lamps = 0;  // the same of lamps among the objects
    float t = kInfinity;  // of the object
    Place behind;         // of the set
  };
  Along along(const Place& place, Vec3 d, int bounces, Path& path) const;

  // Light that goes from peaks of the map and from lamps to objects that throw caustics.
  struct Sources;
  struct Beam;
  Beam beam(const Sources& sources, Path& path) const;
  bool reaches(const Beam& beam, const Surface& s, Path& path) const;
  // The photon that such light becomes; without flux where it lands nowhere.
  Photon photon(const Sources& sources, Path& path) const;
  Photons photons(const Caustics& caustics, std::atomic<uint64_t>& traced) const;

  World* objects_;
  Bounds bounds_;
  Captured captured_;
  Irradiance irradiance_;
  SampleTable table_, photon_table_;
  std::optional<Material> gloss_;
  int bounces_;
  uint64_t seed_;
};

}  // namespace chromeball
