#include "path.h"

#include <tbb/blocked_range.h>
#include <tbb/blocked_range2d.h>
#include <tbb/parallel_for.h>

#include "sampler.h"

namespace chromeball {
namespace {

constexpr float kCover = 5e-3f;  // metres
constexpr int kSureBounces = 5;  // roulette may end a path after these
constexpr int kMostPassed = 256;

class PathIntegrator {
 public:
  PathIntegrator(const World& world, const Environment* environment, int bounces,
                 const float* irradiance = nullptr, float gather_from = 0)
      : world_(world),
        environment_(environment),
        bounces_(bounces),
        irradiance_(irradiance),
        gather_from_(gather_from) {
    const bool sky = environment_ && !environment_->even();
    pick_environment_ = !sky ? 0.0f : !world_.shines() ? 1.0f : 0.5f;
  }

  // bsdf_density of d; 0: the last bounce was certain, or this is the camera ray.
  Vec3 radiance(Vec3 o, Vec3 d, Sampler& sampler, float time, float bsdf_density = 0,
                int depth = 0) const {
    Vec3 sum, beta(1.0f), from = o;  // where the direction was chosen
    int passed = 0;  // surfaces that let the ray through: no scatterings
    for (;; ++depth) {
      const Hit hit = world_.intersect(o, d, kInfinity, time);
      if (!hit) {
        if (environment_) {
          const float w = bsdf_density == 0
                              ? 1.0f
                              : power_heuristic(bsdf_density, pick_environment_ *
                                                                  environment_->density(d));
          sum += w * beta * environment_->radiance(d);
        }
        return sum;
      }
      const Surface s = world_.surface_at(hit, d);
      if (s.material->transmits) {
        const Vec3 through = transmit(s, -d);
        const float pass = mean(through);
        if (pass > 0) {
          const bool passes = pass >= 1 || sampler.pair().x < pass;
          beta *= passes ? through * (1 / pass) : Vec3(1 / (1 - pass));
          if (passes) {
            if (++passed > kMostPassed) return sum;
            o = s.start(d);
            --depth;
            continue;
          }
        }
      }
      if (!is_zero(s.emission)) {
        float w = 1;
        if (bsdf_density > 0) {
          const float cos = -dot(s.ng, d), t2 = length2(s.p - from);
          w = power_heuristic(bsdf_density, (1 - pick_environment_) *
                                                world_.emitter_density(hit) * t2 / cos);
        }
        sum += w * beta * s.emission;
      }
      if (depth == bounces_) return sum;
      if (!is_specular(s)) {
        if (irradiance_ && s.model == Model::diffuse && bsdf_density > 0 && s.outside && hit.t > gather_from_) {
          const Vec3 known = world_.interpolate(irradiance_, hit);
          if (is_finite(known)) return sum + (1 / kPi) * beta * s.base * known;
        }
        sum += beta * (direct(s, -d, sampler, time) + lamps(s, -d, time));
      }
      const Scatter next = sample(s, -d, sampler);
      beta *= next.weight;
      if (largest(beta) == 0) return sum;
      bsdf_density = next.density;
      d = next.wi;
      from = o = s.start(d);
      if (depth >= kSureBounces) {  // the root ends fewer paths, and those it spares stay quiet
        const float survive = std::min(1.0f, std::sqrt(largest(beta)));
        if (sampler.pair().x >= survive) return sum;
        beta *= 1 / survive;
      }
    }
  }

  // Whether another face lies on this one, as a lamp lies on a ceiling.
  bool covered(Vec3 p, Vec3 n) const { return world_.intersect(p + near(p) * n, n).t < kCover; }

  // One sample of the irradiance at a point with normal n.
  Vec3 irradiance(Vec3 p, Vec3 n, Sampler& sampler) const {
    Surface s{};
    s.p = p, s.ng = s.ns = n, s.rise = near(p);
    s.base = Vec3(1.0f), s.alpha = 1, s.outside = true;
    const Vec3 sum = direct(s, n, sampler, 0) + lamps(s, n, 0);
    const Scatter next = sample(s, n, sampler);
    return kPi * (sum + radiance(s.start(next.wi), next.wi, sampler, 0, next.density, 1));
  }

 private:
  // Points that are given lie near a face, not on it.
  static float near(Vec3 p) { return 8 * kLift * largest_magnitude(p); }

  // Lights without size, all of them.
  Vec3 lamps(const Surface& s, Vec3 wo, float time) const {
    Vec3 sum;
    for (const DeltaLight& light : world_.delta_lights()) {
      const auto in = light.incident(s.p);
      const Vec3 f = is_zero(in.irradiance) ? Vec3() : shade(s, wo, in.d) * in.irradiance;
      if (!is_zero(f)) sum += f * world_.transmittance(s.start(in.d), in.d, in.t, time);
    }
    return sum;
  }

  // One light sample, weighted against the surface's own: radiance that it sends to wo.
  Vec3 direct(const Surface& s, Vec3 wo, Sampler& sampler, float time) const {
    if (pick_environment_ == 0 && !world_.shines()) return {};
    Pair u = sampler.pair();
    bool sky = pick_environment_ == 1;
    if (pick_environment_ > 0 && !sky) {  // an even chance by the first bit, the rest goes on
      sky = u.bits >> 31;
      u.bits <<= 1;
    }
    if (sky) {
      const auto light = environment_->sample(u.bits, u.y);
      const Vec3 f = shade(s, wo, light.direction);
      if (is_zero(f)) return {};
      const Vec3 share = world_.transmittance(s.start(light.direction), light.direction,
                                              kInfinity, time);
      if (is_zero(share)) return {};
      const float p = pick_environment_ * light.density;
      const float w = power_heuristic(p, density(s, wo, light.direction));
      return (w / p) * share * f * environment_->radiance(light.direction);
    }
    const World::Emitter light = world_.sample_emitter(u, time);
    const Vec3 n = dot(light.n, s.p - light.p) < 0 ? -light.n : light.n;
    const Vec3 start = s.start(light.p - s.p);
    const Vec3 to = light.p + light.rise * n - start;
    const float distance2 = length2(to);
    const Vec3 d = to * (1 / std::sqrt(distance2));
    const float cos_light = -dot(d, n);
    if (!(cos_light > 0)) return {};
    const Vec3 f = shade(s, wo, d);
    if (is_zero(f)) return {};
    const Vec3 share = world_.transmittance(start, to, 1 - kLift, time);
    if (is_zero(share)) return {};
    const float p = (1 - pick_environment_) * light.density * distance2 / cos_light;
    const float w = power_heuristic(p, density(s, wo, d));
    return (w / p) * share * f * light.radiance;
  }

  const World& world_;
  const Environment* environment_;
  int bounces_;
  const float* irradiance_;
  float gather_from_;
  float pick_environment_ = 0;
};

}  // namespace

void path_trace(const World& world, const Camera& camera, int spp, uint64_t seed, int bounces,
                const Environment* environment, const float* irradiance, float gather_from,
                float* radiance) {
  const PixelRays& rays = camera.rays;
  const PathIntegrator integrator(world, environment, bounces, irradiance, gather_from);
  const SampleTable table(spp, seed);
  const tbb::blocked_range2d<int> tiles(0, rays.height, 16, 0, rays.width, 16);
  tbb::parallel_for(tiles, [&](const auto& tile) {
    const FlushDenormals flush;
    for (int y = tile.rows().begin(); y < tile.rows().end(); ++y) {
      for (int x = tile.cols().begin(); x < tile.cols().end(); ++x) {
        const size_t pixel = size_t(y) * rays.width + x;
        Vec3 sum;
        if (camera.sees(y, x)) {
          for (int i = 0; i < spp; ++i) {
            Sampler sampler(table, mix64(seed) + pixel, i);
            const CameraRay ray = camera.sample(y, x, sampler);
            sum += integrator.radiance(ray.o, ray.d, sampler, ray.time);
          }
        }
        const Vec3 out = sum * (1.0f / float(spp));
        radiance[3 * pixel] = out.x, radiance[3 * pixel + 1] = out.y;
        radiance[3 * pixel + 2] = out.z;
      }
    }
  });
}

void irradiance(const World& world, const float* points, const float* normals, size_t count,
                int spp, uint64_t seed, int bounces, const Environment* environment,
                float* irradiance) {
  const PathIntegrator integrator(world, environment, bounces);
  const SampleTable table(spp, seed);
  tbb::parallel_for(tbb::blocked_range<size_t>(0, count, 64), [&](const auto& range) {
    const FlushDenormals flush;
    for (size_t k = range.begin(); k < range.end(); ++k) {
      const Vec3 p(&points[3 * k]), n(&normals[3 * k]);
      Vec3 sum;
      for (int i = 0; i < spp; ++i) {
        Sampler sampler(table, mix64(seed) + k, i);
        sum += integrator.irradiance(p, n, sampler);
      }
      if (integrator.covered(p, n)) sum = Vec3(std::numeric_limits<float>::quiet_NaN());
      const Vec3 out = sum * (1.0f / float(spp));
      irradiance[3 * k] = out.x, irradiance[3 * k + 1] = out.y, irradiance[3 * k + 2] = out.z;
    }
  });
}

}  // namespace chromeball
