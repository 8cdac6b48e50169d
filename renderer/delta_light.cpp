#include "delta_light.h"

namespace chromeball {

DeltaLight::Incident DeltaLight::incident(Vec3 x) const {
  if (sun) return {-direction, kInfinity, intensity};
  const Vec3 to = position - x;
  const float t2 = length2(to), t = std::sqrt(t2);
  if (!(t2 > 1e-30f)) return {direction, 0, {}};  // at the light itself
  const Vec3 d = to * (1 / t);
  const float cosine = -dot(d, direction), ramp = std::max(cos_inner - cos_outer, 1e-6f);
  const float s = std::clamp((cosine - cos_outer) / ramp, 0.0f, 1.0f);
  return {d, t, (s * s / t2) * intensity};
}

}  // namespace chromeball
