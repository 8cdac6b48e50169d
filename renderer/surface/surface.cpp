#include "surface.h"

#include "diffuse.h"
#include "specular.h"

namespace chromeball {
namespace {

// The texels on both sides of x, in 0..1 along n texels, and the weight of the second.
struct Neighbours {
  int first, second;
  float weight;
};

int wrapped(int i, int n, Wrap wrap) {
  switch (wrap) {
    case Wrap::repeat: return i < 0 ? i + n : i >= n ? i - n : i;
    case Wrap::mirror:
    case Wrap::clamp: break;  // a mirrored edge meets itself
  }
  return std::clamp(i, 0, n - 1);
}

Neighbours neighbours(float x, int n, Wrap wrap) {
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
  const bool cut = m.alpha_mode != AlphaMode::opaque && (m.alpha < 1 || m.base_texture >= 0);
  m.transmits = cut || m.model == Model::thin_glass;
}

Vec3 shade(const Surface& s, Vec3 wo, Vec3 wi) {
  return s.model == Model::diffuse ? s.alpha * diffuse::shade(s, wo, wi) : Vec3();
}

float density(const Surface& s, Vec3 wo, Vec3 wi) {
  return s.model == Model::diffuse ? diffuse::density(s, wo, wi) : 0;
}

Scatter sample(const Surface& s, Vec3 wo, Sampler& sampler) {
  Scatter scatter;
  switch (s.model) {
    case Model::diffuse: scatter = diffuse::sample(s, wo, sampler); break;
    case Model::metallic_roughness: scatter = specular::mirror(s, wo); break;
    case Model::glass:
    case Model::thin_glass: scatter = specular::glass(s, wo, sampler.pair().x); break;
  }
  if (s.alpha < 1) scatter.weight *= s.alpha;
  return scatter;
}

Vec3 transmit(const Surface& s, Vec3) { return Vec3(1 - s.alpha); }

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
