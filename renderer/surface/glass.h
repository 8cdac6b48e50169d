// Solid glass, smooth or rough (Walter et al. 2007). Nothing passes straight through: a shadow
// ray is stopped, light comes by refraction.
//
// Radiance is carried over the square of the refractive index, which refraction keeps: a camera
// or a lamp inside glass is taken as if it were in air.
#pragma once

#include "surface.h"

namespace chromeball::glass {

Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi);
float density(const Surface& s, Vec3 wo, Vec3 wi);
Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler);
// Of clear glass; false at total reflection, or where a shading normal bends one way to the
// wrong side of the face.
bool split(const Surface& s, Vec3 wo, Scatter& reflected, Scatter& refracted);

}  // namespace chromeball::glass
