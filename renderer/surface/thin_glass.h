// A sheet of glass, thinner than anything refracts by: reflections between its two sides are
// summed, light passes straight through, blurred where the sheet is rough. Its colour is the
// share that the whole sheet lets through.
#pragma once

#include "surface.h"

namespace chromeball::thin_glass {

Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi);
float density(const Surface& s, Vec3 wo, Vec3 wi);
Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler);
Vec3 transmit(const Surface& s, Vec3 wo);

}  // namespace chromeball::thin_glass
