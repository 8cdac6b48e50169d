// Lambert's surface.
#pragma once

#include "surface.h"

namespace chromeball::diffuse {

inline Vec3 shade(const Surface& s, Vec3, Vec3 wi) {
  const float cos = dot(wi, s.ns);
  return cos > 0 && dot(wi, s.ng) > 0 ? (cos / kPi) * s.base : Vec3();
}

inline float density(const Surface& s, Vec3, Vec3 wi) {
  return std::max(dot(wi, s.ns), 0.0f) / kPi;
}

inline Scatter sample(const Surface& s, Vec3, Sampler& sampler) {
  const Pair u = sampler.pair();
  const Vec3 local = sample_cosine(u.x, u.y), wi = Frame(s.ns).world(local);
  if (dot(wi, s.ng) <= 0) return {};
  return {wi, s.base, std::max(local.z, 1e-6f) / kPi, true};
}

}  // namespace chromeball::diffuse
