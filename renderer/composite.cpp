#include "composite.h"

#include <tbb/blocked_range2d.h>
#include <tbb/parallel_for.h>

namespace chromeball {
namespace {

constexpr int kMostScatterings = 128;  // a path lost between mirrors ends here, black
constexpr int kSureScatterings = 8;  // roulette may end a path after these
constexpr int kMostPassed = 256;

bool is_one(Vec3 v) { return v.x == 1 && v.y == 1 && v.z == 1; }

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

Compositor::Compositor(World& objects, const StandIn& stand_in, const Environment& environment,
                       Vec3 origin, int bounces, uint64_t seed, uint32_t expected_samples)
    : objects_(&objects),
      captured_(stand_in, environment, origin, seed),
      irradiance_(captured_, seed),
      table_(expected_samples, seed),
      bounces_(bounces),
      seed_(mix64(seed + 0x436f6d70u)) {
  find_bounds();
}

void Compositor::place(World& objects) {
  objects_ = &objects;
  find_bounds();
}

void Compositor::move(uint32_t object, const double* matrix) {
  objects_->move(object, matrix);
  find_bounds();
}

void Compositor::find_bounds() {
  const auto all = objects_->bounds();
  bounds_.assign(all.begin(), all.end());
  if (bounds_.size() <= size_t(Cones::kMost)) return;
  Vec3 low(kInfinity), high(-kInfinity);
  for (const Sphere& s : bounds_) {
    const Vec3 r(s.radius), a = s.centre - r, b = s.centre + r;
    low = {std::min(low.x, a.x), std::min(low.y, a.y), std::min(low.z, a.z)};
    high = {std::max(high.x, b.x), std::max(high.y, b.y), std::max(high.z, b.z)};
  }
  bounds_ = {{0.5f * low + 0.5f * high, 0.5f * length(high - low)}};
}

bool Compositor::may_hit(Vec3 o, Vec3 d) const {
  for (const Sphere& s : bounds_) {
    const Vec3 to = s.centre - o;
    const float along = dot(to, d), r2 = s.radius * s.radius, distance2 = length2(to);
    if (distance2 <= r2 || (along > 0 && distance2 - along * along <= r2)) return true;
  }
  return false;
}

Hit Compositor::meet_object(Vec3 o, Vec3 d, float tfar, Vec3& share, Path& path) const {
  if (!may_hit(o, d)) return {};
  ++path.rays;
  Hit hit = objects_->intersect(o, d, tfar);
  if (!objects_->transmits()) return hit;
  float before = 0;
  for (int k = 0; k < kMostPassed && hit && objects_->material(hit).transmits; ++k) {
    const Surface s = objects_->surface_at(hit, d);
    const Vec3 through = transmit(s, -d);
    const float pass = mean(through);
    if (pass <= 0) break;
    if (pass < 1 && path.sampler.pair().x >= pass) {
      share *= 1 / (1 - pass);
      break;
    }
    share *= through * (1 / pass);
    const Vec3 next = s.start(d);
    before += dot(next - o, d);
    o = next;
    ++path.rays;
    hit = objects_->intersect(o, d, tfar - before);
  }
  if (hit) hit.t += before;
  return hit;
}

Place Compositor::meet_stand_in(Vec3 o, Vec3 d, float tfar, Path& path) const {
  if (!captured_.positional()) return {};
  ++path.rays;
  return captured_.trace(o, d, tfar);
}

Compositor::Meeting Compositor::meet(Vec3 o, Vec3 d, Vec3& share, Path& path) const {
  if (objects_->transmits()) {  // what lies behind the set must not dim it
    const Place place = meet_stand_in(o, d, kInfinity, path);
    const Hit hit = meet_object(o, d, place.t, share, path);
    return {hit, hit ? Place() : place};
  }
  const Hit hit = meet_object(o, d, kInfinity, share, path);
  const Place place = meet_stand_in(o, d, hit.t, path);
  return {place ? Hit() : hit, place};
}

// Radiance that an object sends against d. Directions that are certain are always followed;
// `bounces` counts the interreflections that are left, at -1 only lamps and mirrors are seen.
Vec3 Compositor::object_radiance(Hit hit, Vec3 d, int bounces, Path& path) const {
  Vec3 sum, beta(1.0f);
  for (int k = 0; k < kMostScatterings; ++k) {
    const Surface s = objects_->surface_at(hit, d);
    sum += beta * s.emission;
    const bool specular = is_specular(s);
    if (!specular) {
      if (bounces < 0) return sum;
      sum += beta * direct_light(s, -d, bounces, path);
    }
    const Scatter next = sample(s, -d, path.sampler);
    beta *= next.weight;
    if (largest(beta) <= 0) return sum;
    if (k >= kSureScatterings) {  // the root ends fewer, and those it spares stay quiet
      const float survive = std::min(1.0f, std::sqrt(largest(beta)));
      if (survive < 1 && path.sampler.pair().x >= survive) return sum;
      beta *= 1 / survive;
    }
    d = next.wi;
    const Vec3 o = s.start(d);
    const auto [object, place] = meet(o, d, beta, path);
    hit = object;
    if (!hit) {
      const float other = next.density > 0 ? captured_.density(o, d, place) : 0;
      const float w = other > 0 ? next.density / (next.density + other) : 1;
      return sum + w * beta * stand_in_radiance(place, d, bounces, path);
    }
    if (next.blurs) --bounces;
  }
  return sum;
}

// What comes straight from the captured set and is sent on to wo, by light sampling, weighted
// against the surface's own sampling (the balance heuristic, Veach 1997).
Vec3 Compositor::direct_light(const Surface& s, Vec3 wo, int bounces, Path& path) const {
  const auto light = captured_.sample(s.p, path.sampler.pair());
  if (!light) return {};
  Vec3 f = shade(s, wo, light.d);
  if (is_zero(f)) return {};
  const Vec3 x = s.start(light.d);
  if (may_hit(x, light.d)) {
    ++path.rays;
    f *= objects_->transmittance(x, light.d, light.t * (1 - 1e-4f));
    if (is_zero(f)) return {};
  }
  const Place place = meet_stand_in(x, light.d, kInfinity, path);
  if (!Captured::reaches(light, place)) return {};
  return (1 / (light.density + density(s, wo, light.d))) * f *
         stand_in_radiance(place, light.d, bounces, path);
}

// What a ray sees of the set with the objects in it: L_cap Q.
Vec3 Compositor::stand_in_radiance(const Place& place, Vec3 d, int bounces, Path& path) const {
  const Vec3 captured = captured_.radiance(place, d);
  if (!place.support || bounces <= 0) return captured;
  return captured * (Vec3(1.0f) + relative_change(place, bounces - 1, false, path));
}

// (L_with - L_without) cos for a direction whose first hit is an object.
Vec3 Compositor::change(Vec3 d, float cos, const Hit& hit, Vec3 share, const Place& behind,
                        int bounces, Path& path) const {
  const Vec3 without = captured_.radiance(behind, d);
  // what came through thin surfaces to the set is seen there, coloured
  if (!hit) return cos * (share - Vec3(1.0f)) * without;
  return cos * (share * object_radiance(hit, d, bounces - 1, path) - without);
}

Vec3 Compositor::light_change(Vec3 x, Vec3 n, const Cones& cones, float share, int bounces,
                              Path& path) const {
  const auto light = captured_.sample(x, path.sampler.pair());
  if (!light) return {};
  const float cos = dot(light.d, n);
  if (cos <= 0) return {};
  Vec3 through(1.0f);
  const Hit hit = meet_object(x, light.d, light.t, through, path);
  if (!hit && is_one(through)) return {};
  const Place behind = meet_stand_in(x, light.d, kInfinity, path);
  if (!Captured::reaches(light, behind)) return {};
  const float density = share * (light.density + cones.density(light.d));
  return (1 / density) * change(light.d, cos, hit, through, behind, bounces, path);
}

Vec3 Compositor::cone_change(Vec3 x, Vec3 n, const Cones& cones, float share, int bounces,
                             Path& path) const {
  const Vec3 d = cones.sample(path.sampler.pair());
  const float cos = dot(d, n);
  if (cos <= 0) return {};
  Vec3 through(1.0f);
  Place behind;
  if (objects_->transmits()) behind = meet_stand_in(x, d, kInfinity, path);
  const Hit hit = meet_object(x, d, behind.t, through, path);
  if (!hit && is_one(through)) return {};
  if (!objects_->transmits()) behind = meet_stand_in(x, d, kInfinity, path);
  if (hit && behind.t < hit.t) return {};
  const float density = share * (captured_.density(x, d, behind) + cones.density(d));
  return (1 / density) * change(d, cos, hit, through, behind, bounces, path);
}

// An estimate of dE / E_without, by both strategies or by one of them at random. Nothing is
// random where no sample meets an object: it is 0.
Vec3 Compositor::relative_change(const Place& place, int bounces, bool both, Path& path) const {
  const Vec3 x = place.start();
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
          Vec3 through(1.0f);
          const Hit hit = meet_object(camera, d, place.t, through, path);
          Vec3 value = B;
          if (hit) {
            value = through * object_radiance(hit, d, bounces_, path);
            add(to + Film::kObject, value);
            to[Film::kCoverage] += 1;
          } else if (place.support) {
            const Vec3 dQ = relative_change(place, bounces_, true, path);
            const Vec3 dL = is_zero(dQ) || !difference
                                ? Vec3()
                                : captured_.radiance(place, d) * dQ;
            value = through * (difference ? B + dL : B * (Vec3(1.0f) + dQ));
            add(to + Film::kChange, through * dQ);
            add(to + Film::kDifference, through * dL);
            to[Film::kSupport] += 1;
          } else {
            value *= through;
          }
          if (!hit && !is_one(through)) {  // the plate, dimmed evenly and then coloured
            const float grey = mean(through);
            add(to + Film::kObject, (through - Vec3(grey)) * B);
            to[Film::kCoverage] += 1 - grey;
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
