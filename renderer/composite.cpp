#include "composite.h"

#include <tbb/blocked_range2d.h>
#include <tbb/parallel_for.h>

namespace chromeball {
namespace {

constexpr int kSpecularBounces = 24;  // a path lost between mirrors ends here, black

void add(float* to, Vec3 v) { to[0] += v.x, to[1] += v.y, to[2] += v.z; }

}  // namespace

// A mixture over the bounding spheres: uniform in each one's cone, or cosine-weighted where the
// point lies inside a sphere. Spheres below the horizon have no part in it.
struct Compositor::Cones {
  static constexpr int kMost = 32;  // more objects share one cone: see the constructor
  struct Cone {
    Vec3 axis;
    float cosine;  // of the half angle
    float weight;
    bool inside;
  };
  Cone cone[kMost];
  int count = 0;
  float weights = 0;
  Vec3 n;

  Cones(Vec3 x, Vec3 n, const std::vector<Sphere>& bounds) : n(n) {
    for (const Sphere& s : bounds) {
      const Vec3 to = s.centre - x;
      const float height = dot(to, n), distance2 = length2(to), r2 = s.radius * s.radius;
      if (height <= -s.radius) continue;
      Cone c{};
      if (distance2 <= r2 * 1.0001f) {
        c = {{}, 0, kPi, true};
      } else {
        const float distance = std::sqrt(distance2), sine2 = r2 / distance2;
        const float cosine = std::sqrt(1 - sine2);
        const float solid_angle = 2 * kPi * sine2 / (1 + cosine);  // 2 pi (1 - cosine)
        const float rise = std::min(1.0f, height / distance + s.radius / distance);
        c = {to * (1 / distance), cosine, solid_angle * rise, false};
      }
      weights += c.weight;
      cone[count++] = c;
    }
  }

  // u.bits picks the cone, what is left of it and u.y the direction.
  Vec3 sample(Pair u) const {
    float left = u.x * weights;
    int k = 0;
    while (k + 1 < count && left >= cone[k].weight) left -= cone[k++].weight;
    const Cone& c = cone[k];
    const float rest = std::min(left / c.weight, 0x1.fffffep-1f);
    if (c.inside) return Frame(n).world(sample_cosine(rest, u.y));
    const float z = 1 - rest * (1 - c.cosine);
    const float r = std::sqrt(std::max(0.0f, 1 - z * z)), phi = 2 * kPi * u.y;
    return normalize(Frame(c.axis).world({r * std::cos(phi), r * std::sin(phi), z}));
  }

  float density(Vec3 d) const {  // 1/sr
    float sum = 0;
    for (int k = 0; k < count; ++k) {
      const Cone& c = cone[k];
      if (c.inside) {
        sum += c.weight * std::max(0.0f, dot(d, n)) / kPi;
      } else if (dot(d, c.axis) >= c.cosine) {
        sum += c.weight / (2 * kPi * (1 - c.cosine));
      }
    }
    return sum / weights;
  }
};

Compositor::Compositor(const Mesh& objects, std::vector<Sphere> bounds, const StandIn& stand_in,
                       const Environment& environment, Vec3 origin, int bounces, uint64_t seed,
                       uint32_t expected_samples)
    : objects_(objects),
      bounds_(std::move(bounds)),
      captured_(stand_in, environment, origin, seed),
      irradiance_(captured_, seed),
      table_(expected_samples, seed),
      bounces_(bounces),
      seed_(mix64(seed + 0x436f6d70u)) {
  if (bounds_.size() > size_t(Cones::kMost)) {
    throw std::invalid_argument("too many bounding spheres");
  }
  if (objects.size()) {
    accel_.add(objects.vertices.data(), objects.vertices.size() / 3, objects.faces.data(),
               objects.size());
  }
  accel_.commit();
}

bool Compositor::may_hit(Vec3 o, Vec3 d) const {
  for (const Sphere& s : bounds_) {
    const Vec3 to = s.centre - o;
    const float along = dot(to, d), r2 = s.radius * s.radius, distance2 = length2(to);
    if (distance2 <= r2 || (along > 0 && distance2 - along * along <= r2)) return true;
  }
  return false;
}

Hit Compositor::meet_object(Vec3 o, Vec3 d, float tfar, Path& path) const {
  if (!may_hit(o, d)) return {};
  ++path.rays;
  return accel_.intersect(o, d, tfar);
}

Place Compositor::meet_stand_in(Vec3 o, Vec3 d, float tfar, Path& path) const {
  if (!captured_.positional()) return {};
  ++path.rays;
  return captured_.trace(o, d, tfar);
}

// Radiance that an object sends against d. Mirrors and glass are followed; `bounces` counts the
// diffuse interreflections that are left, -1 makes a diffuse surface black.
Vec3 Compositor::object_radiance(Hit hit, Vec3 d, int bounces, Path& path) const {
  Vec3 sum, beta(1.0f);
  for (int k = 0; k < kSpecularBounces; ++k) {
    const Surface s = surface_at(objects_, hit, d);
    sum += beta * objects_.face_emission(hit.face);
    beta *= objects_.face_albedo(hit.face);
    const Kind kind = Kind(objects_.kind[hit.face]);
    if (kind == Kind::diffuse) {
      if (bounces < 0 || largest(beta) == 0) return sum;
      return sum + (1 / kPi) * beta * diffuse_light(s, bounces, path);
    }
    const float u = kind == Kind::glass ? path.sampler.pair().x : 0.0f;
    const Bounce b = bounce_specular(s, d, kind, objects_.ior[hit.face], u);
    const Vec3 o = lift(s.p, b.through ? -s.ng : s.ng);
    d = b.d;
    hit = meet_object(o, d, kInfinity, path);
    const Place place = meet_stand_in(o, d, hit.t, path);
    if (place || !hit) return sum + beta * stand_in_radiance(place, d, bounces, path);
  }
  return sum;
}

// The irradiance of an object's surface: light sampling for what comes straight from the
// captured set, cosine sampling for all.
Vec3 Compositor::diffuse_light(const Surface& s, int bounces, Path& path) const {
  const Vec3 x = lift(s.p, s.ng);
  Vec3 sum;
  if (const auto light = captured_.sample(x, path.sampler.pair())) {
    const float cos = dot(light.d, s.ns);
    if (cos > 0 && dot(light.d, s.ng) > 0) {
      const bool shadowed = may_hit(x, light.d) &&
                            (++path.rays, accel_.occluded(x, light.d, light.t * (1 - 1e-4f)));
      if (!shadowed) {
        const Place place = meet_stand_in(x, light.d, kInfinity, path);
        if (Captured::reaches(light, place)) {
          sum += (cos / (light.density + cos / kPi)) *
                 stand_in_radiance(place, light.d, bounces, path);
        }
      }
    }
  }
  const Pair u = path.sampler.pair();
  const Vec3 local = sample_cosine(u.x, u.y), d = Frame(s.ns).world(local);
  if (dot(d, s.ng) <= 0) return sum;
  const Hit hit = meet_object(x, d, kInfinity, path);
  const Place place = meet_stand_in(x, d, hit.t, path);
  if (hit && !place) {
    return bounces > 0 ? sum + kPi * object_radiance(hit, d, bounces - 1, path) : sum;
  }
  const float cos = std::max(local.z, 1e-6f);
  return sum + (cos / (captured_.density(x, d, place) + cos / kPi)) *
                   stand_in_radiance(place, d, bounces, path);
}

// What a ray sees of the set with the objects in it: L_cap Q.
Vec3 Compositor::stand_in_radiance(const Place& place, Vec3 d, int bounces, Path& path) const {
  const Vec3 captured = captured_.radiance(place, d);
  if (!place.support || bounces <= 0) return captured;
  return captured * (Vec3(1.0f) + relative_change(place, bounces - 1, false, path));
}

// (L_with - L_without) cos for a direction whose first hit is an object.
Vec3 Compositor::change(Vec3 x, Vec3 d, float cos, const Hit& hit, const Place& behind,
                        int bounces, Path& path) const {
  const Vec3 with = object_radiance(hit, d, bounces - 1, path);
  return cos * (with - captured_.radiance(behind, d));
}

Vec3 Compositor::light_change(Vec3 x, Vec3 n, const Cones& cones, float share, int bounces,
                              Path& path) const {
  const auto light = captured_.sample(x, path.sampler.pair());
  if (!light) return {};
  const float cos = dot(light.d, n);
  if (cos <= 0) return {};
  const Hit hit = meet_object(x, light.d, light.t, path);
  if (!hit) return {};
  const Place behind = meet_stand_in(x, light.d, kInfinity, path);
  if (!Captured::reaches(light, behind)) return {};
  const float density = share * (light.density + cones.density(light.d));
  return (1 / density) * change(x, light.d, cos, hit, behind, bounces, path);
}

Vec3 Compositor::cone_change(Vec3 x, Vec3 n, const Cones& cones, float share, int bounces,
                             Path& path) const {
  const Vec3 d = cones.sample(path.sampler.pair());
  const float cos = dot(d, n);
  if (cos <= 0) return {};
  const Hit hit = meet_object(x, d, kInfinity, path);
  if (!hit) return {};
  const Place behind = meet_stand_in(x, d, kInfinity, path);
  if (behind && behind.t < hit.t) return {};
  const float density = share * (captured_.density(x, d, behind) + cones.density(d));
  return (1 / density) * change(x, d, cos, hit, behind, bounces, path);
}

// An estimate of dE / E_without, by both strategies or by one of them at random. Nothing is
// random where no sample meets an object: it is 0.
Vec3 Compositor::relative_change(const Place& place, int bounces, bool both, Path& path) const {
  const Vec3 x = lift(place.p, place.n);
  const Cones cones(x, place.n, bounds_);
  if (cones.count == 0) return {};
  Vec3 dE;
  if (both) {
    dE = light_change(x, place.n, cones, 1, bounces, path) +
         cone_change(x, place.n, cones, 1, bounces, path);
  } else if (path.sampler.pair().x < 0.5f) {
    dE = light_change(x, place.n, cones, 0.5f, bounces, path);
  } else {
    dE = cone_change(x, place.n, cones, 0.5f, bounces, path);
  }
  if (is_zero(dE)) return {};
  const Vec3 E = irradiance_.at(place);
  return {E.x > 0 ? dE.x / E.x : 0, E.y > 0 ? dE.y / E.y : 0, E.z > 0 ? dE.z / E.z : 0};
}

uint64_t Compositor::pass(const PixelRays& rays, Vec3 camera, const float* plate,
                          bool difference, const uint16_t* counts, float* film) const {
  std::atomic<uint64_t> traced{0};
  const tbb::blocked_range2d<int> tiles(0, rays.height, 8, 0, rays.width, 8);
  tbb::parallel_for(tiles, [&](const auto& tile) {
    const FlushDenormals flush;
    uint64_t tile_rays = 0;
    for (int y = tile.rows().begin(); y < tile.rows().end(); ++y) {
      for (int x = tile.cols().begin(); x < tile.cols().end(); ++x) {
        if (!is_finite(rays.direction(y, x, 0.5f, 0.5f))) continue;
        const size_t pixel = size_t(y) * rays.width + x;
        float* to = film + Film::kCount * pixel;
        const Vec3 B(plate + 3 * pixel);
        const uint32_t first = uint32_t(to[Film::kSamples]);
        to[Film::kSamples] += counts[pixel];
        for (uint32_t i = first; i < first + counts[pixel]; ++i) {
          Sampler sampler(table_, seed_ + pixel, i);
          Path path{sampler};
          const Pair u = sampler.pair();
          const Vec3 d = rays.direction(y, x, u.x, u.y);
          const Place place = meet_stand_in(camera, d, kInfinity, path);
          const Hit hit = meet_object(camera, d, place.t, path);
          Vec3 value = B;
          if (hit) {
            value = object_radiance(hit, d, bounces_, path);
            add(to + Film::kObject, value);
            to[Film::kCoverage] += 1;
          } else if (place.support) {
            const Vec3 dQ = relative_change(place, bounces_, true, path);
            const Vec3 dL = is_zero(dQ) || !difference
                                ? Vec3()
                                : captured_.radiance(place, d) * dQ;
            value = difference ? B + dL : B * (Vec3(1.0f) + dQ);
            add(to + Film::kChange, dQ);
            add(to + Film::kDifference, dL);
            to[Film::kSupport] += 1;
          }
          if (const float t = std::min(hit.t, place.t); t < kInfinity) {
            to[Film::kDepth] += t;
            to[Film::kSurfaces] += 1;
          }
          const float brightness = mean(value);
          to[Film::kBrightness] += brightness;
          to[Film::kSquare] += brightness * brightness;
          tile_rays += path.rays;
        }
      }
    }
    traced += tile_rays;
  });
  return traced;
}

void Compositor::background(const PixelRays& rays, Vec3 camera, uint32_t count,
                            float* radiance) const {
  const tbb::blocked_range2d<int> tiles(0, rays.height, 16, 0, rays.width, 16);
  tbb::parallel_for(tiles, [&](const auto& tile) {
    const FlushDenormals flush;
    for (int y = tile.rows().begin(); y < tile.rows().end(); ++y) {
      for (int x = tile.cols().begin(); x < tile.cols().end(); ++x) {
        if (!is_finite(rays.direction(y, x, 0.5f, 0.5f))) continue;
        const size_t pixel = size_t(y) * rays.width + x;
        Vec3 sum;
        for (uint32_t i = 0; i < count; ++i) {
          Sampler sampler(table_, ~seed_ + pixel, i);
          const Pair u = sampler.pair();
          const Vec3 d = rays.direction(y, x, u.x, u.y);
          sum += captured_.radiance(captured_.trace(camera, d), d);
        }
        add(radiance + 3 * pixel, sum * (1.0f / float(count)));
      }
    }
  });
}

}  // namespace chromeball
