#include "composite.h"

#include <tbb/blocked_range2d.h>
#include <tbb/parallel_for.h>

namespace chromeball {
namespace {

constexpr int kMostScatterings = 1024;  // a path lost between mirrors ends here, black
constexpr int kSureScatterings = 8;  // roulette may end a path after these
constexpr int kMostPassed = 256;
constexpr float kSplit = 0.2f;

bool is_one(Vec3 v) { return v.x == 1 && v.y == 1 && v.z == 1; }

}  // namespace

Compositor::Compositor(World& objects, const StandIn& stand_in, const Environment& environment,
                       Vec3 origin, int bounces, uint64_t seed, uint32_t expected_samples)
    : objects_(&objects),
      captured_(stand_in, environment, origin, seed),
      irradiance_(captured_, seed),
      table_(expected_samples, seed),
      photon_table_(SampleTable::kMost, seed + 1),
      bounces_(bounces),
      seed_(mix64(seed + 0x436f6d70u)) {
  bounds_ = Bounds(objects_->bounds());
}

void Compositor::place(World& objects) {
  objects_ = &objects;
  bounds_ = Bounds(objects_->bounds());
}

void Compositor::move(uint32_t object, const double* matrices, size_t steps) {
  objects_->move(object, matrices, steps);
  bounds_ = Bounds(objects_->bounds());
}

Hit Compositor::meet_object(Vec3 o, Vec3 d, float tfar, Vec3& share, Path& path) const {
  if (!bounds_.may_hit(o, d)) return {};
  ++path.rays;
  Hit hit = objects_->intersect(o, d, tfar, path.time);
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
    hit = objects_->intersect(o, d, tfar - before, path.time);
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
Vec3 Compositor::object_radiance(Hit hit, Vec3 d, Trail trail, Path& path) const {
  Vec3 sum, beta(1.0f), from;
  float arrived = 0;  // density with which d was chosen at `from`; 0: not against light sampling
  int bounces = trail.bounces;
  bool certain = true;  // every direction so far
  bool sharp = trail.sharp && !trail.from_set;  // the same for a surface's light sampling and its own
  float kept = 1;       // of the light, where glass was followed both ways
  for (int k = 0; k < kMostScatterings; ++k) {
    const Surface s = objects_->surface_at(hit, d);
    if (!is_zero(s.emission)) {
      const float other = arrived > 0 ? lamp_density(s, hit, from, d) : 0;
      const bool by_photons = trail.from_set && path.photons && certain && k > 0;
      const float rest = by_photons ? 1 - captured_.peaks().share(s.emission) : 1;
      sum += (other > 0 ? arrived / (arrived + other) : rest) * beta * s.emission;
    }
    const bool specular = is_specular(s);
    if (!specular) {
      if (bounces < 0) return sum;
      sum += beta * (direct_light(s, -d, bounces, sharp && keeps_detail(s), path) + delta_light(s, -d, path));
    }
    Scatter next, other;
    if (trail.share * largest(beta) > kSplit && split(s, -d, next, other)) {
      const float share = trail.share * largest(beta * other.weight);
      sum += beta * other.weight * beyond(s, other.wi, {bounces, false, share, sharp}, path);
      kept *= largest(next.weight);
    } else {
      next = sample(s, -d, path.sampler);
    }
    beta *= next.weight;
    if (largest(beta) <= 0) return sum;
    if (k >= kSureScatterings) {  // the root ends fewer, and those it spares stay quiet
      const float survive = std::min(1.0f, std::sqrt(largest(beta) / kept));
      if (survive < 1 && path.sampler.pair().x >= survive) return sum;
      beta *= 1 / survive;
    }
    d = next.wi;
    arrived = next.density;
    certain &= next.density == 0;
    sharp &= keeps_detail(s);
    const Vec3 o = from = s.start(d);
    const auto [object, place] = meet(o, d, beta, path);
    hit = object;
    if (!hit) {
      const float other = next.density > 0 ? captured_.density(o, d, place) : 0;
      const float w = other > 0 ? next.density / (next.density + other) : 1;
      Vec3 L = stand_in_radiance(place, d, bounces, {certain && !trail.from_set, sharp}, path);
      if (certain && trail.from_set && path.photons) L += -captured_.peak(d, place);
      return sum + w * beta * L;
    }
    // what goes through a solid and about in it is no interreflection
    const bool within = s.transmission > 0 && (dot(d, s.ng) < 0 || !s.outside);
    if (next.blurs && !within) --bounces;
  }
  return sum;
}

// What arrives at a surface against a certain direction d.
Vec3 Compositor::beyond(const Surface& s, Vec3 d, Trail trail, Path& path) const {
  Vec3 share(1.0f);
  const auto [hit, place] = meet(s.start(d), d, share, path);
  return share * (hit ? object_radiance(hit, d, trail, path)
                      : stand_in_radiance(place, d, trail.bounces, {true, trail.sharp}, path));
}

// The density over solid angle at `from` with which light sampling picks a lamp's place.
float Compositor::lamp_density(const Surface& s, const Hit& hit, Vec3 from, Vec3 d) const {
  const float cos = -dot(s.ng, d);
  return cos > 0 ? objects_->emitter_density(hit) * length2(s.p - from) / cos : 0;
}

// What comes straight from the captured set and from lamps among the objects and is sent on to
// wo, by light sampling, weighted against the surface's own (the balance heuristic, Veach 1997).
Vec3 Compositor::direct_light(const Surface& s, Vec3 wo, int bounces, bool plate,
                              Path& path) const {
  Vec3 sum = captured_light(s, wo, bounces, plate, path);
  if (!objects_->shines()) return sum;
  const World::Emitter lamp = objects_->sample_emitter(path.sampler.pair(), path.time);
  const Vec3 n = dot(lamp.n, s.p - lamp.p) < 0 ? -lamp.n : lamp.n;
  const Vec3 x = s.start(lamp.p - s.p), to = lamp.p + lamp.rise * n - x;
  const float t2 = length2(to), t = std::sqrt(t2);
  const Vec3 d = to * (1 / t);
  const float cos = -dot(d, n);
  if (!(cos > 0)) return sum;
  Vec3 f = shade(s, wo, d);
  if (is_zero(f)) return sum;
  path.rays += 2;
  f *= objects_->transmittance(x, to, 1 - kLift, path.time);
  if (is_zero(f) || captured_.blocked(x, to, 1 - kLift)) return sum;
  return sum + (1 / (lamp.density * t2 / cos + density(s, wo, d))) * f * lamp.radiance;
}

Vec3 Compositor::captured_light(const Surface& s, Vec3 wo, int bounces, bool plate,
                                Path& path) const {
  const auto light = captured_.sample(s.p, path.sampler.pair());
  if (!light) return {};
  Vec3 f = shade(s, wo, light.d);
  if (is_zero(f)) return {};
  const Vec3 x = s.start(light.d);
  if (bounds_.may_hit(x, light.d)) {
    ++path.rays;
    f *= objects_->transmittance(x, light.d, light.t * (1 - 1e-4f), path.time);
    if (is_zero(f)) return {};
  }
  const Place place = meet_stand_in(x, light.d, kInfinity, path);
  if (!Captured::reaches(light, place)) return {};
  return (1 / (light.density + density(s, wo, light.d))) * f *
         stand_in_radiance(place, light.d, bounces, {false, plate}, path);
}

// The captured set stands in the way of a light. Geometry that only emits stands for what is
// far away, and a sun is farther.
bool Compositor::in_shadow_of_set(Vec3 x, const DeltaLight& light,
                                  const DeltaLight::Incident& in, Path& path) const {
  const Place place = meet_stand_in(x, in.d, in.t, path);
  return place && (place.support || !light.sun);
}

// What the lights without size send to a surface of an object, and this on to wo.
Vec3 Compositor::delta_light(const Surface& s, Vec3 wo, Path& path) const {
  Vec3 sum;
  for (const DeltaLight& light : objects_->delta_lights()) {
    const auto in = light.incident(s.p);
    Vec3 f = is_zero(in.irradiance) ? Vec3() : shade(s, wo, in.d) * in.irradiance;
    if (is_zero(f)) continue;
    const Vec3 x = s.start(in.d);
    if (bounds_.may_hit(x, in.d)) {
      ++path.rays;
      f *= objects_->transmittance(x, in.d, in.t, path.time);
      if (is_zero(f)) continue;
    }
    if (!in_shadow_of_set(x, light, in, path)) sum += f;
  }
  return sum;
}

// What they add to the irradiance of a support surface.
Vec3 Compositor::delta_change(Vec3 x, Vec3 n, Path& path) const {
  Vec3 dE;
  for (const DeltaLight& light : objects_->delta_lights()) {
    const auto in = light.incident(x);
    const float cos = dot(in.d, n);
    if (!(cos > 0) || is_zero(in.irradiance)) continue;
    Vec3 E = cos * in.irradiance;
    if (bounds_.may_hit(x, in.d)) {
      ++path.rays;
      E *= objects_->transmittance(x, in.d, in.t, path.time);
      if (is_zero(E)) continue;
    }
    if (!in_shadow_of_set(x, light, in, path)) dE += E;
  }
  return dE;
}

// What a ray sees of the set with the objects in it: L_cap Q.
Vec3 Compositor::stand_in_radiance(const Place& place, Vec3 d, int bounces, Look look,
                                   Path& path) const {
  Vec3 captured = captured_.radiance(place, d);
  if (!place.support) return captured;
  if (look.plate && path.plate) captured = plate_radiance(place, captured, path);
  if (bounces <= 0) return captured;
  return captured * (Vec3(1.0f) + relative_change(place, bounces - 1, look.all, path));
}

// Support surfaces are matt: the plate shows them as any ray sees them, where it sees them. What
// an object hides from the camera may be a real thing that is to be removed.
Vec3 Compositor::plate_radiance(const Place& place, Vec3 captured, Path& path) const {
  const Vec3 x = place.start(), to = path.plate->eye() - x;
  if (dot(to, place.n) <= 0) return captured;
  if (length(place.p - place.captured_at) > 8 * place.rise) return captured;
  const Vec3 d = unit_or(to, place.n);
  const auto seen = path.plate->at(-d);
  if (seen.weight == 0) return captured;
  path.rays += 2;
  if (captured_.blocked(x, to, 1 - kLift)) return captured;
  if (bounds_.may_hit(x, d) && objects_->occluded(x, to, 1, path.time)) return captured;
  return mix(captured, seen.radiance, seen.weight);
}

// (L_with - L_without) cos for a direction whose first hit is an object, over the density with
// which the strategies together choose it. `share` is what thin surfaces in front let through.
Vec3 Compositor::change(Vec3 x, Vec3 n, Vec3 d, const Hit& hit, Vec3 share, const Place& behind,
                        const Cones& cones, float light, int bounces, Path& path) const {
  const Vec3 without = captured_.radiance(behind, d);
  float density = light + cones.density(d);
  Vec3 with = share * without;  // only coloured
  if (hit) {
    if (objects_->shines()) density += lamp_density(objects_->surface_at(hit, d), hit, x, d);
    with = share * object_radiance(hit, d, {bounces - 1, true}, path);
  }
  return (dot(d, n) / density) * (with - without);
}

Vec3 Compositor::light_change(Vec3 x, Vec3 n, const Cones& cones, int bounces,
                              Path& path) const {
  const auto light = captured_.sample(x, path.sampler.pair());
  if (!light || dot(light.d, n) <= 0) return {};
  Vec3 through(1.0f);
  const Hit hit = meet_object(x, light.d, light.t, through, path);
  if (!hit && is_one(through)) return {};
  const Place behind = meet_stand_in(x, light.d, kInfinity, path);
  if (!Captured::reaches(light, behind)) return {};
  return change(x, n, light.d, hit, through, behind, cones, light.density, bounces, path);
}

Vec3 Compositor::cone_change(Vec3 x, Vec3 n, Vec3 d, const Cones& cones, int bounces,
                             Path& path) const {
  if (dot(d, n) <= 0) return {};
  Vec3 through(1.0f);
  Place behind;
  if (objects_->transmits()) behind = meet_stand_in(x, d, kInfinity, path);
  const Hit hit = meet_object(x, d, behind.t, through, path);
  if (!hit && is_one(through)) return {};
  if (!objects_->transmits()) behind = meet_stand_in(x, d, kInfinity, path);
  if (hit && behind.t < hit.t) return {};
  const float light = captured_.density(x, d, behind);
  return change(x, n, d, hit, through, behind, cones, light, bounces, path);
}

// Towards a lamp among the objects; in its light's share alone, what is in front of it is left
// to the other strategies.
Vec3 Compositor::lamp_change(Vec3 x, Vec3 n, const Cones& cones, int bounces,
                             Path& path) const {
  const World::Emitter lamp = objects_->sample_emitter(path.sampler.pair(), path.time);
  const Vec3 to = lamp.p - x, d = unit_or(to, n);
  if (dot(d, n) <= 0) return {};
  Vec3 through(1.0f);
  const Place behind = meet_stand_in(x, d, kInfinity, path);
  const Hit hit = meet_object(x, d, behind.t, through, path);
  if (!hit || std::abs(hit.t - length(to)) > 1e-3f * hit.t) return {};
  const float light = captured_.density(x, d, behind);
  return change(x, n, d, hit, through, behind, cones, light, bounces, path);
}

// An estimate of dE / E_without, by all strategies or by one of them at random. Nothing is
// random where no sample meets an object: it is 0.
Vec3 Compositor::relative_change(const Place& place, int bounces, bool all, Path& path) const {
  const Vec3 x = place.start(), n = place.n;
  const Cones cones(x, n, bounds_);
  Vec3 dE;
  if (!cones.empty()) {
    const bool lamps = objects_->shines();
    const int strategies = lamps ? 3 : 2;
    const int one = all ? -1 : std::min(int(path.sampler.pair().x * strategies), strategies - 1);
    if (all || one == 0) dE += light_change(x, n, cones, bounces, path);
    if (all || one == 1) {
      dE += cone_change(x, n, cones.sample(path.sampler.pair()), cones, bounces, path);
    }
    if (lamps && (all || one == 2)) dE += lamp_change(x, n, cones, bounces, path);
    if (!all) dE *= float(strategies);
    if (path.photons) dE += path.photons->irradiance(x, n, path.map);
  }
  dE += delta_change(x, n, path);
  if (is_zero(dE)) return {};
  const Vec3 E = irradiance_.at(place);
  return {E.x > 0 ? dE.x / E.x : 0, E.y > 0 ? dE.y / E.y : 0, E.z > 0 ? dE.z / E.z : 0};
}

void Compositor::set_gloss(float reflectance, float roughness) {
  const float r = std::sqrt(reflectance);
  Material m{};
  m.roughness = roughness, m.specular = 1, m.ior = (1 + r) / (1 - r), m.alpha = 1;
  m.base_texture = m.metallic_roughness_texture = m.normal_texture = m.emission_texture = -1;
  settle(m);
  gloss_ = m;
}

Compositor::Along Compositor::along(const Place& place, Vec3 d, int bounces, Path& path) const {
  const Vec3 x = place.start();
  if (dot(d, place.n) <= 0 || !bounds_.may_hit(x, d)) return {};
  Vec3 share(1.0f);
  const auto [hit, before] = meet(x, d, share, path);
  if (!hit && is_one(share)) return {};
  const Place behind = hit ? meet_stand_in(x, d, kInfinity, path) : before;
  Along along;
  along.behind = behind, along.t = hit.t;
  along.lights = captured_.density(x, d, behind);
  Vec3 with = share * captured_.radiance(behind, d);
  if (hit) {
    if (objects_->shines()) along.lamps = lamp_density(objects_->surface_at(hit, d), hit, x, d);
    const Trail trail{bounces - 1, false, 1, gloss_->roughness < 0.25f};
    with = share * object_radiance(hit, d, trail, path);
  }
  along.difference = with - captured_.radiance(behind, d);
  return along;
}

Vec3 Compositor::gloss_change(const Place& place, Vec3 d, int bounces, Path& path) const {
  Surface s{};
  s.p = place.p, s.ng = s.ns = place.n, s.rise = place.rise, s.outside = true;
  s.model = gloss_->model, s.roughness = gloss_->roughness, s.alpha = 1, s.material = &*gloss_;
  Vec3 dL;
  if (const Scatter next = sample(s, -d, path.sampler); largest(next.weight) > 0) {
    const Along met = along(place, next.wi, bounces, path);
    const float all = next.density + met.lights + met.lamps;
    dL += (next.density > 0 ? next.density / all : 1) * next.weight * met.difference;
  }
  if (is_specular(s)) return dL;
  const auto add = [&](Vec3 wi, auto is_own) {
    const Vec3 f = shade(s, -d, wi);
    if (is_zero(f)) return;
    const Along met = along(place, wi, bounces, path);
    if (is_zero(met.difference) || !is_own(met)) return;
    dL += (1 / (density(s, -d, wi) + met.lights + met.lamps)) * f * met.difference;
  };
  if (const auto light = captured_.sample(place.start(), path.sampler.pair())) {
    add(light.d, [&](const Along& met) { return Captured::reaches(light, met.behind); });
  }
  if (objects_->shines()) {
    const auto lamp = objects_->sample_emitter(path.sampler.pair(), path.time);
    const Vec3 to = lamp.p - place.start();
    add(unit_or(to, place.n), [&](const Along& met) {
      return met.lamps > 0 && std::abs(met.t - length(to)) < 1e-3f * met.t;
    });
  }
  for (const DeltaLight& light : objects_->delta_lights()) {
    const auto in = light.incident(s.p);
    Vec3 f = is_zero(in.irradiance) ? Vec3() : shade(s, -d, in.d) * in.irradiance;
    if (is_zero(f)) continue;
    const Vec3 x = place.start();
    ++path.rays;
    f *= objects_->transmittance(x, in.d, in.t, path.time);
    if (!is_zero(f) && !in_shadow_of_set(x, light, in, path)) dL += f;
  }
  return dL;
}

uint64_t Compositor::pass(const Camera& camera, const float* plate, bool difference,
                          bool reflects_plate, const uint16_t* counts,
                          const Caustics& caustics, float* film) {
  if (caustics.count && !captured_.peaks_found()) captured_.find_peaks();
  const PixelRays& rays = camera.rays;
  std::atomic<uint64_t> traced{0};
  const Photons photons = this->photons(caustics, traced);
  std::optional<Plate> seen;
  if (reflects_plate) seen.emplace(rays, camera.origin, plate);
  const tbb::blocked_range2d<int> tiles(0, rays.height, 8, 0, rays.width, 8);
  tbb::parallel_for(tiles, [&](const auto& tile) {
    const FlushDenormals flush;
    uint64_t tile_rays = 0;
    for (int y = tile.rows().begin(); y < tile.rows().end(); ++y) {
      for (int x = tile.cols().begin(); x < tile.cols().end(); ++x) {
        if (!camera.sees(y, x)) continue;
        const size_t pixel = size_t(y) * rays.width + x;
        float* to = film + Film::kCount * pixel;
        const Vec3 B(plate + 3 * pixel);
        const uint32_t first = uint32_t(to[Film::kSamples]);
        to[Film::kSamples] += counts[pixel];
        for (uint32_t i = first; i < first + counts[pixel]; ++i) {
          Sampler sampler(table_, seed_ + pixel, i);
          Path path{sampler};
          if (!photons.empty()) path.photons = &photons, path.map = (i - first) % photons.maps();
          if (seen) path.plate = &*seen;
          const auto [o, d, time] = camera.sample(y, x, sampler);
          path.time = time;
          const Place place = meet_stand_in(o, d, kInfinity, path);
          Vec3 through(1.0f);
          const Hit hit = meet_object(o, d, place.t, through, path);
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
            if (gloss_) {  // no part of it lies on what is kept of the plate
              const Vec3 shine = through * gloss_change(place, d, bounces_, path);
              add(to + Film::kObject, shine);
              value += shine;
            }
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

void Compositor::background(const Camera& camera, uint32_t count, float* radiance) const {
  const PixelRays& rays = camera.rays;
  const tbb::blocked_range2d<int> tiles(0, rays.height, 16, 0, rays.width, 16);
  tbb::parallel_for(tiles, [&](const auto& tile) {
    const FlushDenormals flush;
    for (int y = tile.rows().begin(); y < tile.rows().end(); ++y) {
      for (int x = tile.cols().begin(); x < tile.cols().end(); ++x) {
        if (!camera.sees(y, x)) continue;
        const size_t pixel = size_t(y) * rays.width + x;
        Vec3 sum;
        for (uint32_t i = 0; i < count; ++i) {
          Sampler sampler(table_, ~seed_ + pixel, i);
          const CameraRay ray = camera.sample(y, x, sampler);
          sum += captured_.radiance(captured_.trace(ray.o, ray.d), ray.d);
        }
        add(radiance + 3 * pixel, sum * (1.0f / float(count)));
      }
    }
  });
}

}  // namespace chromeball
