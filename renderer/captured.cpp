#include "captured.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

namespace chromeball {
namespace {

// The k-th of `count` numbers that are stratified along the map's curve, and one for the way
// across it: both together fill each texel evenly, by a lattice of the golden ratio.
Pair along_curve(uint32_t k, uint32_t count, uint64_t seed) {
  const uint32_t stratum = uint32_t((uint64_t(1) << 32) / count);
  const uint64_t start = mix64(seed), jitter = mix64(start + k);
  const uint32_t bits = k * stratum + uint32_t(jitter) % stratum;
  const uint32_t across = k * 2654435769u + uint32_t(start >> 32);
  return {float(bits >> 8) * 0x1p-24f, float(across >> 8) * 0x1p-24f, bits};
}

}  // namespace

Captured::Captured(const StandIn& stand_in, const Environment& environment, Vec3 origin,
                   uint64_t seed)
    : stand_in_(stand_in), environment_(environment), origin_(origin) {
  if (stand_in.size()) find_planes();
  accel_.commit();
  if (environment.even()) return;
  lights_.resize(kLights);
  for (uint32_t k = 0; k < kLights; ++k) lights_[k] = draw(k, seed);
}

void Captured::find_planes() {
  const StandIn& stand_in = stand_in_;
  const Vec3 corner = stand_in.corner(0, 0);
  const Vec3 across = normalize(cross(stand_in.corner(0, 1) - corner,
                                      stand_in.corner(0, 2) - corner));
  for (uint32_t f = 0; f < stand_in.size(); ++f) {
    for (int k = 0; k < 3; ++k) {
      const Vec3 to = stand_in.corner(f, k) - corner;
      flat_ &= std::abs(dot(to, across)) <= 1e-4f * length(to);
    }
  }
  const Vec3 n = stand_in.normal(0);
  below_ = dot(corner - origin_, n) < 0 ? -n : n;
  const size_t v = stand_in.vertices.size() / 3;
  accel_.add(stand_in.vertices.data(), v, stand_in.faces.data(), stand_in.size());
  Accel original;  // the set as it was when the map was captured
  original.add(stand_in.original.data(), v, stand_in.faces.data(), stand_in.size());
  original.commit();
  const uint32_t texels = uint32_t(environment_.height()) * environment_.width();
  planes_.resize(texels);
  tbb::parallel_for(tbb::blocked_range<uint32_t>(0, texels, 4096), [&](const auto& range) {
    const FlushDenormals flush;
    for (uint32_t t = range.begin(); t < range.end(); ++t) {
      const Hit hit = original.intersect(origin_, environment_.texel_direction(t));
      if (!hit) continue;
      bool moved = false;
      for (int k = 0; k < 3; ++k) {
        moved |= !is_zero(stand_in.corner(hit.face, k) - stand_in.original_corner(hit.face, k));
      }
      if (!moved) {
        const Vec3 n = stand_in.normal(hit.face);
        planes_[t] = {n, dot(n, stand_in.corner(hit.face, 0)), Plane::kStays};
        continue;
      }
      const Vec3 a = stand_in.original_corner(hit.face, 0);
      const Vec3 n = unit_or(cross(stand_in.original_corner(hit.face, 1) - a,
                                   stand_in.original_corner(hit.face, 2) - a), {0, 1, 0});
      planes_[t] = {n, dot(n, a), hit.face};
    }
  });
}

Place Captured::trace(Vec3 o, Vec3 d, float tfar) const {
  if (accel_.empty()) return {};
  const Hit hit = accel_.intersect(o, d, tfar);
  return hit ? at(hit, d) : Place();
}

Place Captured::at(const Hit& hit, Vec3 d) const {
  const float w = 1 - hit.u - hit.v;
  const auto mixed = [&](auto corner) {
    return w * corner(0) + hit.u * corner(1) + hit.v * corner(2);
  };
  Place place;
  place.t = hit.t;
  place.face = hit.face;
  place.p = mixed([&](int k) { return stand_in_.corner(hit.face, k); });
  place.captured_at = mixed([&](int k) { return stand_in_.original_corner(hit.face, k); });
  const Vec3 n = stand_in_.normal(hit.face);
  place.n = dot(n, d) < 0 ? n : -n;
  place.rise = rise(mixed([&](int k) { return abs(stand_in_.corner(hit.face, k)); }) +
                        abs(place.p), n);
  place.support = stand_in_.surface[hit.face] == 0;
  return place;
}

void Captured::set_others(std::vector<OtherProbe> others) {
  others_ = std::move(others);
  if (others_.empty()) return;
  if (stand_in_.size()) {
    original_.add(stand_in_.original.data(), stand_in_.original.size() / 3,
                  stand_in_.faces.data(), stand_in_.size());
  }
  original_.commit();
}

bool Captured::sees(Vec3 origin, const Place& place) const {
  return !original_.occluded(origin, place.captured_at - origin, 1 - 1e-3f);
}

Vec3 Captured::radiance(const Place& place, Vec3 d) const {
  if (!others_.empty()) {
    const bool hidden = place ? !sees(origin_, place)
                              : original_.occluded(origin_, d, kInfinity);
    if (hidden) {
      const OtherProbe* best = nullptr;
      float finest = 0;
      for (const OtherProbe& other : others_) {
        if (!place) {
          if (original_.occluded(other.origin, d, kInfinity)) continue;
          best = &other;
          break;
        }
        const Vec3 w = place.captured_at - other.origin;
        // the side that d comes from; of a face that has moved since, either
        const float cos = is_zero(place.p - place.captured_at)
                              ? -dot(w, place.n) : std::abs(dot(w, place.n));
        const float fine = cos / (length2(w) * length(w));  // solid angle of the surface
        if (fine > finest && sees(other.origin, place)) best = &other, finest = fine;
      }
      if (best) {
        return best->environment->radiance(
            place ? normalize(place.captured_at - best->origin) : d);
      }
    }
  }
  if (!place) return environment_.radiance(d);
  const Vec3 w = place.captured_at - origin_;
  return is_zero(w) ? Vec3() : environment_.radiance(normalize(w));  // the probe's own place
}

float Captured::jacobian(Vec3 x, Vec3 q, Vec3 n) const {
  const Vec3 from_o = q - origin_, from_x = q - x;
  const float o2 = length2(from_o), x2 = length2(from_x);
  const float cos_o = std::abs(dot(from_o, n)) / std::sqrt(o2);
  const float cos_x = std::abs(dot(from_x, n)) / std::sqrt(x2);
  return cos_x > 1e-6f ? cos_o * x2 / (o2 * cos_x) : 0;
}

std::vector<Lamp> Captured::lamps(uint32_t count, uint64_t seed) const {
  std::vector<Lamp> lamps;
  if (environment_.black()) return lamps;
  lamps.resize(count);
  Accel original;  // the set as it was when the map was captured
  if (positional()) {
    original.add(stand_in_.original.data(), stand_in_.original.size() / 3,
                 stand_in_.faces.data(), stand_in_.size());
  }
  original.commit();
  for (uint32_t k = 0; k < count; ++k) {
    const Pair u = along_curve(k, count, seed);
    const auto s = environment_.sample_power(u.bits, u.y);
    Lamp& lamp = lamps[k];
    lamp.place = s.direction;
    lamp.flux = environment_.radiance(s.direction) * (1 / (s.density * float(count)));
    const Hit hit = positional() ? original.intersect(origin_, s.direction) : Hit();
    if (!hit) continue;
    const auto at = [&](auto corner) {
      return (1 - hit.u - hit.v) * corner(0) + hit.u * corner(1) + hit.v * corner(2);
    };
    const auto area = [&](auto corner) {
      return cross(corner(1) - corner(0), corner(2) - corner(0));
    };
    const auto then = [&](int i) { return stand_in_.original_corner(hit.face, i); };
    const auto now = [&](int i) { return stand_in_.corner(hit.face, i); };
    const Vec3 before = area(then), after = area(now);
    lamp.finite = true;
    lamp.place = at(now);
    lamp.n = stand_in_.normal(hit.face);
    lamp.distance = hit.t;
    // an element of the face has grown with the face since
    lamp.cos_o = std::abs(dot(before, s.direction)) / length(after);
  }
  return lamps;
}

Captured::Light Captured::draw(uint32_t k, uint64_t seed) const {
  const Pair u = along_curve(k, kLights, seed);
  const Environment::Sample s = environment_.sample(u.bits, u.y);
  return laid(s.direction, s.texel, s.density);
}

// The light in direction w of the map, on the plane that its texel showed.
Captured::Light Captured::laid(Vec3 w, uint32_t texel, float density) const {
  if (planes_.empty()) return {w, false, {}, density};
  const Plane& plane = planes_[texel];
  if (is_zero(plane.n)) return {w, false, {}, density};
  // q = o + z w, the light's place
  const float cos = dot(plane.n, w);
  const float z = (plane.offset - dot(plane.n, origin_)) / cos;
  if (!(z > 0 && z < kInfinity)) return {};
  const Vec3 q = origin_ + z * w;
  density *= std::abs(cos) / (z * z);
  if (plane.moved != Plane::kStays) return carried(plane.moved, q, density);
  return {q, true, plane.n, density};
}

float Captured::growth(uint32_t face) const {
  const auto area = [&](auto corner) {
    return length(cross(corner(1) - corner(0), corner(2) - corner(0)));
  };
  const float before = area([&](int k) { return stand_in_.original_corner(face, k); });
  return area([&](int k) { return stand_in_.corner(face, k); }) / before;
}

// The light that q, a point of the face as it was captured, has been brought with it.
Captured::Light Captured::carried(uint32_t face, Vec3 q, float density) const {
  const Vec3 a = stand_in_.original_corner(face, 0), b = stand_in_.original_corner(face, 1) - a,
             c = stand_in_.original_corner(face, 2) - a, n = cross(b, c);
  const float u = dot(cross(q - a, c), n) / length2(n), v = dot(cross(b, q - a), n) / length2(n);
  const float grown = growth(face);
  // a neighbour's, which may have gone elsewhere: left to the other strategies
  if (!(u >= 0 && v >= 0 && u + v <= 1 && grown > 0 && grown < kInfinity)) return {};
  const Vec3 place = (1 - u - v) * stand_in_.corner(face, 0) + u * stand_in_.corner(face, 1) +
                     v * stand_in_.corner(face, 2);
  return {place, true, stand_in_.normal(face), density / grown};
}

Captured::Sample Captured::sample(Vec3 x, Pair u) const {
  if (lights_.empty()) return {};
  const Light& light = lights_[(uint64_t(u.bits) * kLights) >> 32];
  if (!light.finite) return {light.place, kInfinity, light.density};
  const Vec3 to = light.place - x;
  const float x2 = length2(to), t = std::sqrt(x2);
  const float cos_x = std::abs(dot(to, light.n)) / t;
  if (!(t > 0 && cos_x > 1e-6f)) return {};
  return {to * (1 / t), t, light.density * x2 / cos_x};
}

// Where the map holds what d meets at `place`, if `laid` brings it there: not for places that the
// map did not see.
Captured::Origin Captured::origin_of(Vec3 d, const Place& place) const {
  if (!place) {
    const bool infinite = planes_.empty() || is_zero(planes_[environment_.texel_of(d)].n);
    return infinite ? Origin{d, 0, nullptr} : Origin{};
  }
  const Vec3 from_o = place.captured_at - origin_;
  const float distance = length(from_o);
  if (!(distance > 0)) return {};
  const Vec3 w = from_o * (1 / distance);
  const Plane& plane = planes_[environment_.texel_of(w)];
  const float slack = 1e-4f * distance + kLift * largest_magnitude(place.captured_at);
  const float off = dot(plane.n, place.captured_at) - plane.offset;
  if (is_zero(plane.n) || !(std::abs(off) < slack)) return {};
  const bool there = plane.moved == Plane::kStays
                         ? length(place.p - place.captured_at) < slack
                         : plane.moved == place.face;
  return there ? Origin{w, distance, &plane} : Origin{};
}

Vec3 Captured::peak(Vec3 d, const Place& place) const {
  const Origin from = origin_of(d, place);
  return from ? peaks_->radiance(from.w) : Vec3();
}

Captured::Peak Captured::sample_peak(Pair u) const {
  const Peaks::Sample s = peaks_->sample(u);
  const Light light = laid(s.direction, s.texel, s.density);
  return {light.place, light.finite, light.n, s.radiance, light.density};
}

float Captured::density(Vec3 x, Vec3 d, const Place& place) const {
  if (environment_.even()) return 0;
  const Origin from = origin_of(d, place);
  if (!from) return 0;
  if (!from.plane) return environment_.density(from.w);
  const auto& [w, distance, plane] = from;
  if (plane->moved == Plane::kStays) {
    return environment_.density(w) * jacobian(x, place.p, plane->n);
  }
  const Vec3 to = place.p - x;
  const float x2 = length2(to), cos_x = std::abs(dot(to, place.n)) / std::sqrt(x2);
  if (!(cos_x > 1e-6f)) return 0;
  const float cos_o = std::abs(dot(w, plane->n));
  return environment_.density(w) * cos_o * x2 / (distance * distance * cos_x * growth(place.face));
}

}  // namespace chromeball
