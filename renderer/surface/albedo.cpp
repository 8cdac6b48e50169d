#include "albedo.h"

#include <tbb/parallel_for.h>

#include <map>
#include <memory>
#include <mutex>

#include "../sampler.h"
#include "ggx.h"
#include "surface.h"

namespace chromeball {
namespace {

constexpr uint32_t kSamples = 256;

// The mean of weight(wo, h) over the normals that a direction at `cos` sees.
template <typename Weight>
float over_visible(float cos, float roughness, const Weight& weight) {
  const float mu = std::max(cos, 1e-3f), alpha = roughness * roughness;
  const Vec3 wo(std::sqrt(1 - mu * mu), 0, mu);
  double sum = 0;
  for (uint32_t i = 0; i < kSamples; ++i) {
    const float u = (float(sobol0(i) >> 8) + 0.5f) * 0x1p-24f;
    const float v = (float(sobol1(i) >> 8) + 0.5f) * 0x1p-24f;
    sum += weight(wo, ggx::sample_visible(wo, alpha, u, v), alpha);
  }
  return float(sum / kSamples);
}

// What of the light that meets h is neither shadowed nor lost downwards.
float reflected(Vec3 wo, Vec3 h, float alpha) {
  const Vec3 wi = reflect(-wo, h);
  if (wi.z <= 0) return 0;
  return ggx::shadowing(wo.z, wi.z, alpha) / ggx::shadowing(wo.z, alpha);
}

}  // namespace

template <typename Function>
AlbedoTable::AlbedoTable(const Function& albedo)
    : values_(size_t(kCosines) * kRoughnesses), means_(kRoughnesses) {
  tbb::parallel_for(0, kRoughnesses, [&](int j) {
    const float roughness = float(j) / (kRoughnesses - 1);
    float* row = &values_[size_t(j) * kCosines];
    for (int i = 0; i < kCosines; ++i) {
      const float root = float(i) / (kCosines - 1);
      row[i] = albedo(root * root, std::max(roughness, 1e-3f));
    }
    // with x the root of the cosine: 4 int a(x) x^3 dx, a linear between the nodes
    double sum = 0;
    for (int i = 0; i + 1 < kCosines; ++i) {
      const double x0 = double(i) / (kCosines - 1), x1 = double(i + 1) / (kCosines - 1);
      const double slope = (row[i + 1] - row[i]) / (x1 - x0);
      const auto part = [&](double x) {
        return (row[i] - slope * x0) * std::pow(x, 4) + slope * 0.8 * std::pow(x, 5);
      };
      sum += part(x1) - part(x0);
    }
    means_[j] = float(sum);
  });
}

GgxAlbedo::GgxAlbedo()
    : all_([](float cos, float roughness) { return over_visible(cos, roughness, reflected); }),
      grazing_([](float cos, float roughness) {
        return over_visible(cos, roughness, [](Vec3 wo, Vec3 h, float alpha) {
          return reflected(wo, h, alpha) * ggx::fifth(1 - std::min(1.0f, dot(wo, h)));
        });
      }) {}

const GgxAlbedo& GgxAlbedo::get() {
  static const GgxAlbedo albedo;
  return albedo;
}

GgxAlbedo::Terms GgxAlbedo::at(float cos, float roughness) const {
  if (roughness < ggx::kSmooth) return {1, ggx::fifth(1 - std::min(1.0f, cos))};
  return {all_.at(cos, roughness), grazing_.at(cos, roughness)};
}

GgxAlbedo::Terms GgxAlbedo::mean(float roughness) const {
  if (roughness < ggx::kSmooth) return {1, 1.0f / 21};
  return {all_.mean(roughness), grazing_.mean(roughness)};
}

GlassAlbedo::GlassAlbedo(float eta)
    : table_([eta](float cos, float roughness) {
        return over_visible(cos, roughness, [eta](Vec3 wo, Vec3 h, float alpha) {
          const float cosi = std::min(1.0f, dot(wo, h));
          if (cosi <= 0) return 0.0f;
          float cost = 0;
          const float F = fresnel(cosi, eta, cost);
          float sum = F * reflected(wo, h, alpha);
          if (F < 1) {
            const float z = -wo.z / eta + h.z * (cosi / eta - cost);
            if (z < 0) sum += (1 - F) * ggx::shadowing(-z, alpha);
          }
          return sum;
        });
      }) {}

const GlassAlbedo& GlassAlbedo::get(float eta) {
  static std::mutex mutex;
  static std::map<float, std::unique_ptr<GlassAlbedo>> known;
  const std::lock_guard lock(mutex);
  auto& entry = known[eta];
  if (!entry) entry.reset(new GlassAlbedo(eta));
  return *entry;
}

}  // namespace chromeball
