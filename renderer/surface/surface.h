// What a surface does with light. Each kind is a file with
//   shade      f cos for a pair of directions, without what passes straight through,
//   sample     a direction to follow, with f cos / density,
//   density    of `sample`, 1/sr,
//   transmit   the share of light that passes straight through: what a shadow ray asks for.
// wo points back along the path, wi on towards the light; both leave the surface.
#pragma once

#include <span>

#include "../sampler.h"
#include "../vec.h"

namespace chromeball {

enum class Wrap : uint8_t { repeat = 0, clamp = 1, mirror = 2 };

// A view of pixels (h, w, channels), row 0 at v = 0.
struct Texture {
  std::span<const float> pixels;
  int height = 0, width = 0, channels = 0;
  Wrap wrap[2] = {Wrap::repeat, Wrap::repeat};

  struct Texel {
    float c[4] = {1, 1, 1, 1};
    Vec3 rgb() const { return {c[0], c[1], c[2]}; }
  };
  Texel at(float u, float v) const;  // bilinear; one channel counts for three
  Vec3 mean() const;
};

enum class Model : uint8_t { diffuse, metallic_roughness, glass, thin_glass };
enum class AlphaMode : uint8_t { opaque = 0, mask = 1, blend = 2 };

class GlassAlbedo;

struct Material {
  Vec3 base;
  float metallic, roughness, specular, ior, transmission;
  bool thin;
  float clearcoat, clearcoat_roughness;
  Vec3 emission;
  float alpha;
  AlphaMode alpha_mode;
  float alpha_cutoff, normal_scale;
  int32_t base_texture, metallic_roughness_texture, normal_texture, emission_texture;  // -1: none
  // what follows from these
  Model model = Model::diffuse;
  float power = 0;       // mean radiance
  bool transmits = false;  // some light passes straight through
  bool sharp = false;      // some light may go on in a certain direction: it can throw caustics
  const GlassAlbedo *glass_in = nullptr, *glass_out = nullptr;  // of rough glass
};

// A place on a surface with its material there, seen by a ray.
struct Surface {
  Vec3 p;
  Vec3 ng;  // of the face, unit, on the ray's side
  Vec3 ns;  // for shading, unit, on the ray's side
  float rise;    // how far from the face a ray has to start
  bool outside;  // the ray meets the face from where its corners run counter-clockwise
  Model model;
  float alpha;
  Vec3 base, emission;
  float metallic, roughness, transmission;
  const Material* material;

  // Where a ray in direction d starts, clear of the face.
  Vec3 start(Vec3 d) const { return p + ng * (dot(d, ng) > 0 ? rise : -rise); }
};

// Glass too smooth, or too much like the air, to spread light.
bool is_clear(const Surface& s);

struct Scatter {
  Vec3 wi;
  Vec3 weight;        // f cos / density; 0: no light goes on
  float density = 0;  // 1/sr; 0: the direction is certain, as a mirror's
  bool blurs = false; // a bounce that counts as an interreflection
};

// Chooses the model and what else follows from the parameters.
void settle(Material& material);
// A surface that does nothing but send light in certain directions.
bool is_specular(const Surface& s);
Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi);
float density(const Surface& s, Vec3 wo, Vec3 wi);
Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler);
Vec3 transmit(const Surface& s, Vec3 wo);
// Whether what is seen in the surface is sharp enough to look at closely.
bool keeps_detail(const Surface& s);
// Both ways of light at clear solid glass; false where there is but one, or another surface.
bool split(const Surface& s, Vec3 wo, Scatter& reflected, Scatter& refracted);

// Reflectance of a smooth dielectric, unpolarised (Fresnel); eta = n_inside / n_outside as the
// ray sees it, cosi > 0. Fills the cosine of the refracted ray; 1 at total reflection.
inline float fresnel(float cosi, float eta, float& cost) {
  const float sin2 = (1 - cosi * cosi) / (eta * eta);
  if (sin2 >= 1) return 1;
  cost = std::sqrt(1 - sin2);
  const float s = (cosi - eta * cost) / (cosi + eta * cost);
  const float p = (eta * cosi - cost) / (eta * cosi + cost);
  return 0.5f * (s * s + p * p);
}

}  // namespace chromeball
