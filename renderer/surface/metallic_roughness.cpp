#include "metallic_roughness.h"

#include "albedo.h"
#include "ggx.h"

namespace chromeball::metallic_roughness {
namespace {

constexpr float kCoatF0 = 0.04f;  // an index of 1.5, as glTF's clearcoat
constexpr float kBlurred = 0.25f;  // a rougher lobe counts as an interreflection

float luminance(Vec3 c) { return 0.2126f * c.x + 0.7152f * c.y + 0.0722f * c.z; }

// Light that facets send on to each other, F the mean Fresnel reflectance, over (1 - E)(1 - E').
template <typename Value>
Value between_facets(Value F, float mean_all) {
  const float lost = 1 - mean_all;
  if (lost < 1e-4f) return Value(0.0f);
  const auto one = Value(1.0f);
  return F * F * mean_all / ((one - F * lost) * lost);
}

// A GGX reflection: Fresnel from f0 to f90.
template <typename Value>
struct Gloss {
  Value f0, f90, between;  // between: times (1 - E)(1 - E'), the multiply scattered albedo / E
  float roughness, alpha;
  const GgxAlbedo& tables;
  GgxAlbedo::Terms mean_terms;

  Gloss(Value f0, Value f90, float roughness)
      : f0(f0),
        f90(f90),
        roughness(roughness),
        alpha(roughness * roughness),
        tables(GgxAlbedo::get()),
        mean_terms(tables.mean(roughness)) {
    between = between_facets(f0 + (f90 - f0) * (1.0f / 21), mean_terms.all);
  }
  bool smooth() const { return roughness < ggx::kSmooth; }
  Value fresnel(float cos) const {
    return f0 + (f90 - f0) * ggx::fifth(1 - std::clamp(cos, 0.0f, 1.0f));
  }
  Value once(GgxAlbedo::Terms t) const { return f0 * (t.all - t.grazing) + f90 * t.grazing; }
  // Albedo of all that this layer reflects.
  Value albedo(GgxAlbedo::Terms t) const {
    return once(t) + between * ((1 - t.all) * (1 - mean_terms.all));
  }
  Value mean_albedo() const {
    const float lost = 1 - mean_terms.all;
    return once(mean_terms) + between * (lost * lost);
  }
  // f cos of single scattering.
  Value shade(Vec3 wo, Vec3 wi, Vec3 h) const {
    return fresnel(dot(wo, h)) * (ggx::distribution(h.z, alpha) *
                                  ggx::shadowing(wo.z, wi.z, alpha) / (4 * wo.z));
  }
};

// The surface's lobes for light that goes to wo.
struct Lobes {
  Frame frame;
  Vec3 wo;
  Gloss<Vec3> gloss;
  Gloss<float> skin;  // the dielectric part over the diffuse base
  Gloss<float> coat;
  float coated;  // 0..1
  Vec3 diffuse;  // albedo under the layers
  GgxAlbedo::Terms gloss_terms, coat_terms;  // at wo
  float mean_below = 0;                      // of `below`
  // how often each is sampled; they sum to 1
  float pick_coat, pick_gloss, pick_diffuse;

  static float dielectric(const Surface& s) {
    const float r = (s.material->ior - 1) / (s.material->ior + 1);
    return s.material->specular * r * r;
  }
  static Vec3 metal_grazing(const Surface& s) {
    const float g = s.material->specular;
    return {std::max(g, s.base.x), std::max(g, s.base.y), std::max(g, s.base.z)};
  }

  Lobes(const Surface& s, Vec3 world_wo)
      : frame(s.ns),
        wo(frame.local(world_wo)),
        gloss(mix(Vec3(dielectric(s)), s.base, s.metallic),
              mix(Vec3(s.material->specular), metal_grazing(s), s.metallic), s.roughness),
        skin(dielectric(s), s.material->specular, s.roughness),
        coat(kCoatF0, 1, s.material->clearcoat_roughness),
        coated(s.material->clearcoat),
        diffuse((1 - s.metallic) * s.base) {
    wo.z = std::max(wo.z, 1e-4f);
    if (s.metallic > 0 && s.metallic < 1) {  // light between facets is not linear in f0: two
      const Gloss<Vec3> metal(s.base, metal_grazing(s), s.roughness);
      gloss.between = mix(Vec3(skin.between), metal.between, s.metallic);
    }
    gloss_terms = gloss.tables.at(wo.z, gloss.roughness);
    coat_terms = gloss.tables.at(wo.z, coat.roughness);
    const bool lambert = largest(diffuse) > 0;
    if (lambert) mean_below = coated > 0 ? integrate_below() : 1 - skin.mean_albedo();

    const float through = 1 - coat_albedo(coat_terms);
    const float once = through * luminance(gloss.once(gloss_terms));
    float rest = through * luminance(gloss.between) * (1 - gloss_terms.all) *
                 (1 - gloss.mean_terms.all);
    if (coated > 0) {
      rest += coated * coat.between * (1 - coat_terms.all) * (1 - coat.mean_terms.all);
    }
    if (lambert) rest += luminance(diffuse) * below(coat_terms, gloss_terms);
    pick_coat = coat_albedo(coat_terms);
    const float sum = pick_coat + once + rest;
    const float scale = sum > 0 ? 1 / sum : 0;
    pick_coat *= scale, pick_gloss = once * scale, pick_diffuse = rest * scale;
  }

  float coat_albedo(GgxAlbedo::Terms t) const { return coated > 0 ? coated * coat.albedo(t) : 0; }
  // The share that reaches the diffuse base from a direction.
  float below(GgxAlbedo::Terms coat_at, GgxAlbedo::Terms skin_at) const {
    return (1 - coat_albedo(coat_at)) * (1 - skin.albedo(skin_at));
  }
  float integrate_below() const {
    // Gauss and Legendre's five points, cosines over 0..1
    constexpr float x[] = {0.0469101f, 0.2307653f, 0.5f, 0.7692347f, 0.9530899f};
    constexpr float w[] = {0.1184634f, 0.2393143f, 0.2844444f, 0.2393143f, 0.1184634f};
    float sum = 0;
    for (int k = 0; k < 5; ++k) {
      sum += 2 * w[k] * x[k] *
             below(coat.tables.at(x[k], coat.roughness), coat.tables.at(x[k], skin.roughness));
    }
    return sum;
  }

  Vec3 shade(Vec3 wi) const {
    if (wi.z <= 0) return {};
    const auto gloss_i = gloss.tables.at(wi.z, gloss.roughness);
    const auto coat_i = coated > 0 ? coat.tables.at(wi.z, coat.roughness) : coat_terms;
    const Vec3 h = unit_or(wo + wi, {0, 0, 1});
    // the coat takes from the gloss what it takes on the darker of both ways: reciprocal
    const float through = 1 - std::max(coat_albedo(coat_terms), coat_albedo(coat_i));
    Vec3 f = gloss.between *
             (through * (1 - gloss_terms.all) * (1 - gloss_i.all) * wi.z / kPi);
    if (!gloss.smooth()) f += through * gloss.shade(wo, wi, h);
    if (coated > 0 && !coat.smooth()) {
      const float between =
          coat.between * (1 - coat_terms.all) * (1 - coat_i.all) * wi.z / kPi;
      f += Vec3(coated * (coat.shade(wo, wi, h) + between));
    }
    if (mean_below > 0) {
      f += diffuse * (below(coat_terms, gloss_terms) * below(coat_i, gloss_i) /
                      (mean_below * kPi) * wi.z);
    }
    return f;
  }

  float density(Vec3 wi) const {
    if (wi.z <= 0) return 0;
    const Vec3 h = unit_or(wo + wi, {0, 0, 1});
    float p = pick_diffuse * wi.z / kPi;
    if (pick_gloss > 0 && !gloss.smooth()) {
      p += pick_gloss * ggx::reflected_density(wo, h, gloss.alpha);
    }
    if (pick_coat > 0 && !coat.smooth()) {
      p += pick_coat * ggx::reflected_density(wo, h, coat.alpha);
    }
    return p;
  }
};

}  // namespace

bool is_specular(const Surface& s) {
  const bool coat = s.material->clearcoat > 0 && s.material->clearcoat_roughness >= ggx::kSmooth;
  return !coat && s.roughness < ggx::kSmooth && (s.metallic >= 1 || largest(s.base) == 0);
}

Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi) {
  if (dot(wi, s.ng) <= 0) return {};
  const Lobes lobes(s, wo);
  return lobes.shade(lobes.frame.local(wi));
}

float density(const Surface& s, Vec3 wo, Vec3 wi) {
  const Lobes lobes(s, wo);
  return lobes.density(lobes.frame.local(wi));
}

Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler) {
  const Lobes lobes(s, wo);
  const float total = lobes.pick_coat + lobes.pick_gloss + lobes.pick_diffuse;
  if (!(total > 0)) return {};
  Scatter out;
  float u = 0;  // which lobe; the only one needs no chance
  if (lobes.pick_gloss < 1 && lobes.pick_diffuse < 1) u = sampler.pair().x;
  const bool coat = u < lobes.pick_coat;
  if (coat || u < lobes.pick_coat + lobes.pick_gloss) {
    const float roughness = coat ? lobes.coat.roughness : lobes.gloss.roughness;
    out.blurs = roughness > kBlurred;
    if (roughness < ggx::kSmooth) {
      Vec3 n = s.ns;
      out.wi = reflect(-wo, n);
      if (dot(out.wi, s.ng) <= 0) n = s.ng, out.wi = reflect(-wo, n);
      const float cos = std::min(1.0f, dot(wo, n));
      out.weight = coat ? Vec3(lobes.coated * lobes.coat.fresnel(cos) / lobes.pick_coat)
                        : lobes.gloss.fresnel(cos) *
                              ((1 - lobes.coat_albedo(lobes.coat_terms)) / lobes.pick_gloss);
      return out;
    }
    const Pair v = sampler.pair();
    const Vec3 h = ggx::sample_visible(lobes.wo, roughness * roughness, v.x, v.y);
    out.wi = reflect(-lobes.wo, h);
  } else {
    const Pair v = sampler.pair();
    out.wi = sample_cosine(v.x, v.y);
    out.blurs = true;
  }
  const Vec3 local = out.wi;
  out.wi = lobes.frame.world(local);
  out.density = lobes.density(local);
  if (dot(out.wi, s.ng) <= 0 || !(out.density > 0)) return {};
  out.weight = lobes.shade(local) * (1 / out.density);
  return out;
}

}  // namespace chromeball::metallic_roughness
