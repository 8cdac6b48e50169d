#include "glass.h"

#include "albedo.h"
#include "ggx.h"

namespace chromeball::glass {
namespace {

float relative_index(const Surface& s) { return s.outside ? s.material->ior : 1 / s.material->ior; }

Scatter smooth(const Surface& s, Vec3 wo, float u) {
  const float eta = relative_index(s);
  // A shading normal may bend the ray to the wrong side of the face; then the face's own is used.
  for (const Vec3 n : {s.ns, s.ng}) {
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

struct Rough {
  Frame frame;
  Vec3 wo;
  float eta, alpha, gain;  // gain: what single scattering loses is given back

  Rough(const Surface& s, Vec3 world_wo)
      : frame(s.ns),
        wo(frame.local(world_wo)),
        eta(relative_index(s)),
        alpha(s.roughness * s.roughness) {
    wo.z = std::max(wo.z, 1e-4f);
    const GlassAlbedo* table = s.outside ? s.material->glass_in : s.material->glass_out;
    gain = 1 / std::max(table->at(wo.z, s.roughness), 0.05f);
  }

  // f cos, and the density of `sample`.
  struct Value {
    Vec3 f;
    float density;
  };
  Value at(const Surface& s, Vec3 wi) const {
    if (wi.z == 0) return {};
    const bool through = wi.z < 0;
    Vec3 h = unit_or(through ? wo + eta * wi : wo + wi, {0, 0, 1});
    if (h.z < 0) h = -h;
    const float o = dot(wo, h), i = dot(wi, h);
    if (o <= 0 || (i < 0) != through) return {};
    float cost = 0;
    const float F = fresnel(std::min(1.0f, o), eta, cost);
    const float visible = ggx::shadowing(wo.z, alpha);
    const float D = ggx::distribution(h.z, alpha) / wo.z;
    if (!through) {
      const float both = ggx::shadowing(wo.z, wi.z, alpha);
      return {Vec3(gain * F * D * both / 4), F * D * visible / 4};
    }
    if (F >= 1) return {};
    const float bend = o + eta * i;
    const float jacobian = D * o * eta * eta * -i / (bend * bend) * (1 - F);
    const float both = visible * ggx::shadowing(-wi.z, alpha);
    return {(gain * jacobian * both) * s.base, jacobian * visible};
  }
};

bool right_side(const Surface& s, Vec3 wi) { return (dot(wi, s.ng) > 0) == (dot(wi, s.ns) > 0); }

}  // namespace

Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi) {
  if (is_clear(s) || !right_side(s, wi)) return {};
  const Rough rough(s, wo);
  return rough.at(s, rough.frame.local(wi)).f;
}

float density(const Surface& s, Vec3 wo, Vec3 wi) {
  if (is_clear(s)) return 0;
  const Rough rough(s, wo);
  return rough.at(s, rough.frame.local(wi)).density;
}

bool split(const Surface& s, Vec3 wo, Scatter& reflected, Scatter& refracted) {
  const float eta = relative_index(s), cosi = std::min(1.0f, dot(wo, s.ns));
  float cost = 0;
  const float F = fresnel(cosi, eta, cost);
  reflected = {reflect(-wo, s.ns), Vec3(F)};
  refracted = {normalize(wo * (-1 / eta) + s.ns * (cosi / eta - cost)), (1 - F) * s.base};
  return F < 1 && dot(reflected.wi, s.ng) > 0 && dot(refracted.wi, s.ng) < 0;
}

Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler) {
  const float u = sampler.pair().x;
  if (is_clear(s)) return smooth(s, wo, u);
  const Rough rough(s, wo);
  const Pair v = sampler.pair();
  const Vec3 h = ggx::sample_visible(rough.wo, rough.alpha, v.x, v.y);
  const float cosi = std::min(1.0f, dot(rough.wo, h));
  if (cosi <= 0) return {};
  float cost = 0;
  const bool reflects = u < fresnel(cosi, rough.eta, cost);
  const Vec3 wi = reflects ? reflect(-rough.wo, h)
                           : normalize(rough.wo * (-1 / rough.eta) +
                                       h * (cosi / rough.eta - cost));
  if ((wi.z > 0) != reflects) return {};
  const auto value = rough.at(s, wi);
  Scatter out{rough.frame.world(wi), {}, value.density, s.roughness > 0.25f};
  if (!(value.density > 0) || !right_side(s, out.wi)) return {};
  out.weight = value.f * (1 / value.density);
  return out;
}

}  // namespace chromeball::glass
