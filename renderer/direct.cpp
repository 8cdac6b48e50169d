#include "direct.h"

#include <tbb/blocked_range.h>
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>

#include <mutex>

#include "packet.h"

namespace chromeball {
namespace {

constexpr uint32_t kNowhere = ~0u;
constexpr float kMuch = 0.15f;  // of E that may be hidden: the full number of rays is spent
constexpr int kRaysOfSample = 2;  // shadow rays of a sub-sample on an object

// The i-th of a sequence that fills the square evenly (Roberts 2018).
Pair spread(uint32_t i) {
  const uint32_t a = i * 3242174889u, b = i * 2447445414u;
  return {float(a >> 8) * 0x1p-24f, float(b >> 8) * 0x1p-24f, a};
}

struct Moments {
  float sum = 0, square = 0;
  int n = 0;
  void add(float x) { sum += x, square += x * x, ++n; }
  float of_mean() const {  // variance of the mean; of a single value nothing is known
    if (n == 0) return 0;
    const float m = sum / float(n);
    return n == 1 ? 0.5f * m * m : std::max(square / float(n) - m * m, 0.0f) / float(n - 1);
  }
};

// How far a ray's start is moved from a surface that was met at x from o.
float clearance(Vec3 x, Vec3 o) {
  return 8 * kLift * (largest_magnitude(x) + largest_magnitude(x - o));
}

// By channel; 0 where there is nothing to divide by.
Vec3 over(Vec3 a, Vec3 b) {
  return {b.x > 0 ? a.x / b.x : 0, b.y > 0 ? a.y / b.y : 0, b.z > 0 ? a.z / b.z : 0};
}

float fraction(float x) { return x - std::floor(x); }

// Neighbours in 4 x 4 pixels look at different lamps; the filter joins what they see.
constexpr uint8_t kOrder[16] = {0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5};
float turn(int x, int y) { return (float(kOrder[(y & 3) * 4 + (x & 3)]) + 0.5f) / 16; }

}  // namespace

// Work on one tile, kept by each thread from tile to tile.
struct Direct::Tile {
  struct Sample {  // a sub-sample of a pixel
    uint32_t pixel;
    Vec3 d;
    int i;  // its number within the pixel
    bool on_object = false;
    uint32_t group = kNowhere;
    float t = kInfinity;
    Vec3 share{1, 1, 1};  // of what is seen that comes through panes in front
    Vec3 n{}, albedo{}, other{};
    Vec3 value{};   // irradiance of the object; dE of the set
    Vec3 square{};  // of each ray's, summed
    int rays = 0;
  };
  std::vector<Sample> samples;
  Moments on_set[FilmTile::kPixels], on_object[FilmTile::kPixels];

  struct Receiver {  // a pixel of the set, seen through its middle
    uint32_t pixel;
    Vec3 x;
    uint32_t plane;
  };
  std::vector<Receiver> receivers;
  struct Group {  // receivers of one plane
    uint32_t plane;
    Vec3 centre;
    float radius;
    const LightLists::List* list;
    std::vector<uint32_t> choices;  // those that an object may hide
    float potential;  // about the part of E that they make up
  };
  std::vector<Group> groups;
  size_t count = 0;  // of groups in use: their memory is kept
};

// Shadow rays wait here until sixteen are there.
struct Direct::ShadowRays {
  const Direct& direct;
  Packet packet;
  int count = 0;
  uint64_t traced = 0;
  struct Target {
    Vec3* sum;
    Vec3* square;
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
      *to.square += light * light;
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
    Vec3* square;
    Vec3 weight;     // of the radiance that is found
    float u;         // picks the lamp
    Pair v;          // picks a direction
    bool from_object;
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
    traced += uint64_t(count);
    intersect(objects.scene(), packet, false);
    Hit hits[Packet::kWidth];
    int left = 0;
    for (int k = 0; k < count; ++k) {
      if (packet.hits(k)) hits[k] = packet.hit(k);
      packet.forget_hit(k);
      packet.valid[k] = direct.captured_.positional() && direct.set_matters(packet, k) ? -1 : 0;
      left += packet.valid[k] != 0;
    }
    if (left) {
      traced += uint64_t(left);
      intersect(direct.captured_.accel().scene(), packet, false);
    }
    for (int k = 0; k < count; ++k) {
      const bool on_set = packet.valid[k] && packet.hits(k);
      const Vec3 d = packet.direction(k);
      if (on_set) {
        if (asker[k].from_object) meet_set(asker[k], direct.captured_.at(packet.hit(k), d), d);
      } else if (hits[k] && near) {
        meet_object(asker[k], hits[k], d);
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
        near->push(start, look, {a.sum, a.square, a.weight * s.alpha * s.base, 0, {}, true});
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

  // What is near in the set, and what the objects' shadow takes from it.
  void meet_set(const Asker& a, const Place& place, Vec3 d) {
    const bool is_near = place.t < Lamp::kNear * direct.captured_.distance(place);
    const bool shadowed = near && direct.bounces_ && place.support;
    if (!is_near && !shadowed) return;
    const Vec3 light = a.weight * direct.captured_.radiance(place, d);
    if (is_near) give(a, light);
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
    *a.square += light * light;
  }
};

Direct::Direct(const Compositor& scene, uint64_t seed)
    : scene_(scene),
      captured_(scene.captured_),
      lights_(scene.captured_, seed),
      bounces_(scene.bounces_ > 0),
      seed_(seed) {
  // large planes of the set get a list that is drawn for their very normal
  const StandIn& set = captured_.stand_in();
  plane_of_.resize(set.size());
  for (uint32_t f = 0; f < set.size(); ++f) {
    const Vec3 a = set.corner(f, 0);
    const Vec3 n = normalize(cross(set.corner(f, 1) - a, set.corner(f, 2) - a));
    plane_of_[f] = 2 * uint32_t(plane_normal_.size());
    for (size_t k = 0; k < plane_normal_.size(); ++k) {
      if (dot(plane_normal_[k], n) > 1 - 1e-6f) plane_of_[f] = 2 * uint32_t(k);
    }
    if (plane_of_[f] == 2 * plane_normal_.size()) plane_normal_.push_back(n);
  }
  objects_moved();
}

void Direct::objects_moved() {
  owners_.clear();
  const World& objects = *scene_.objects_;
  Sphere all{{}, 0};
  for (uint32_t k = 0; k < objects.instances(); ++k) {
    owners_.push_back(objects.bound(k));
    all.centre += owners_.back().centre * (1 / float(objects.instances()));
  }
  for (const Sphere& s : owners_) {
    all.radius = std::max(all.radius, length(s.centre - all.centre) + s.radius);
  }
  if (owners_.size() > kMostOwners) owners_.assign(1, all);
  owners_.push_back(all);
  forget_lists();
}

void Direct::forget_lists() {
  lists_ = std::make_unique<LazyList[]>((owners_.size() - 1) * LightLists::kBins +
                                        2 * plane_normal_.size());
}

// A list is a sample of the light: in the long run its grain has to go as well.
void Direct::draw_lamps(int epoch) {
  if (epoch == epoch_) return;
  epoch_ = epoch;
  lights_ = LightLists(captured_, seed_ + uint64_t(epoch));
  forget_lists();
}

// The side of the plane that the ray sees.
uint32_t Direct::plane_at(uint32_t face, Vec3 d) const {
  const uint32_t plane = plane_of_[face];
  return plane + (dot(plane_normal_[plane / 2], d) > 0);
}

Vec3 Direct::normal_of(uint32_t plane) const {
  return plane & 1 ? -plane_normal_[plane / 2] : plane_normal_[plane / 2];
}

// Whether the set may lie before what the lane's ray has met: a single plane that it does not
// cross before cannot.
bool Direct::set_matters(const Packet& packet, int lane) const {
  if (!captured_.flat()) return true;
  const Vec3 n = plane_normal_[0];
  const float t = dot(captured_.stand_in().corner(0, 0) - packet.origin(lane), n) /
                  dot(packet.direction(lane), n);
  return t > 0 && t < packet.rays.ray.tfar[lane];
}

uint32_t Direct::owner_of(uint32_t instance) const {
  return instance + 1 < owners_.size() ? instance : 0;
}

const LightLists::List& Direct::list(uint32_t owner, uint32_t bin) const {
  LazyList& lazy = lists_[size_t(owner) * LightLists::kBins + bin];
  std::call_once(lazy.once, [&] {
    const bool set = owner + 1 == owners_.size();
    const Vec3 n = set ? plane_normal_[bin / 2] * (bin & 1 ? -1.0f : 1.0f)
                       : LightLists::middle_of(bin);
    const Sphere& around = owners_[owner];
    lazy.list = set ? lights_.draw(around.centre, around.radius, n, 0, kFloorLamps, 0.5f)
                    : lights_.draw(around.centre, around.radius, n, LightLists::kSlack,
                                   kObjectLamps, 0.5f);
  });
  return lazy.list;
}

void Direct::find_hidable(const LightLists::List& list, Vec3 centre, float radius,
                          std::vector<uint32_t>& found) const {
  static thread_local std::vector<uint8_t> keep;
  const size_t n = list.size();
  keep.assign(n, 0);
  for (const Sphere& s : scene_.bounds_.few()) {
    const Vec3 to = s.centre - centre;
    const float wide = s.radius + radius, to2 = length2(to);
    if (to2 <= wide * wide) {
      std::fill(keep.begin(), keep.end(), 1);
      break;
    }
    const float *x = list.x.data(), *y = list.y.data(), *z = list.z.data();
    const float* finite = list.finite.data();
    uint8_t* k = keep.data();
#pragma GCC ivdep
    for (size_t i = 0; i < n; ++i) {
      const float f = finite[i];
      const float vx = x[i] - f * centre.x, vy = y[i] - f * centre.y, vz = z[i] - f * centre.z;
      const float l = std::sqrt(vx * vx + vy * vy + vz * vz);
      const float along = (to.x * vx + to.y * vy + to.z * vz) / l;
      const bool ahead = (along >= -wide) & ((along - wide) * f <= l);
      k[i] |= ahead & (to2 - along * along <= wide * wide);
    }
  }
  found.clear();
  for (uint32_t i = 0; i < n; ++i) {
    if (keep[i]) found.push_back(i);
  }
}

void Direct::begin(int height, int width) {
  height_ = height, width_ = width, passes_ = 0;
  draw_lamps(0);
  const size_t n = size_t(height) * width, tiles = size_t(tiles_down()) * tiles_across();
  distance_.resize(n), face_.resize(n), object_.resize(n);
  film_.resize(tiles);
  touched_.assign(tiles, 0);
}

bool Direct::sees_objects(const PixelRays& rays, Vec3 camera, int x0, int x1, int y0,
                          int y1) const {
  Vec3 axis, edge[8];
  int count = 0;
  for (const int y : {y0, (y0 + y1) / 2, y1}) {
    for (const int x : {x0, (x0 + x1) / 2, x1}) {
      const Vec3 d(rays.corner + 3 * (size_t(y) * (rays.width + 1) + x));
      if (!is_finite(d)) return true;  // the lens ends here
      if (count < 8) edge[count++] = normalize(d);
      axis += normalize(d);
    }
  }
  if (!(length(axis) > 1e-3f)) return true;
  axis = normalize(axis);
  float cos = 1;
  for (int k = 0; k < count; ++k) cos = std::min(cos, dot(axis, edge[k]));
  if (cos < 0.2f) return true;
  const float half = 1.1f * std::acos(std::min(1.0f, cos)) + 1e-4f;
  for (const Sphere& s : scene_.bounds_.few()) {
    const Vec3 to = s.centre - camera;
    const float distance = length(to);
    if (distance <= s.radius) return true;
    const float angle = std::acos(std::clamp(dot(to, axis) / distance, -1.0f, 1.0f));
    if (angle <= half + std::asin(s.radius / distance)) return true;
  }
  return false;
}

uint64_t Direct::find_surfaces(const PixelRays& rays, Vec3 camera, Pair at, int x0, int y0) {
  const int x1 = std::min(x0 + kTile, width_), y1 = std::min(y0 + kTile, height_);
  const bool objects = sees_objects(rays, camera, x0, x1, y0, y1);
  const bool set = captured_.positional();
  uint64_t traced = 0;
  Packet packet;
  for (int y = y0; y < y1; y += 4) {
    for (int x = x0; x < x1; x += 4) {
      packet.clear();
      int count = 0;
      for (int k = 0; k < 16; ++k) {
        const int px = x + (k & 3), py = y + (k >> 2);
        if (px >= x1 || py >= y1) continue;
        const Vec3 d = rays.direction(py, px, at.x, at.y);
        if (is_finite(d)) packet.set(k, camera, d), ++count;
      }
      if (set && count) intersect(captured_.accel().scene(), packet, true), traced += count;
      for (int k = 0; k < 16; ++k) {
        const int px = x + (k & 3), py = y + (k >> 2);
        if (px >= x1 || py >= y1) continue;
        const size_t pixel = size_t(py) * width_ + px;
        const bool met = packet.valid[k] && packet.hits(k);
        face_[pixel] = met ? packet.rays.hit.primID[k] : kNowhere;
        distance_[pixel] = met ? packet.rays.ray.tfar[k] : kInfinity;
        object_[pixel] = 0;
        packet.forget_hit(k);
      }
      if (!objects || !count) continue;
      intersect(scene_.objects_->scene(), packet, true), traced += count;
      for (int k = 0; k < 16; ++k) {
        if (packet.valid[k] && packet.hits(k)) {
          object_[size_t(y + (k >> 2)) * width_ + x + (k & 3)] = 1;
        }
      }
    }
  }
  return traced;
}

uint64_t Direct::shade(const PixelRays& rays, Vec3 camera, int samples, int x0, int y0) {
  static thread_local Tile tile;
  tile.samples.clear(), tile.receivers.clear(), tile.count = 0;
  const int x1 = std::min(x0 + kTile, width_), y1 = std::min(y0 + kTile, height_);
  const Pair at = passes_ == 0 ? Pair{0.5f, 0.5f, 0} : spread(uint32_t(passes_));
  const StandIn& set = captured_.stand_in();
  const uint32_t set_lists = uint32_t(owners_.size()) - 1;
  ShadowRays shadows(*this);
  GatherRays near(*this, shadows, nullptr), gather(*this, shadows, &near);
  const bool gathers = bounces_ || scene_.objects_->shines();  // objects light the set
  const bool positional = captured_.positional(), flat = positional && captured_.flat();
  Vec3 above;  // a flat set: its normal, towards the camera
  if (flat) {
    above = plane_normal_[0] * (dot(camera - set.corner(0, 0), plane_normal_[0]) < 0 ? -1 : 1);
  }

  const auto near_object = [&](int x, int y) {
    for (int v = std::max(y - 1, 0); v <= std::min(y + 1, height_ - 1); ++v) {
      for (int u = std::max(x - 1, 0); u <= std::min(x + 1, width_ - 1); ++u) {
        if (object_[size_t(v) * width_ + u]) return true;
      }
    }
    return false;
  };
  const auto group_at = [&](uint32_t plane) -> Tile::Group& {
    for (size_t k = 0; k < tile.count; ++k) {
      if (tile.groups[k].plane == plane) return tile.groups[k];
    }
    if (tile.count == tile.groups.size()) tile.groups.emplace_back();
    Tile::Group& g = tile.groups[tile.count++];
    g.plane = plane, g.choices.clear();
    return g;
  };

  // what the pixels of this tile show; in blocks of 4 x 4, so that sixteen rays keep together
  for (int block = 0; block < FilmTile::kPixels; block += 16) {
    const int bx = x0 + block / 16 % 4 * 4, by = y0 + block / 64 * 4;
    bool object[16];
    for (int k = 0; k < 16; ++k) {
      const int x = bx + (k & 3), y = by + (k >> 2);
      object[k] = x < x1 && y < y1 && near_object(x, y);
      if (x >= x1 || y >= y1) continue;
      const size_t pixel = size_t(y) * width_ + x;
      if (face_[pixel] == kNowhere || set.surface[face_[pixel]] != 0) continue;
      const Vec3 d = rays.direction(y, x, at.x, at.y);
      const uint32_t plane = plane_at(face_[pixel], d);
      group_at(plane);
      tile.receivers.push_back(
          {object[k] ? kNowhere : uint32_t(pixel), camera + distance_[pixel] * d, plane});
    }
    for (int i = 0; i < samples; ++i) {
      const Pair a = spread(uint32_t(passes_ * samples + i));
      for (int k = 0; k < 16; ++k) {
        if (!object[k]) continue;
        const int x = bx + (k & 3), y = by + (k >> 2);
        const Vec3 d = rays.direction(y, x, fraction(a.x + turn(x, y)),
                                      fraction(a.y + turn(y + 1, x + 2)));
        if (is_finite(d)) tile.samples.push_back({uint32_t(y * width_ + x), d, i});
      }
    }
  }

  // the lamps that an object may hide from each group's receivers
  for (size_t k = 0; k < tile.count; ++k) {
    Tile::Group& g = tile.groups[k];
    Vec3 least(kInfinity), most(-kInfinity);
    for (const Tile::Receiver& r : tile.receivers) {
      if (r.plane != g.plane) continue;
      least = {std::min(least.x, r.x.x), std::min(least.y, r.x.y), std::min(least.z, r.x.z)};
      most = {std::max(most.x, r.x.x), std::max(most.y, r.x.y), std::max(most.z, r.x.z)};
    }
    g.centre = 0.5f * (least + most);
    g.radius = 0.55f * length(most - least);
    g.list = &list(set_lists, g.plane);
    find_hidable(*g.list, g.centre, g.radius, g.choices);
    g.potential = g.list->size() ? float(g.choices.size()) / float(g.list->size()) : 0;
  }

  // shadow on the set, through the middles of pixels
  struct Sums {
    Vec3 sum, square;
  };
  static thread_local std::vector<Sums> sums;
  sums.assign(tile.receivers.size(), {});
  static thread_local std::vector<Sums> sent;  // by objects
  sent.assign(tile.receivers.size(), {});
  static thread_local std::vector<Vec3> lit;  // by lights without size
  lit.assign(tile.receivers.size(), {});
  const auto ask = [&](const Tile::Group& g, Vec3 x, float u, Vec3* sum, Vec3* square) {
    const size_t m = g.choices.size();
    const auto& c = g.list->choices[g.choices[std::min(m - 1, size_t(u * float(m)))]];
    const Vec3 n = normal_of(g.plane), start = x + clearance(x, camera) * n;
    const Lamp::Incident in = lights_.lamp(c.lamp).incident(start);
    const float cos = dot(in.d, n);
    if (cos <= 0 || in.share == 0) return;
    const Vec3 light = c.flux * (in.share * cos * float(m));
    shadows.push(start, in.d, in.t * (1 - 1e-3f), {sum, square, light, true, positional && !flat});
  };
  // Where little can be hidden few rays will do, and some pixels go without: `part` of them ask.
  struct Share {
    int rays;
    float part;
  };
  const auto share_of = [&](const Tile::Group& g) {
    const float wanted = std::sqrt(g.potential / kMuch) * float(samples);
    const int most = int(std::min<size_t>(g.choices.size(), size_t(2 * samples)));
    return Share{std::clamp(int(std::ceil(wanted)), 1, most), std::min(1.0f, wanted)};
  };
  const float pass_turn = fraction(float(passes_) * 0.618034f);
  for (int j = 0; j < 2 * samples; ++j) {
    bool asked = false;
    for (size_t k = 0; k < tile.receivers.size(); ++k) {
      const Tile::Receiver& r = tile.receivers[k];
      if (r.pixel == kNowhere) continue;
      const Tile::Group& g = group_at(r.plane);
      if (g.choices.empty()) continue;
      const Share share = share_of(g);
      if (j >= share.rays) continue;
      asked = true;
      const float shift =
          fraction(turn(int(r.pixel % width_), int(r.pixel / width_)) + pass_turn);
      if (share.part < 1 && shift >= share.part) continue;
      ask(g, r.x, (float(j) + shift / share.part) / float(share.rays), &sums[k].sum,
          &sums[k].square);
    }
    if (!asked) break;
  }
  // directions of a second leg, apart from those of the first
  const auto another = [&](uint32_t i, int px, int py) {
    const Pair a = spread(3 * i + 1);
    return Pair{fraction(a.x + turn(py + 3, px)), fraction(a.y + turn(px + 3, py + 2)), 0};
  };
  const auto seek = [&](const Tile::Sample& s) {
    return another(uint32_t(passes_ * samples + s.i), int(s.pixel % width_),
                   int(s.pixel / width_));
  };
  const auto look_at_objects = [&](Vec3 x, Vec3 n, Pair u, float lamp, Pair v, Vec3* sum,
                                   Vec3* square) {
    const Vec3 start = x + clearance(x, camera) * n;
    const Cones cones(start, n, scene_.bounds_);
    if (cones.empty()) return;
    const Vec3 d = cones.sample(u);
    const float cos = dot(d, n);
    if (cos <= 0) return;
    gather.push(start, d, {sum, square, Vec3(cos / cones.density(d)), lamp, v, false});
  };
  if (gathers) {
    for (size_t k = 0; k < tile.receivers.size(); ++k) {
      const Tile::Receiver& r = tile.receivers[k];
      if (r.pixel == kNowhere) continue;
      const int px = int(r.pixel % width_), py = int(r.pixel / width_);
      const Pair a = spread(uint32_t(passes_));
      const Pair u{fraction(a.x + turn(px, py + 1)), fraction(a.y + turn(py, px)), 0};
      look_at_objects(r.x, normal_of(r.plane), u, fraction(turn(px + 1, py) + pass_turn),
                      another(uint32_t(passes_), px, py), &sent[k].sum, &sent[k].square);
    }
  }
  gather.flush();
  near.flush();
  shadows.flush();
  // lights without size: no noise, so that one ray each is enough
  uint64_t traced = 0;
  const bool lights = !scene_.objects_->delta_lights().empty();
  const auto delta_change = [&](Vec3 x, Vec3 n, size_t pixel) {
    Sampler sampler(scene_.table_, seed_ + pixel, uint32_t(passes_));
    Compositor::Path path{sampler};
    const Vec3 dE = scene_.delta_change(x + clearance(x, camera) * n, n, path);
    traced += path.rays;
    return dE;
  };
  for (size_t k = 0; lights && k < tile.receivers.size(); ++k) {
    const Tile::Receiver& r = tile.receivers[k];
    if (r.pixel != kNowhere) lit[k] = delta_change(r.x, normal_of(r.plane), r.pixel);
  }

  // E is smooth: one value for 4 x 4 pixels of a plane
  struct Known {
    uint32_t plane = kNowhere;
    Vec3 E;
  } known[kTile * kTile / 16];
  const auto irradiance = [&](size_t pixel, uint32_t face, Vec3 x, uint32_t plane) {
    const int row = int(pixel / width_) - y0, column = int(pixel % width_) - x0;
    Known& cell = known[row / 4 * (kTile / 4) + column / 4];
    if (cell.plane != plane) {
      Place place;
      place.p = x, place.n = normal_of(plane), place.face = face, place.t = 1;
      place.rise = clearance(x, camera);
      cell = {plane, scene_.irradiance_.at(place)};
    }
    return cell.E;
  };
  const size_t number = size_t(y0 / kTile) * tiles_across() + x0 / kTile;
  bool anything = !tile.samples.empty();
  for (const Sums& one : sent) anything |= !is_zero(one.sum);
  for (const Vec3& one : lit) anything |= !is_zero(one);
  for (size_t k = 0; k < tile.count; ++k) anything |= !tile.groups[k].choices.empty();
  if (!touched_[number]) {
    if (!anything) return traced + shadows.traced + gather.traced + near.traced;
    if (!film_[number]) film_[number] = std::make_unique<FilmTile>();
    *film_[number] = {};
    touched_[number] = 1;
    // earlier passes found nothing to change
    std::fill_n(film_[number]->set.share, FilmTile::kPixels, float(passes_));
  }
  FilmTile& film = *film_[number];
  const auto film_pixel = [&](size_t pixel) {
    return (int(pixel / width_) - y0) * kTile + int(pixel % width_) - x0;
  };
  for (size_t k = 0; k < tile.receivers.size(); ++k) {
    const Tile::Receiver& r = tile.receivers[k];
    if (r.pixel == kNowhere) continue;
    const Tile::Group& g = group_at(r.plane);
    const size_t i = r.pixel;
    const int at = film_pixel(i);
    film.set.share[at] += 1;
    film.set.group[at] = float(r.plane + 1);
    const Vec3 more = sent[k].sum + lit[k];
    if (g.choices.empty() && is_zero(more)) continue;
    const Vec3 E = irradiance(i, face_[i], r.x, r.plane);
    if (!is_zero(more)) {
      const Vec3 q = over(more, E);
      film.set.r[at] += q.x, film.set.g[at] += q.y, film.set.b[at] += q.z;
      const float noisy = mean(over(sent[k].sum, E));
      film.set.variance[at] += noisy * noisy;
    }
    if (g.choices.empty()) continue;
    const Share share = share_of(g);
    const float n = float(share.rays) * share.part;
    const Vec3 q = over(sums[k].sum, E) * (1 / n);
    film.set.r[at] += q.x, film.set.g[at] += q.y, film.set.b[at] += q.z;
    const float m = mean(q), square = mean(over(over(sums[k].square, E), E)) / n;
    // a single ray says 0 or all of it: its variance is bounded by what it may say
    film.set.variance[at] += share.rays > 1 ? std::max(square - m * m, 0.0f) / (n - 1)
                                       : 0.1f * g.potential * g.potential / share.part;
  }

  // sub-samples where objects are
  const float whole = 1 / float(samples);
  Packet packet;
  for (size_t first = 0; first < tile.samples.size(); first += Packet::kWidth) {
    const int count = int(std::min<size_t>(Packet::kWidth, tile.samples.size() - first));
    packet.clear();
    for (int k = 0; k < count; ++k) packet.set(k, camera, tile.samples[first + k].d);
    intersect(scene_.objects_->scene(), packet, true), traced += count;
    Hit hits[Packet::kWidth];
    uint32_t face[Packet::kWidth];
    std::fill(std::begin(face), std::end(face), kNowhere);
    int left = 0;
    for (int k = 0; k < count; ++k) {
      if (packet.hits(k)) hits[k] = packet.hit(k);
      packet.forget_hit(k);
      packet.valid[k] = positional && set_matters(packet, k) ? -1 : 0;
      left += packet.valid[k] != 0;
    }
    if (left) intersect(captured_.accel().scene(), packet, true), traced += left;
    for (int k = 0; k < count; ++k) {
      if (packet.valid[k] && packet.hits(k)) {
        face[k] = packet.rays.hit.primID[k];
        hits[k] = {};
      }
    }
    for (int k = 0; k < count; ++k) {
      Tile::Sample& s = tile.samples[first + k];
      s.t = packet.rays.ray.tfar[k];
      Hit hit = hits[k];
      if (hit && scene_.objects_->material(hit).transmits) {  // look through
        Sampler sampler(scene_.table_, seed_ + s.pixel, uint32_t(passes_ * samples + s.i));
        Compositor::Path path{sampler};
        const auto met = scene_.meet(camera, s.d, s.share, path);
        traced += path.rays;
        hit = met.hit;
        s.t = met.hit ? met.hit.t : met.place.t;
        face[k] = met.place ? met.place.face : kNowhere;
      }
      if (hit) {
        s.on_object = true;
        const Surface surface = scene_.objects_->surface_at(hit, s.d);
        s.n = surface.ns;
        s.group = owner_of(hit.instance);
        if (surface.model != Model::diffuse) {
          Sampler sampler(scene_.table_, seed_ + s.pixel, uint32_t(passes_ * samples + s.i));
          Compositor::Path path{sampler};
          s.other = s.share * scene_.object_radiance(hit, s.d, 0, path);
          traced += path.rays;
          continue;
        }
        s.albedo = surface.alpha * s.share * surface.base;
        s.other = s.share * surface.emission;
        if (lights) {
          Sampler sampler(scene_.table_, seed_ + s.pixel, uint32_t(passes_ * samples + s.i));
          Compositor::Path path{sampler};
          s.other += s.share * scene_.delta_light(surface, -s.d, path);
          traced += path.rays;
        }
        const Vec3 start = surface.p + surface.rise * surface.ng;
        const LightLists::List& list = this->list(s.group, LightLists::bin_of(s.n));
        const size_t m = list.choices.size();
        const int px = int(s.pixel % width_), py = int(s.pixel / width_);
        const float shift = fraction(turn(px, py) + pass_turn);
        for (int j = 0; m && j < kRaysOfSample; ++j) {
          const float u = (float(j * samples + s.i) + shift) / float(kRaysOfSample * samples);
          const auto& c = list.choices[std::min(m - 1, size_t(u * float(m)))];
          const Lamp::Incident in = lights_.lamp(c.lamp).incident(start);
          const float cos = dot(in.d, s.n);
          if (cos <= 0 || in.share == 0 || dot(in.d, surface.ng) <= 0) continue;
          const Vec3 light = c.flux * (in.share * cos * float(m) / kRaysOfSample);
          const bool set_may_hide =
              positional && (!flat || (in.t == kInfinity && dot(in.d, above) < 0));
          shadows.push(start, in.d, in.t * (1 - 1e-3f),
                       {&s.value, &s.square, light, false, set_may_hide});
        }
        // what is near in the set, and what objects and set send each other
        if (positional || gathers) {
          const Pair a = spread(uint32_t(passes_ * samples + s.i));
          const Vec3 d = Frame(s.n).world(sample_cosine(fraction(a.x + turn(py, px + 1)),
                                                        fraction(a.y + turn(px + 2, py))));
          if (dot(d, surface.ng) > 0) {
            const float u = fraction(shift + 0.618034f * float(s.i) + 0.5f);
            gather.push(start, d, {&s.value, &s.square, Vec3(kPi), u, seek(s), true});
          }
        }
      } else if (face[k] != kNowhere && set.surface[face[k]] == 0) {
        const uint32_t plane = plane_at(face[k], s.d);
        Tile::Group& g = group_at(plane);
        s.group = face[k];
        s.rays = 0;
        if (!g.choices.empty()) {
          s.rays = 2;
          const float shift = fraction(turn(int(s.pixel % width_), int(s.pixel / width_)) +
                                       pass_turn + 0.618034f * float(s.i));
          for (int j = 0; j < s.rays; ++j) {
            ask(g, camera + s.t * s.d, (float(j) + shift) / float(s.rays), &s.value, &s.square);
          }
        }
        if (lights) s.other += delta_change(camera + s.t * s.d, normal_of(plane), s.pixel);
        if (gathers) {
          const int px = int(s.pixel % width_), py = int(s.pixel / width_);
          const Pair a = spread(uint32_t(passes_ * samples + s.i));
          const Pair u{fraction(a.x + turn(px, py + 1)), fraction(a.y + turn(py, px)), 0};
          look_at_objects(camera + s.t * s.d, normal_of(plane), u,
                          fraction(turn(px + 1, py) + pass_turn + 0.618034f * float(s.i)), seek(s),
                          &s.other, &s.square);
        }
      }
    }
  }
  gather.flush();
  near.flush();
  shadows.flush();
  std::fill(std::begin(tile.on_set), std::end(tile.on_set), Moments{});
  std::fill(std::begin(tile.on_object), std::end(tile.on_object), Moments{});
  for (const Tile::Sample& s : tile.samples) {
    const int at = film_pixel(s.pixel);
      if (s.t < kInfinity) film.depth[at] += whole * s.t;
      if (s.on_object) {
        const Vec3 lit = (1 / kPi) * s.albedo * s.value;
        film.objects.share[at] += whole;
        film.objects.r[at] += whole * lit.x, film.objects.g[at] += whole * lit.y;
        film.objects.b[at] += whole * lit.z;
        film.objects.nx[at] += whole * s.n.x, film.objects.ny[at] += whole * s.n.y;
        film.objects.nz[at] += whole * s.n.z;
        film.objects.group[at] = float(s.group + 1);
        film.albedo[0][at] += whole / kPi * s.albedo.x, film.albedo[1][at] += whole / kPi * s.albedo.y;
        film.albedo[2][at] += whole / kPi * s.albedo.z;
        film.other[0][at] += whole * s.other.x, film.other[1][at] += whole * s.other.y;
        film.other[2][at] += whole * s.other.z;
        tile.on_object[at].add(mean(s.value));
      } else {
        // (1 + dE / E) of the plate's radiance, and of that what comes through panes
        Vec3 q;
        const bool support = s.group != kNowhere;
        const uint32_t plane = support ? plane_at(s.group, s.d) : 0;
        if (support && (s.rays || !is_zero(s.other))) {
          const Vec3 E = irradiance(s.pixel, s.group, camera + s.t * s.d, plane);
          q = over(s.value, E) * (1 / float(std::max(1, s.rays))) + over(s.other, E);
        }
        q = s.share * (Vec3(1.0f) + q) - Vec3(1.0f);
        if (!support && is_zero(q)) continue;
        film.set.share[at] += whole;
        film.set.group[at] = support ? float(plane + 1) : -1;
        if (is_zero(q)) continue;
        film.set.r[at] += whole * q.x, film.set.g[at] += whole * q.y, film.set.b[at] += whole * q.z;
        tile.on_set[at].add(mean(q));
      }
  }
  for (int at = 0; at < FilmTile::kPixels; ++at) {
    film.set.variance[at] += tile.on_set[at].of_mean();
    film.objects.variance[at] += tile.on_object[at].of_mean();
  }
  return traced + shadows.traced + gather.traced + near.traced;
}

uint64_t Direct::pass(const PixelRays& rays, Vec3 camera, int samples) {
  std::atomic<uint64_t> traced{0};
  draw_lamps(passes_ / kPassesOfLamps);
  const Pair at = passes_ == 0 ? Pair{0.5f, 0.5f, 0} : spread(uint32_t(passes_));
  const int across = tiles_across(), down = tiles_down();
  const auto tiles = [&](auto&& work) {
    tbb::parallel_for(tbb::blocked_range<int>(0, across * down, 4), [&](const auto& range) {
      const FlushDenormals flush;
      uint64_t n = 0;
      for (int k = range.begin(); k < range.end(); ++k) {
        n += work(k % across * kTile, k / across * kTile);
      }
      traced += n;
    });
  };
  tiles([&](int x, int y) { return find_surfaces(rays, camera, at, x, y); });
  tiles([&](int x, int y) { return shade(rays, camera, samples, x, y); });
  ++passes_;
  return traced;
}

size_t Direct::resolve(const PixelRays& rays, Vec3 camera, const float* plate,
                       bool difference, bool filter, float* rgb, float* layers) const {
  std::atomic<size_t> clipped{0};
  const int across = tiles_across(), down = tiles_down();
  const float per_pass = 1 / float(std::max(1, passes_));
  const auto layer = [&](size_t i, Vec3 object, float alpha, Vec3 dq, float error, float depth,
                         float share) {
    if (!layers) return;
    const float values[kLayers] = {
        object.x, object.y, object.z, alpha,        1 + dq.x,     1 + dq.y,
        1 + dq.z, error,    depth,    share * dq.x, share * dq.y, share * dq.z};
    std::copy_n(values, kLayers, layers + kLayers * i);
  };
  tbb::parallel_for(0, across * down, [&](int k) {
    const FlushDenormals flush;
    const int x0 = k % across * kTile, y0 = k / across * kTile;
    const int x1 = std::min(x0 + kTile, width_), y1 = std::min(y0 + kTile, height_);
    const auto middle_depth = [&](size_t i) {
      return distance_[i] < kInfinity ? distance_[i] : 0.0f;
    };
    if (!touched_[k]) {
      for (int y = y0; y < y1; ++y) {
        const size_t from = size_t(y) * width_ + x0;
        std::copy_n(plate + 3 * from, 3 * size_t(x1 - x0), rgb + 3 * from);
        for (int x = 0; layers && x < x1 - x0; ++x) {
          layer(from + x, {}, 0, {}, 0, middle_depth(from + x), 0);
        }
      }
      return;
    }
    const FilmTile* around[9] = {};
    for (int j = 0; j < 9; ++j) {
      const int x = k % across + j % 3 - 1, y = k / across + j / 3 - 1;
      if (x < 0 || y < 0 || x >= across || y >= down || !touched_[y * across + x]) continue;
      around[j] = film_[y * across + x].get();
    }
    static thread_local Filter set, objects;
    set.run(around, false, passes_, filter);
    objects.run(around, true, passes_, filter);
    const FilmTile& film = *film_[k];
    for (int y = y0; y < y1; ++y) {
      for (int x = x0; x < x1; ++x) {
        const size_t i = size_t(y) * width_ + x;
        const int at = (y - y0) * kTile + x - x0;
        const Vec3 B(plate + 3 * i);
        const float alpha = film.objects.share[at] * per_pass;
        const float share = film.set.share[at] * per_pass;
        const Vec3 dq = share > 0 ? set.value(at) : Vec3();
        const Vec3 albedo = per_pass * Vec3(film.albedo[0][at], film.albedo[1][at],
                                            film.albedo[2][at]);
        const Vec3 object = (alpha > 0 ? albedo * objects.value(at) : Vec3()) +
                            per_pass * Vec3(film.other[0][at], film.other[1][at],
                                            film.other[2][at]);
        Vec3 out = B;
        float error = 0;
        if (alpha > 0 || !is_zero(dq)) {
          Vec3 L = B;
          if (difference) {
            const Vec3 d = rays.direction(y, x, 0.5f, 0.5f);
            L = captured_.radiance(captured_.trace(camera, d), d);
          }
          out = B * (1 - alpha) + L * dq * share + object;
          if (std::min(out.x, std::min(out.y, out.z)) < 0) {
            ++clipped;
            out = {std::max(out.x, 0.0f), std::max(out.y, 0.0f), std::max(out.z, 0.0f)};
          }
          const float of_set = mean(L) * share, of_objects = mean(albedo);
          error = std::sqrt(of_set * of_set * set.variance(at) +
                            of_objects * of_objects * objects.variance(at));
        }
        rgb[3 * i] = out.x, rgb[3 * i + 1] = out.y, rgb[3 * i + 2] = out.z;
        layer(i, object, alpha, dq, error,
              film.depth[at] > 0 ? film.depth[at] * per_pass : middle_depth(i), share);
      }
    }
  });
  return clipped;
}

}  // namespace chromeball
