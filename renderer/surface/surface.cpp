#include "surface.h"

#include "albedo.h"
#include "diffuse.h"
#include "ggx.h"
#include "glass.h"
#include "metallic_roughness.h"
#include "thin_glass.h"

namespace chromeball {
namespace {

// The texels on both sides of x, in 0..1 along n texels, and the weight of the second.
struct Neighbours {
  int first, second;
  float weight;
};

constexpr float kDetail = 0.25f;  // roughness

int wrapped(int i, int n, Wrap wrap) {
  switch (wrap) {
    case Wrap::repeat: return i < 0 ? i + n : i >= n ? i - n : i;
    case Wrap::mirror:
    case Wrap::clamp: break;  // a mirrored edge meets itself
  }
  return std::clamp(i, 0, n - 1);
}

Neighbours neighbours(float x, int n, Wrap wrap) {
  if (!std::isfinite(x)) x = 0;  // large coordinates overflow between corners
  switch (wrap) {
    case Wrap::repeat: x -= std::floor(x); break;
    case Wrap::clamp: x = std::clamp(x, 0.0f, 1.0f); break;
    case Wrap::mirror:
      x -= 2 * std::floor(0.5f * x);
      x = x > 1 ? 2 - x : x;
      break;
  }
  const float at = x * n - 0.5f, low = std::floor(at);
  return {wrapped(int(low), n, wrap), wrapped(int(low) + 1, n, wrap), at - low};
}

}  // namespace

void settle(Material& m) {
  if (m.transmission > 0) {
    m.model = m.thin ? Model::thin_glass : Model::glass;
  } else if (m.specular == 0 && m.metallic == 0 && m.clearcoat == 0) {
    m.model = Model::diffuse;
  } else {
    m.model = Model::metallic_roughness;
  }
  if (m.model == Model::glass && m.roughness >= ggx::kSmooth) {
    m.glass_in = &GlassAlbedo::get(m.ior);
    m.glass_out = &GlassAlbedo::get(1 / m.ior);
  }
  const bool smooth = m.roughness < ggx::kSmooth || m.metallic_roughness_texture >= 0;
  const bool coat = m.clearcoat > 0 && m.clearcoat_roughness < ggx::kSmooth;
  m.sharp = m.model != Model::diffuse &&
            (smooth || coat || (m.model == Model::glass && m.ior < 1.001f));
  const bool cut = m.alpha_mode != AlphaMode::opaque && (m.alpha < 1 || m.base_texture >= 0);
  m.transmits = cut || m.model == Model::thin_glass;
}

bool is_clear(const Surface& s) {
  return s.roughness < ggx::kSmooth || (s.model == Model::glass && s.material->ior < 1.001f);
}

bool is_specular(const Surface& s) {
  switch (s.model) {
    case Model::diffuse: return false;
    case Model::metallic_roughness: return metallic_roughness::is_specular(s);
    case Model::glass:
    case Model::thin_glass: break;
  }
  return is_clear(s) &&
         (s.transmission >= 1 || metallic_roughness::is_specular(s));
}

// Glass of part transmission is a mixture of glass and an opaque surface.
Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi) {
  Vec3 f;
  switch (s.model) {
    case Model::diffuse: f = diffuse::shade(s, wo, wi); break;
    case Model::metallic_roughness: f = metallic_roughness::shade(s, wo, wi); break;
    case Model::glass: f = s.transmission * glass::shade(s, wo, wi); break;
    case Model::thin_glass: f = s.transmission * thin_glass::shade(s, wo, wi); break;
  }
  if (s.transmission > 0 && s.transmission < 1) {
    f += (1 - s.transmission) * metallic_roughness::shade(s, wo, wi);
  }
  return s.alpha * f;
}

float density(const Surface& s, Vec3 wo, Vec3 wi) {
  float p = 0;
  switch (s.model) {
    case Model::diffuse: return diffuse::density(s, wo, wi);
    case Model::metallic_roughness: return metallic_roughness::density(s, wo, wi);
    case Model::glass: p = s.transmission * glass::density(s, wo, wi); break;
    case Model::thin_glass: p = s.transmission * thin_glass::density(s, wo, wi); break;
  }
  if (s.transmission < 1) p += (1 - s.transmission) * metallic_roughness::density(s, wo, wi);
  return p;
}

Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler) {
  Scatter out;
  if (s.model == Model::diffuse) {
    out = diffuse::sample(s, wo, sampler);
  } else if (s.model == Model::metallic_roughness) {
    out = metallic_roughness::sample(s, wo, sampler);
  } else {
    const bool clear = s.transmission >= 1 || sampler.pair().x < s.transmission;
    out = !clear                          ? metallic_roughness::sample(s, wo, sampler)
          : s.model == Model::glass       ? glass::sample(s, wo, sampler)
                                          : thin_glass::sample(s, wo, sampler);
    if (s.transmission < 1 && out.density > 0) {  // either might have given the direction
      out.density = density(s, wo, out.wi);
      out.weight = shade(s, wo, out.wi) * (1 / out.density);
      return out;
    }
  }
  if (s.alpha < 1) out.weight *= s.alpha;
  return out;
}

bool keeps_detail(const Surface& s) {
  if (s.model == Model::diffuse) return false;
  const bool coat = s.material->clearcoat > 0 && s.material->clearcoat_roughness < kDetail;
  return coat || s.roughness < kDetail;
}

bool split(const Surface& s, Vec3 wo, Scatter& reflected, Scatter& refracted) {
  return s.model == Model::glass && s.alpha >= 1 && s.transmission >= 1 && is_clear(s) &&
         glass::split(s, wo, reflected, refracted);
}

Vec3 transmit(const Surface& s, Vec3 wo) {
  Vec3 share(1 - s.alpha);
  if (s.model == Model::thin_glass && s.transmission > 0) {
    share += (s.alpha * s.transmission) * thin_glass::transmit(s, wo);
  }
  return share;
}

Texture::Texel Texture::at(float u, float v) const {
  const Neighbours x = neighbours(u, width, wrap[0]), y = neighbours(v, height, wrap[1]);
  const float weight[4] = {(1 - x.weight) * (1 - y.weight), x.weight * (1 - y.weight),
                           (1 - x.weight) * y.weight, x.weight * y.weight};
  const size_t at[4] = {size_t(y.first) * width + x.first, size_t(y.first) * width + x.second,
                        size_t(y.second) * width + x.first,
                        size_t(y.second) * width + x.second};
  Texel texel;
  for (int c = 0; c < channels; ++c) {
    texel.c[c] = 0;
    for (int k = 0; k < 4; ++k) texel.c[c] += weight[k] * pixels[at[k] * channels + c];
  }
  if (channels == 1) texel.c[1] = texel.c[2] = texel.c[0];
  return texel;
}

Vec3 Texture::mean() const {
  double sum[3] = {};
  const size_t count = pixels.size() / channels;
  for (size_t i = 0; i < count; ++i) {
    for (int c = 0; c < 3; ++c) sum[c] += pixels[i * channels + (channels == 1 ? 0 : c)];
  }
  return {float(sum[0] / count), float(sum[1] / count), float(sum[2] / count)};
}

}  // namespace chromeball
