// The GGX distribution of slopes with Smith's height-correlated shadowing (Walter et al. 2007,
// Heitz 2014). Directions are local, z along the shading normal, both above it.
#pragma once

#include "../vec.h"

namespace chromeball::ggx {

// Smoother surfaces than this are taken as perfectly smooth: their lobe is finer than any pixel.
constexpr float kSmooth = 0.02f;  // roughness, the square root of alpha

inline float distribution(float h_z, float alpha) {
  const float a2 = alpha * alpha, k = h_z * h_z * (a2 - 1) + 1;
  return a2 / (kPi * k * k);
}

inline float lambda(float cos, float alpha) {
  const float c2 = cos * cos, t2 = std::max(0.0f, 1 - c2) / std::max(c2, 1e-12f);
  return 0.5f * (std::sqrt(1 + alpha * alpha * t2) - 1);
}

inline float shadowing(float cos, float alpha) { return 1 / (1 + lambda(cos, alpha)); }

inline float shadowing(float cos_o, float cos_i, float alpha) {
  return 1 / (1 + lambda(cos_o, alpha) + lambda(cos_i, alpha));
}

// A normal among those that wo sees (Heitz 2018, as a spherical cap: Dupuy and Benyoub 2023);
// density  shadowing(wo) max(0, wo . h) D(h) / wo.z.
inline Vec3 sample_visible(Vec3 wo, float alpha, float u, float v) {
  const Vec3 w = normalize({alpha * wo.x, alpha * wo.y, wo.z});
  const float z = (1 - u) * (1 + w.z) - w.z, phi = 2 * kPi * v;
  const float r = std::sqrt(std::clamp(1 - z * z, 0.0f, 1.0f));
  const Vec3 h = Vec3(r * std::cos(phi), r * std::sin(phi), z) + w;
  return normalize({alpha * h.x, alpha * h.y, std::max(h.z, 1e-6f)});
}

// Density of the reflected direction that such a normal gives.
inline float reflected_density(Vec3 wo, Vec3 h, float alpha) {
  return shadowing(wo.z, alpha) * distribution(h.z, alpha) / (4 * wo.z);
}

inline float fifth(float x) {
  const float x2 = x * x;
  return x2 * x2 * x;
}

}  // namespace chromeball::ggx
