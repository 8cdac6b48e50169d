// Caustics: light traced from where it shines to objects that send it on in certain directions,
// and from there to the set. Only what stands out goes this way, the rest is found from the set.
#include <tbb/parallel_for.h>

#include "composite.h"

namespace chromeball {
namespace {

constexpr int kMostScatterings = 64;
constexpr uint32_t kPiece = 1024;  // photons that one task traces
// How many photons the first map has within its radius, were they spread like the objects.
constexpr float kGathered = 20;
constexpr uint32_t kTried = 32;  // lamps that tell how much light is to be expected

// What a source sends to spheres of this much cross-section, about.
float facing(float area, const Sphere& all, Vec3 q) {
  return area / std::max(length2(q - all.centre), all.radius * all.radius);
}

}  // namespace

// Where light comes from that may become caustics, and how often each kind is chosen.
struct Compositor::Sources {
  Bounds targets;
  float area = 0;  // their cross-sections, overlaps counted twice
  std::vector<float> power;  // of each kind: the map, lamps, then each light without size
  Distribution kinds{std::span<const float>()};
  uint32_t count = 0;

  enum Kind : uint32_t { kMap, kLamps, kDelta };

  explicit Sources(const Compositor& of, uint32_t count)
      : targets(of.objects_->sharp_bounds()), count(count) {
    const World& objects = *of.objects_;
    if (targets.empty()) return;
    for (const Sphere& s : targets.few()) area += kPi * s.radius * s.radius;
    const Sphere& all = targets.nodes()[0].sphere;
    power.resize(kDelta);
    power[kMap] = area * float(of.captured_.peaks().power());
    if (objects.shines()) {
      float sum = 0;
      for (uint32_t k = 0; k < kTried; ++k) {
        const uint64_t h = mix64(k + 1);
        const auto lamp = objects.sample_emitter({0, float(h >> 40) * 0x1p-24f, uint32_t(h)});
        sum += of.captured_.peaks().share(lamp.radiance) * facing(area, all, lamp.p);
      }
      power[kLamps] = float(objects.power()) * sum / kTried;
    }
    for (const DeltaLight& light : objects.delta_lights()) {
      power.push_back(mean(light.intensity) *
                      (light.sun ? area : facing(area, all, light.position)));
    }
    kinds = Distribution(power);
  }

  // A direction from q to the targets and its density, 1/sr, on one side of the plane across n.
  struct Aim {
    Vec3 d, n;
    float density = 0;  // 0: none
  };
  Aim aim(Vec3 q, Vec3 n, Sampler& sampler) const {
    const Sphere& all = targets.nodes()[0].sphere;
    const float height = dot(all.centre - q, n);
    float chance = 1;
    if (std::abs(height) <= all.radius * 1.001f) {
      chance = 0.5f;
      if (sampler.pair().x < 0.5f) n = -n;
    } else if (height < 0) {
      n = -n;
    }
    const Cones cones(q, n, targets);
    if (cones.empty()) return {};
    const Vec3 d = cones.sample(sampler.pair());
    return {d, n, dot(d, n) > 0 ? chance * cones.density(d) : 0};
  }

  // A line in direction d through one of the targets; how much cross-section it stands for.
  float line(Vec3 d, Sampler& sampler, Vec3& through) const {
    const auto spheres = targets.few();
    const Pair u = sampler.pair(), v = sampler.pair();
    float left = u.x * area;
    size_t k = 0;
    const auto section = [](const Sphere& s) { return kPi * s.radius * s.radius; };
    while (k + 1 < spheres.size() && left >= section(spheres[k])) left -= section(spheres[k++]);
    const Frame frame(d);
    const float r = spheres[k].radius * std::sqrt(v.x), phi = 2 * kPi * v.y;
    through = spheres[k].centre + r * (std::cos(phi) * frame.s + std::sin(phi) * frame.t);
    int crossed = 1;
    for (size_t i = 0; i < spheres.size(); ++i) {
      if (i == k) continue;
      crossed += length2(cross(spheres[i].centre - through, d)) <=
                 spheres[i].radius * spheres[i].radius;
    }
    return area / float(crossed);
  }
};

// Light on its way, and what has to be asked where it arrives.
struct Compositor::Beam {
  Vec3 o, d;
  Vec3 flux;
  Sources::Kind kind = Sources::kMap;
  const DeltaLight* light = nullptr;
  bool finite = false;
  Vec3 from;  // its place, metres
};

Compositor::Beam Compositor::beam(const Sources& sources, Path& path) const {
  Sampler& sampler = path.sampler;
  const uint32_t kind = sources.kinds.sample(sampler.pair().bits).index;
  Beam beam;
  beam.kind = Sources::Kind(std::min<uint32_t>(kind, Sources::kDelta));
  beam.finite = true;
  const auto parallel = [&](Vec3 d, Vec3 irradiance) {
    Vec3 through;
    beam.finite = false;
    beam.d = d;
    beam.flux = sources.line(d, sampler, through) * irradiance;
    const Sphere& all = bounds_.nodes()[0].sphere;  // from before the first of all objects
    const Vec3 to = through - all.centre;
    beam.o = through - (dot(to, d) + 1.01f * all.radius) * d;
  };
  const auto diverging = [&](Vec3 q, Vec3 n, Vec3 radiance, float density, float rise) {
    const auto aim = sources.aim(q, n, sampler);
    if (!(aim.density > 0 && density > 0)) return;
    beam.from = q, beam.o = q + rise * aim.n, beam.d = aim.d;
    beam.flux = (dot(aim.d, aim.n) / (aim.density * density)) * radiance;
  };
  switch (beam.kind) {
    case Sources::kMap: {
      const auto peak = captured_.sample_peak(sampler.pair());
      if (!(peak.density > 0)) break;
      if (peak.finite) {
        diverging(peak.place, peak.n, peak.radiance, peak.density,
                  8 * kLift * largest_magnitude(peak.place));
      } else {
        parallel(-peak.place, (1 / peak.density) * peak.radiance);
      }
      break;
    }
    case Sources::kLamps: {
      const auto lamp = objects_->sample_emitter(sampler.pair(), path.time);
      const Vec3 L = captured_.peaks().share(lamp.radiance) * lamp.radiance;
      diverging(lamp.p, lamp.n, L, lamp.density, lamp.rise);
      break;
    }
    case Sources::kDelta: {
      beam.light = &objects_->delta_lights()[kind - Sources::kDelta];
      if (beam.light->sun) {
        parallel(beam.light->direction, beam.light->intensity);
        break;
      }
      beam.from = beam.o = beam.light->position;
      const Vec3 to = sources.targets.nodes()[0].sphere.centre - beam.o;
      const auto aim = sources.aim(beam.o, unit_or(to, {0, 1, 0}), sampler);
      if (!(aim.density > 0)) break;
      beam.d = aim.d;  // intensity is irradiance a metre away
      beam.flux = (1 / aim.density) * beam.light->incident(beam.o + aim.d).irradiance;
      break;
    }
  }
  const double chance = sources.power[kind] / sources.kinds.sum();
  beam.flux *= float(1 / (chance * double(sources.count)));
  return beam;
}

// Whether the light comes to the surface that it met first among the objects.
bool Compositor::reaches(const Beam& beam, const Surface& s, Path& path) const {
  if (!captured_.positional()) return true;
  const Vec3 x = s.start(-beam.d);
  if (beam.kind == Sources::kMap) {
    const Place place = meet_stand_in(x, -beam.d, kInfinity, path);
    const float distance = beam.finite ? length(beam.from - x) : kInfinity;
    return Captured::reaches({-beam.d, distance, 1}, place);
  }
  if (beam.light) return !in_shadow_of_set(x, *beam.light, beam.light->incident(x), path);
  ++path.rays;
  return !captured_.blocked(x, beam.o - x, 1 - kLift);
}

Photon Compositor::photon(const Sources& sources, Path& path) const {
  Beam beam = this->beam(sources, path);
  Vec3 o = beam.o, d = beam.d, flux = beam.flux;
  if (!(largest(flux) > 0)) return {};
  for (int k = 0; k < kMostScatterings; ++k) {
    const auto [hit, place] =
        k > 0 ? meet(o, d, flux, path)
              : Meeting{meet_object(o, d, kInfinity, flux, path), Place()};
    if (place) return place.support ? Photon{place.p, place.n, flux} : Photon{};
    if (!hit) return {};
    const Surface s = objects_->surface_at(hit, d);
    if (k == 0 && !reaches(beam, s, path)) return {};
    const Scatter next = sample(s, -d, path.sampler);
    if (next.density > 0 || !(largest(next.weight) > 0)) return {};  // found from the set
    // light and sight differ where the shading normal leaves the face's (Veach 1997, 5.3)
    const float seen = std::abs(dot(next.wi, s.ns) * dot(d, s.ng));
    const float lit = std::abs(dot(d, s.ns) * dot(next.wi, s.ng));
    if (!(seen > 0)) return {};
    const Vec3 weight = (lit / seen) * next.weight;
    const float survive = std::min(1.0f, largest(weight));
    if (survive < 1 && path.sampler.pair().x >= survive) return {};
    flux *= weight * (1 / survive);
    d = next.wi;
    o = s.start(d);
  }
  return {};
}

Photons Compositor::photons(const Caustics& caustics, std::atomic<uint64_t>& traced) const {
  if (caustics.maps == 0 || caustics.count == 0) return {};
  const Sources sources(*this, caustics.count);
  if (sources.kinds.empty()) return {};
  const float widest = std::sqrt(kGathered * sources.area / (kPi * float(caustics.count)));
  std::vector<std::vector<Photon>> maps(caustics.maps);
  std::vector<float> radius(caustics.maps);
  for (uint32_t k = 0; k < caustics.maps; ++k) {
    const uint32_t number = caustics.first + k;
    radius[k] = widest * std::pow(1 + float(number), -1 / 6.0f);
    std::vector<std::vector<Photon>> pieces((caustics.count + kPiece - 1) / kPiece);
    tbb::parallel_for(size_t(0), pieces.size(), [&](size_t piece) {
      const FlushDenormals flush;
      uint64_t rays = 0;
      const uint32_t end = std::min(caustics.count, uint32_t(piece + 1) * kPiece);
      for (uint32_t i = uint32_t(piece) * kPiece; i < end; ++i) {
        Sampler sampler(photon_table_, mix64(seed_ + 0x50686f74u + number), i);
        Path path{sampler};
        path.time = objects_->moves() ? sampler.pair().x : 0;
        const Photon found = photon(sources, path);
        if (largest(found.flux) > 0) pieces[piece].push_back(found);
        rays += path.rays;
      }
      traced += rays;
    });
    for (const auto& piece : pieces) maps[k].insert(maps[k].end(), piece.begin(), piece.end());
  }
  return Photons(std::move(maps), std::move(radius));
}

}  // namespace chromeball
