#include "thin_glass.h"

#include "albedo.h"
#include "ggx.h"

namespace chromeball::thin_glass {
namespace {

// R + T R T + T R R R T + ... of a sheet.
float sheet(float cos, float ior) {
  float cost = 0;
  const float R = fresnel(std::min(1.0f, cos), ior, cost);
  return 2 * R / (1 + R);
}

// Both lobes are that of a rough mirror, the transmitted one on the other side.
struct Rough {
  Frame frame;
  Vec3 wo;
  float alpha, gain;

  Rough(const Surface& s, Vec3 world_wo)
      : frame(s.ns), wo(frame.local(world_wo)), alpha(s.roughness * s.roughness) {
    wo.z = std::max(wo.z, 1e-4f);
    gain = 1 / GgxAlbedo::get().at(wo.z, s.roughness).all;
  }
  struct Value {
    Vec3 f;
    float density;
  };
  Value at(const Surface& s, Vec3 wi) const {
    const bool through = wi.z < 0;
    wi.z = std::abs(wi.z);
    const Vec3 h = unit_or(wo + wi, {0, 0, 1});
    const float R = sheet(dot(wo, h), s.material->ior), share = through ? 1 - R : R;
    const float D = ggx::distribution(h.z, alpha) / (4 * wo.z);
    const float f = share * gain * D * ggx::shadowing(wo.z, wi.z, alpha);
    return {through ? f * s.base : Vec3(f), share * D * ggx::shadowing(wo.z, alpha)};
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

Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler) {
  if (is_clear(s)) {  // what passes through is left to `transmit`
    Vec3 n = s.ns, wi = reflect(-wo, n);
    if (dot(wi, s.ng) <= 0) n = s.ng, wi = reflect(-wo, n);
    return {wi, Vec3(sheet(dot(wo, n), s.material->ior))};
  }
  const Rough rough(s, wo);
  const float u = sampler.pair().x;
  const Pair v = sampler.pair();
  const Vec3 h = ggx::sample_visible(rough.wo, rough.alpha, v.x, v.y);
  Vec3 wi = reflect(-rough.wo, h);
  if (wi.z <= 0) return {};
  if (u >= sheet(dot(rough.wo, h), s.material->ior)) wi.z = -wi.z;
  const auto value = rough.at(s, wi);
  Scatter out{rough.frame.world(wi), {}, value.density, s.roughness > 0.25f};
  if (!(value.density > 0) || !right_side(s, out.wi)) return {};
  out.weight = value.f * (1 / value.density);
  return out;
}

Vec3 transmit(const Surface& s, Vec3 wo) {
  if (!is_clear(s)) return {};
  const float cos = dot(wo, s.ns) > 0 ? dot(wo, s.ns) : dot(wo, s.ng);
  return (1 - sheet(cos, s.material->ior)) * s.base;
}

}  // namespace chromeball::thin_glass
