// Smooth surfaces, which send light in certain directions alone: mirrors and clear glass.
#pragma once

#include "surface.h"

namespace chromeball::specular {

inline Scatter mirror(const Surface& s, Vec3 wo) {
  Vec3 n = s.ns, wi = reflect(-wo, n);
  if (dot(wi, s.ng) <= 0) n = s.ng, wi = reflect(-wo, n);
  const float left = 1 - std::min(1.0f, dot(wo, n)), left2 = left * left;
  const float gain = left2 * left2 * left;  // Schlick 1994
  const auto fresnel = [&](float f0) {
    return f0 + (std::max(f0, s.material->specular) - f0) * gain;
  };
  return {wi, {fresnel(s.base.x), fresnel(s.base.y), fresnel(s.base.z)}};
}

// Radiance is carried over the square of the refractive index, which refraction keeps: a camera
// or a lamp inside glass is taken as if it were in air.
inline Scatter glass(const Surface& s, Vec3 wo, float u) {
  // A shading normal may bend the ray to the wrong side of the face; then the face's own is used.
  for (const Vec3 n : {s.ns, s.ng}) {
    const float eta = s.outside ? s.material->ior : 1 / s.material->ior;
    const float cosi = std::min(1.0f, dot(wo, n));
    float cost = 0;
    if (u < fresnel(cosi, eta, cost)) {
      const Vec3 wi = reflect(-wo, n);
      if (dot(wi, s.ng) > 0) return {wi, Vec3(1.0f)};
    } else {
      const Vec3 wi = normalize(wo * (-1 / eta) + n * (cosi / eta - cost));
      if (dot(wi, s.ng) < 0) return {wi, s.base};
    }
  }
  return {reflect(-wo, s.ng), Vec3(1.0f)};
}

}  // namespace chromeball::specular
