// How much light a rough surface sends on at all: tables for energy that single scattering loses
// (Kulla and Conty 2017), made when first asked for.
#pragma once

#include <vector>

#include "../vec.h"

namespace chromeball {

// A function of cosine and roughness, bilinear in the root of the cosine and in roughness.
class AlbedoTable {
 public:
  static constexpr int kCosines = 32, kRoughnesses = 24;

  // `albedo(cos, roughness)` at the lattice.
  template <typename Function>
  explicit AlbedoTable(const Function& albedo);

  float at(float cos, float roughness) const {
    const float x = std::sqrt(std::clamp(cos, 0.0f, 1.0f)) * (kCosines - 1);
    const float y = std::clamp(roughness, 0.0f, 1.0f) * (kRoughnesses - 1);
    const int i = std::min(int(x), kCosines - 2), j = std::min(int(y), kRoughnesses - 2);
    const float *a = &values_[j * kCosines + i], *b = a + kCosines;
    return mix(mix(a[0], a[1], x - i), mix(b[0], b[1], x - i), y - j);
  }
  // 2 int at(c) c dc: the albedo under even light.
  float mean(float roughness) const {
    const float y = std::clamp(roughness, 0.0f, 1.0f) * (kRoughnesses - 1);
    const int j = std::min(int(y), kRoughnesses - 2);
    return mix(means_[j], means_[j + 1], y - j);
  }

 private:
  std::vector<float> values_, means_;
};

// Of a reflecting GGX surface whose Fresnel term is Schlick's f0 + (f90 - f0) (1 - cos)^5.
class GgxAlbedo {
 public:
  static const GgxAlbedo& get();

  struct Terms {
    float all, grazing;  // of f0 = f90 = 1; of f0 = 0, f90 = 1
  };
  Terms at(float cos, float roughness) const;
  Terms mean(float roughness) const;

 private:
  GgxAlbedo();
  AlbedoTable all_, grazing_;
};

// Of rough glass, reflection and transmission together.
class GlassAlbedo {
 public:
  // Kept for each index; eta = n beyond the surface / n on the side of the ray.
  static const GlassAlbedo& get(float eta);
  float at(float cos, float roughness) const { return table_.at(cos, roughness); }

 private:
  explicit GlassAlbedo(float eta);
  AlbedoTable table_;
};

}  // namespace chromeball
