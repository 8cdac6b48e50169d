#include "path.h"

#include <tbb/blocked_range.h>
#include <tbb/blocked_range2d.h>
#include <tbb/parallel_for.h>

#include "sampler.h"

namespace chromeball {
namespace {

constexpr float kCover = 5e-3f;  // metres
constexpr int kSureBounces = 5;  // roulette may end a path after these

class PathIntegrator {
 public:
  PathIntegrator(const Mesh& mesh, const Environment* environment, int bounces,
                 const float* irradiance = nullptr, float gather_from = 0)
      : mesh_(mesh),
        environment_(environment),
        emitters_(power(mesh)),
        bounces_(bounces),
        irradiance_(irradiance),
        gather_from_(gather_from) {
    if (mesh.size()) {
      accel_.add(mesh.vertices.data(), mesh.vertices.size() / 3, mesh.faces.data(), mesh.size());
    }
    accel_.commit();
    const bool sky = environment_ && !environment_->even();
    pick_environment_ = !sky ? 0.0f : emitters_.empty() ? 1.0f : 0.5f;
    // area density of a point on an emitter: (power / area) / sum of powers
    if (!emitters_.empty()) inverse_power_ = float(1.0 / emitters_.sum());
  }

  // bsdf_density of d; 0: the last bounce was specular, or this is the camera ray.
  Vec3 radiance(Vec3 o, Vec3 d, Sampler& sampler, float bsdf_density = 0, int depth = 0) const {
    Vec3 sum, beta(1.0f);
    for (;; ++depth) {
      const Hit hit = accel_.intersect(o, d);
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
      const Vec3 emission = mesh_.face_emission(hit.face);
      const Kind kind = Kind(mesh_.kind[hit.face]);
      const Surface s = surface_at(mesh_, hit, d);
      if (!is_zero(emission)) {
        float w = 1;
        if (bsdf_density > 0) {
          const float cos = -dot(s.ng, d);
          w = power_heuristic(bsdf_density,
                              emitter_density(emission) * hit.t * hit.t / cos);
        }
        sum += w * beta * emission;
      }
      if (depth == bounces_) return sum;
      const Vec3 albedo = mesh_.face_albedo(hit.face);
      beta *= albedo;
      if (largest(beta) == 0) return sum;

      if (kind == Kind::diffuse) {
        if (irradiance_ && bsdf_density > 0 && s.outside && hit.t > gather_from_) {
          const Vec3 known = known_irradiance(hit);
          if (is_finite(known)) return sum + (1 / kPi) * beta * known;
        }
        const Frame frame(s.ns);
        const Vec3 start = lift(s.p, s.ng);
        sum += beta * direct(start, s, sampler);
        const Pair u = sampler.pair();
        const Vec3 local = sample_cosine(u.x, u.y);
        d = frame.world(local);
        if (dot(d, s.ng) <= 0) return sum;
        bsdf_density = std::max(local.z, 1e-6f) / kPi;
        o = start;
      } else {
        bsdf_density = 0;
        const float u = kind == Kind::glass ? sampler.pair().x : 0.0f;
        const Bounce b = bounce_specular(s, d, kind, mesh_.ior[hit.face], u);
        d = b.d;
        o = lift(s.p, b.through ? -s.ng : s.ng);
      }
      if (depth >= kSureBounces) {  // the root ends fewer paths, and those it spares stay quiet
        const float survive = std::min(1.0f, std::sqrt(largest(beta)));
        if (sampler.pair().x >= survive) return sum;
        beta *= 1 / survive;
      }
    }
  }

  // Whether another face lies on this one, as a lamp lies on a ceiling.
  bool covered(Vec3 p, Vec3 n) const { return accel_.intersect(lift(p, n), n).t < kCover; }

  // One sample of the irradiance at a point with normal n.
  Vec3 irradiance(Vec3 p, Vec3 n, Sampler& sampler) const {
    const Surface s{p, n, n, true};
    const Vec3 start = lift(p, n);
    Vec3 sum = direct(start, s, sampler);
    const Pair u = sampler.pair();
    const Vec3 local = sample_cosine(u.x, u.y);
    sum += radiance(start, Frame(n).world(local), sampler, std::max(local.z, 1e-6f) / kPi, 1);
    return kPi * sum;
  }

 private:
  Vec3 known_irradiance(const Hit& hit) const {
    const uint32_t* f = &mesh_.faces[3 * hit.face];
    return (1 - hit.u - hit.v) * Vec3(&irradiance_[3 * f[0]]) +
           hit.u * Vec3(&irradiance_[3 * f[1]]) + hit.v * Vec3(&irradiance_[3 * f[2]]);
  }

  static std::vector<float> power(const Mesh& mesh) {
    std::vector<float> p(mesh.size());
    for (uint32_t f = 0; f < mesh.size(); ++f) {
      const float area = 0.5f * length(cross(mesh.corner(f, 1) - mesh.corner(f, 0),
                                             mesh.corner(f, 2) - mesh.corner(f, 0)));
      p[f] = area * mean(mesh.face_emission(f));
    }
    return p;
  }

  float emitter_density(Vec3 emission) const {  // 1/m^2
    return (1 - pick_environment_) * mean(emission) * inverse_power_;
  }

  // One light sample, weighted against the cosine sample; without the albedo.
  Vec3 direct(Vec3 start, const Surface& s, Sampler& sampler) const {
    if (pick_environment_ == 0 && emitters_.empty()) return {};
    Pair u = sampler.pair();
    bool sky = pick_environment_ == 1;
    if (pick_environment_ > 0 && !sky) {  // an even chance by the first bit, the rest goes on
      sky = u.bits >> 31;
      u.bits <<= 1;
    }
    if (sky) {
      const auto sample = environment_->sample(u.bits, u.y);
      const float cos = dot(sample.direction, s.ns);
      if (cos <= 0 || dot(sample.direction, s.ng) <= 0) return {};
      if (accel_.occluded(start, sample.direction)) return {};
      const float density = pick_environment_ * sample.density;
      const float w = power_heuristic(density, cos / kPi);
      return (w * cos / (kPi * density)) * environment_->radiance(sample.direction);
    }
    const auto pick = emitters_.sample(u.bits);
    const Vec3 a = mesh_.corner(pick.index, 0);
    const Vec3 ab = mesh_.corner(pick.index, 1) - a, ac = mesh_.corner(pick.index, 2) - a;
    const float root = std::sqrt(pick.rest);
    const Vec3 q = a + root * (1 - u.y) * ab + root * u.y * ac;
    Vec3 n = normalize(cross(ab, ac));
    if (dot(n, start - q) < 0) n = -n;
    const Vec3 to = lift(q, n) - start;
    const float distance2 = length2(to);
    const Vec3 d = to * (1 / std::sqrt(distance2));
    const float cos = dot(d, s.ns), cos_light = -dot(d, n);
    if (cos <= 0 || cos_light <= 0 || dot(d, s.ng) <= 0) return {};
    if (accel_.occluded(start, to, 1.0f)) return {};
    const Vec3 emission = mesh_.face_emission(pick.index);
    const float density = emitter_density(emission) * distance2 / cos_light;
    const float w = power_heuristic(density, cos / kPi);
    return (w * cos / (kPi * density)) * emission;
  }

  const Mesh& mesh_;
  const Environment* environment_;
  Distribution emitters_;
  Accel accel_;
  int bounces_;
  const float* irradiance_;
  float gather_from_;
  float pick_environment_ = 0, inverse_power_ = 0;
};

}  // namespace

void path_trace(const Mesh& mesh, const PixelRays& rays, Vec3 origin, int spp, uint64_t seed,
                int bounces, const Environment* environment, const float* irradiance,
                float gather_from, float* radiance) {
  const PathIntegrator integrator(mesh, environment, bounces, irradiance, gather_from);
  const SampleTable table(spp, seed);
  const tbb::blocked_range2d<int> tiles(0, rays.height, 16, 0, rays.width, 16);
  tbb::parallel_for(tiles, [&](const auto& tile) {
    const FlushDenormals flush;
    for (int y = tile.rows().begin(); y < tile.rows().end(); ++y) {
      for (int x = tile.cols().begin(); x < tile.cols().end(); ++x) {
        const size_t pixel = size_t(y) * rays.width + x;
        Vec3 sum;
        if (is_finite(rays.direction(y, x, 0.5f, 0.5f))) {
          for (int i = 0; i < spp; ++i) {
            Sampler sampler(table, mix64(seed) + pixel, i);
            const Pair u = sampler.pair();
            sum += integrator.radiance(origin, rays.direction(y, x, u.x, u.y), sampler);
          }
        }
        const Vec3 out = sum * (1.0f / float(spp));
        radiance[3 * pixel] = out.x, radiance[3 * pixel + 1] = out.y;
        radiance[3 * pixel + 2] = out.z;
      }
    }
  });
}

void irradiance(const Mesh& mesh, const float* points, const float* normals, size_t count,
                int spp, uint64_t seed, int bounces, const Environment* environment,
                float* irradiance) {
  const PathIntegrator integrator(mesh, environment, bounces);
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
