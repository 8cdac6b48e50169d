// Lights without size: point, spot and sun (seeds P1).
#pragma once

#include "embree.h"
#include "vec.h"

namespace chromeball {

struct DeltaLight {
  Vec3 position;   // metres; unused by a sun
  Vec3 intensity;  // W/sr; of a sun: irradiance of a surface that faces it
  Vec3 direction;  // unit, into which it shines
  float cos_inner = -1, cos_outer = -2;  // full within, dark beyond (KHR_lights_punctual)
  bool sun = false;

  struct Incident {
    Vec3 d;           // to the light
    float t;          // its distance; infinite for a sun
    Vec3 irradiance;  // of a surface that faces it, without shadows
  };
  Incident incident(Vec3 x) const;
};

}  // namespace chromeball
