// The captured light: a lat-long map around a point, laid on the stand-in geometry, so that
// light comes from places instead of directions (seeds F11, F12).
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "embree.h"
#include "light.h"
#include "sampler.h"

namespace chromeball {

// Views of arrays that the caller keeps alive.
struct StandIn {
  std::span<const float> vertices;   // (V, 3)
  std::span<const float> original;   // (V, 3), where each stood when the map was captured
  std::span<const uint32_t> faces;   // (F, 3)
  std::span<const uint8_t> surface;  // (F,) 0 support, 1 environment

  size_t size() const { return surface.size(); }
  Vec3 corner(uint32_t face, int k) const { return Vec3(&vertices[3 * faces[3 * face + k]]); }
  Vec3 original_corner(uint32_t face, int k) const {
    return Vec3(&original[3 * faces[3 * face + k]]);
  }
  // Unit, around the corners; up for a face without area.
  Vec3 normal(uint32_t face) const {
    const Vec3 a = corner(face, 0), b = corner(face, 1) - a, c = corner(face, 2) - a;
    const float grow = 1 / std::max({largest_magnitude(b), largest_magnitude(c), 1e-37f});
    return unit_or(cross(b * grow, c * grow), {0, 1, 0});
  }
};

// The first stand-in surface on a ray, or the infinite environment.
struct Place {
  float t = kInfinity;
  Vec3 p, n;        // n: unit, on the ray's side
  Vec3 captured_at;  // where p stood when the map was captured
  uint32_t face = 0;
  bool support = false;
  float rise = 0;    // how far from the face a ray has to start
  explicit operator bool() const { return t < kInfinity; }
  Vec3 start() const { return p + rise * n; }
};

// A map taken elsewhere, for places that the first map does not see (seeds P21, F16).
struct OtherProbe {
  const Environment* environment;
  Vec3 origin;
};

// A piece of the captured light: at a place in the set, or infinitely far in a direction.
struct Lamp {
  Vec3 place;
  bool finite = false;
  Vec3 n;          // unit normal of the surface that shows the light
  float distance = 0;  // of the place from the map's origin
  Vec3 flux;       // radiance times its solid angle at the origin

  // Finite lamps nearer to a point than this are left to rays that search the neighbourhood:
  // seen from there the list is too coarse.
  static constexpr float kNear = 0.35f;

  struct Incident {
    Vec3 d;
    float t;
    float share;  // irradiance at normal incidence over flux; 0: too near, or edge on
  };
  Incident incident(Vec3 x) const {
    if (!finite) return {place, kInfinity, 1};
    const Vec3 to = place - x;
    const float x2 = length2(to), t = std::sqrt(x2);
    if (t < kNear * distance) return {{}, 0, 0};
    return {to * (1 / t), t, spread(std::abs(dot(to, n)) / t, x2)};
  }
  // d omega_x / d omega_o of the surface element (seeds F11's Jacobian).
  float spread(float cos_x, float x2) const {
    return cos_o > 1e-4f ? cos_x * distance * distance / (cos_o * x2) : 0;
  }
  float cos_o = 1;  // at the lamp, towards the origin; less where the surface has grown since
};

class Captured {
 public:
  Captured(const StandIn& stand_in, const Environment& environment, Vec3 origin, uint64_t seed);
  // Before any light is asked for. Where the first map does not see a place, its radiance is
  // that of the probe which shows it most finely; where none does, the first map's.
  void set_others(std::vector<OtherProbe> others);

  Place trace(Vec3 o, Vec3 d, float tfar = kInfinity) const;
  Place at(const Hit& hit, Vec3 d) const;  // where that ray met the set
  bool blocked(Vec3 o, Vec3 d, float tfar) const { return accel_.occluded(o, d, tfar); }
  bool positional() const { return !accel_.empty(); }
  const StandIn& stand_in() const { return stand_in_; }
  const Environment& environment() const { return environment_; }
  const Accel& accel() const { return accel_; }
  // Nothing but one plane, which cannot keep light from itself nor from what stands on it.
  bool flat() const { return flat_; }

  // Of a place from the map's origin.
  float distance(const Place& place) const { return length(place.captured_at - origin_); }

  // Whether the list of lamps holds what a ray of direction d meets, if it is not too near: what
  // the map shows. It does not where another part of the set stands before the place, or where
  // the set stands in that direction and the ray passes it by.
  bool is_listed(const Place& place, Vec3 d) const {
    if (!place && flat_ && dot(d, below_) <= 0) return true;
    if (!place) return !positional() || !accel_.occluded(origin_, d, kInfinity);
    return flat_ || !accel_.occluded(origin_, place.captured_at - origin_, 1 - 1e-3f);
  }

  // L_cap: the radiance that the map holds for a place, or for a direction to infinity.
  Vec3 radiance(const Place& place, Vec3 d) const;

  // Importance sampling of the light seen from x: one of the list of lights that was drawn from
  // the map beforehand, so that a sample costs one place in the cache and not five in the map.
  struct Sample {
    Vec3 d;
    float t = 0;        // distance of the light, infinite for a direction, 0: no light
    float density = 0;  // 1/sr at x
    explicit operator bool() const { return density > 0; }
  };
  Sample sample(Vec3 x, Pair u) const;
  // Whether `place`, the first on the ray, is what the sample was aimed at.
  static bool reaches(const Sample& sample, const Place& place) {
    if (sample.t == kInfinity) return !place;
    return place && std::abs(place.t - sample.t) < 1e-3f * sample.t;
  }
  // The whole light as `count` lamps of about equal power, along the map's Hilbert curve.
  std::vector<Lamp> lamps(uint32_t count, uint64_t seed) const;
  // The density with which `sample` picks direction d, whose first place is `place`.
  float density(Vec3 x, Vec3 d, const Place& place) const;

  // The peaks of the map as lamps that light is traced from.
  struct Peak {
    Vec3 place;  // as of a Lamp
    bool finite = false;
    Vec3 n;
    Vec3 radiance;
    float density = 0;  // 1/m^2; of a direction 1/sr; 0: no light
  };
  void find_peaks() { peaks_.emplace(environment_); }
  bool peaks_found() const { return peaks_.has_value(); }
  const Peaks& peaks() const { return *peaks_; }
  Peak sample_peak(Pair u) const;
  // What such lamps send from what d meets: a part of `radiance`, of which they hold all.
  Vec3 peak(Vec3 d, const Place& place) const;

 private:
  // The plane that a texel's centre showed when the map was captured: n . q = offset; n = 0 for
  // the infinite environment. Where it has moved since, the face that carries its light.
  struct Plane {
    static constexpr uint32_t kStays = ~0u;
    Vec3 n;
    float offset = 0;
    uint32_t moved = kStays;
  };
  // A point of the map, drawn with its density and stratified along the map's Hilbert curve.
  struct Light {
    Vec3 place;         // metres; a direction for the infinite environment
    bool finite;
    Vec3 n;             // of the surface that shows the light
    float density = 0;  // 1/sr at the origin, times cos_o / o^2 for a finite light; 0: no light
  };
  static constexpr uint32_t kLights = 8192;
  void find_planes();
  struct Origin {
    Vec3 w;              // unit, from the map's origin
    float distance = 0;
    const Plane* plane = nullptr;  // none: the infinite environment
    explicit operator bool() const { return !is_zero(w); }
  };
  Origin origin_of(Vec3 d, const Place& place) const;
  Light draw(uint32_t k, uint64_t seed) const;
  Light laid(Vec3 w, uint32_t texel, float density) const;
  Light carried(uint32_t face, Vec3 q, float density) const;
  float growth(uint32_t face) const;  // of a face's area since the map was captured

  // d omega_o / d omega_x through the surface element at q with normal n.
  float jacobian(Vec3 x, Vec3 q, Vec3 n) const;

  bool sees(Vec3 origin, const Place& place) const;

  StandIn stand_in_;
  const Environment& environment_;
  Vec3 origin_;
  Accel accel_;
  std::vector<OtherProbe> others_;
  Accel original_;  // the set as it was when the maps were captured; built for others alone
  std::vector<Plane> planes_;
  std::vector<Light> lights_;
  std::optional<Peaks> peaks_;
  bool flat_ = true;
  Vec3 below_;  // from the origin to a flat set
};

}  // namespace chromeball
