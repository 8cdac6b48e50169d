// Rays of the direct integrator that wait until sixteen are there.
#pragma once

#include "direct.h"

namespace chromeball {

constexpr uint32_t kNowhere = ~0u;

// The i-th of a sequence that fills the square evenly (Roberts 2018).
inline Pair spread(uint32_t i) {
  const uint32_t a = i * 3242174889u, b = i * 2447445414u;
  return {float(a >> 8) * 0x1p-24f, float(b >> 8) * 0x1p-24f, a};
}

inline float fraction(float x) { return x - std::floor(x); }

// How far a ray's start is moved from a surface that was met at x from o.
inline float clearance(Vec3 x, Vec3 o) {
  return 8 * kLift * (largest_magnitude(x) + largest_magnitude(x - o));
}

// By channel; 0 where there is nothing to divide by.
inline Vec3 over(Vec3 a, Vec3 b) {
  return {b.x > 0 ? a.x / b.x : 0, b.y > 0 ? a.y / b.y : 0, b.z > 0 ? a.z / b.z : 0};
}

// Shadow rays wait here until sixteen are there.
struct Direct::ShadowRays {
  const Direct& direct;
  Packet packet;
  int count = 0;
  uint64_t traced = 0;
  struct Target {
    Vec3* sum;
    float* square;  // of the brightness
    Vec3 light;
    bool takes;  // light is taken away where an object is in between, else given where none is
    bool set_may_hide;  // the set itself may keep the light away
  } target[Packet::kWidth];

  explicit ShadowRays(const Direct& direct) : direct(direct) {}

  void push(Vec3 o, Vec3 d, float t, const Target& to) {
    packet.set(count, o, d, t);
    target[count] = to;
    if (++count == Packet::kWidth) flush();
  }

  void flush() {
    if (count == 0) return;
    traced += uint64_t(count);
    float far[Packet::kWidth];
    std::copy_n(packet.rays.ray.tfar, Packet::kWidth, far);
    occluded(direct.scene_.objects_->scene(), packet, false);
    const World& objects = *direct.scene_.objects_;
    bool hidden[Packet::kWidth], by_set[Packet::kWidth] = {};
    for (int k = 0; k < count; ++k) hidden[k] = packet.blocked(k);
    // light that the set itself keeps away is neither given nor taken
    int left = 0;
    for (int k = 0; k < count; ++k) {
      const bool matters = hidden[k] == target[k].takes || objects.transmits();
      packet.valid[k] = matters && target[k].set_may_hide ? -1 : 0;
      packet.rays.ray.tfar[k] = far[k];
      left += packet.valid[k] != 0;
    }
    if (left) {
      traced += uint64_t(left);
      occluded(direct.captured_.accel().scene(), packet, false);
      for (int k = 0; k < count; ++k) by_set[k] = packet.valid[k] && packet.blocked(k);
    }
    for (int k = 0; k < count; ++k) {
      const Target& to = target[k];
      if (by_set[k]) continue;
      Vec3 share(hidden[k] ? 0.0f : 1.0f);  // of the light that comes through
      if (hidden[k] && objects.transmits()) {
        share = objects.transmittance(packet.origin(k), packet.direction(k), far[k]);
      }
      const Vec3 light = to.takes ? to.light * (share - Vec3(1.0f)) : to.light * share;
      *to.sum += light;
      *to.square += mean(light) * mean(light);
    }
    packet.clear();
    count = 0;
  }
};

// Rays that look for light by themselves: for what is near in the set, and for what objects and
// set send each other; there each asks one lamp, and `near` for what is near.
struct Direct::GatherRays {
  const Direct& direct;
  ShadowRays& shadows;
  GatherRays* near;  // none: these rays see nothing but what is near in the set
  Packet packet{};
  int count = 0;
  uint64_t traced = 0;
  struct Asker {
    Vec3* sum;
    float* square;  // of the brightness
    Vec3 weight;     // of the radiance that is found
    float u;         // picks the lamp
    Pair v;          // picks a direction
    bool from_object;
    bool takes;  // light that the object hides and that no lamp stands for
  } asker[Packet::kWidth];

  GatherRays(const Direct& direct, ShadowRays& shadows, GatherRays* near)
      : direct(direct), shadows(shadows), near(near) {}

  void push(Vec3 o, Vec3 d, const Asker& who) {
    packet.set(count, o, d);
    asker[count] = who;
    if (++count == Packet::kWidth) flush();
  }

  void flush() {
    if (count == 0) return;
    const World& objects = *direct.scene_.objects_;
    const bool positional = direct.captured_.positional();
    traced += uint64_t(count);
    intersect(objects.scene(), packet, false);
    Hit hits[Packet::kWidth];
    int left = 0;
    for (int k = 0; k < count; ++k) {
      if (packet.hits(k)) hits[k] = packet.hit(k);
      packet.forget_hit(k);
      const bool behind = hits[k] && asker[k].takes;  // what it hides is asked for
      if (behind) packet.rays.ray.tfar[k] = kInfinity;
      packet.valid[k] = positional && (behind || direct.set_matters(packet, k)) ? -1 : 0;
      left += packet.valid[k] != 0;
    }
    if (left) {
      traced += uint64_t(left);
      intersect(direct.captured_.accel().scene(), packet, false);
    }
    for (int k = 0; k < count; ++k) {
      const bool on_set = packet.valid[k] && packet.hits(k);
      const Vec3 d = packet.direction(k);
      const Place place = on_set ? direct.captured_.at(packet.hit(k), d) : Place();
      if (hits[k] && hits[k].t < place.t) {
        if (near) meet_object(asker[k], hits[k], d);
        if (asker[k].takes) take(asker[k], place, packet.origin(k), d);
      } else if (asker[k].from_object) {
        meet_set(asker[k], place, d);
      }
    }
    packet.clear();
    count = 0;
  }

  // What an object sends back: its own light, and that of one lamp.
  void meet_object(const Asker& a, const Hit& hit, Vec3 d) {
    const World& objects = *direct.scene_.objects_;
    const Surface s = objects.surface_at(hit, d);
    give(a, a.weight * s.emission);
    if (!direct.bounces_ || s.model != Model::diffuse) return;
    const Vec3 start = s.p + s.rise * s.ng;
    if (!objects.delta_lights().empty()) {
      Sampler sampler(direct.scene_.table_, direct.seed_, uint32_t(a.u * 0x1p24f));
      Compositor::Path path{sampler};
      give(a, a.weight * direct.scene_.delta_light(s, -d, path));
      traced += path.rays;
    }
    if (direct.captured_.positional()) {
      const Vec3 look = Frame(s.ns).world(sample_cosine(a.v.x, a.v.y));
      if (dot(look, s.ng) > 0) {
        near->push(start, look,
                   {a.sum, a.square, a.weight * s.alpha * s.base, 0, {}, true, false});
      }
    }
    const LightLists::List& list =
        direct.list(direct.owner_of(hit.instance), LightLists::bin_of(s.ns));
    if (!list.size()) return;
    const auto& c = list.choices[std::min(list.size() - 1, size_t(a.u * float(list.size())))];
    const Lamp::Incident in = direct.lights_.lamp(c.lamp).incident(start);
    const float cos = dot(in.d, s.ns);
    if (cos <= 0 || in.share == 0 || dot(in.d, s.ng) <= 0) return;
    const Vec3 light =
        (in.share * cos * float(list.size()) / kPi) * a.weight * s.alpha * s.base * c.flux;
    shadows.push(start, in.d, in.t * (1 - 1e-3f), {a.sum, a.square, light, false, true});
  }

  // Light that no lamp stands for: of places that are too near, or that the probe did not see.
  bool is_unlisted(const Place& place, Vec3 d) {
    const Captured& captured = direct.captured_;
    if (!captured.positional()) return false;
    if (place && place.t < Lamp::kNear * captured.distance(place)) return true;
    ++traced;
    return !captured.is_listed(place, d);
  }

  // What an object hides of it from the set.
  void take(const Asker& a, const Place& place, Vec3 o, Vec3 d) {
    if (!is_unlisted(place, d)) return;
    const World& objects = *direct.scene_.objects_;
    const Vec3 through = objects.transmits() ? objects.transmittance(o, d, place.t) : Vec3();
    give(a, a.weight * direct.captured_.radiance(place, d) * (through - Vec3(1.0f)));
  }

  // What it sends itself, and what the objects' shadow takes from it.
  void meet_set(const Asker& a, const Place& place, Vec3 d) {
    const bool unlisted = is_unlisted(place, d);
    const bool shadowed = near && direct.bounces_ && place && place.support;
    if (!unlisted && !shadowed) return;
    const Vec3 light = a.weight * direct.captured_.radiance(place, d);
    if (unlisted) give(a, light);
    if (!shadowed) return;
    const uint32_t plane = direct.plane_at(place.face, d);
    const LightLists::List& list = direct.list(direct.set_lists(), plane);
    if (!list.size()) return;
    const auto& c = list.choices[std::min(list.size() - 1, size_t(a.u * float(list.size())))];
    const Vec3 start = place.start();
    const Lamp::Incident in = direct.lights_.lamp(c.lamp).incident(start);
    const float cos = dot(in.d, place.n);
    if (cos <= 0 || in.share == 0 || !direct.scene_.bounds_.may_hit(start, in.d)) return;
    const Vec3 taken = over((in.share * cos * float(list.size())) * light * c.flux,
                            direct.scene_.irradiance_.at(place));
    shadows.push(start, in.d, in.t * (1 - 1e-3f), {a.sum, a.square, taken, true, true});
  }

  static void give(const Asker& a, Vec3 light) {
    if (is_zero(light)) return;
    *a.sum += light;
    *a.square += mean(light) * mean(light);
  }
};

}  // namespace chromeball
