// The metallic-roughness surface of glTF 2.0 with clearcoat on top: GGX over Lambert, no energy
// lost to multiple scattering between facets (Kulla and Conty 2017) or to the coupling of the
// layers (Kelemen and Szirmay-Kalos 2001). Reciprocal.
#pragma once

#include "surface.h"

namespace chromeball::metallic_roughness {

Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi);
float density(const Surface& s, Vec3 wo, Vec3 wi);
Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler);
// Nothing but mirror-like reflections.
bool is_specular(const Surface& s);

}  // namespace chromeball::metallic_roughness
