#include "direct.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <map>
#include <tuple>

#include "direct_tile.h"

namespace chromeball {

Direct::Direct(const Compositor& scene, uint64_t seed)
    : scene_(scene),
      captured_(scene.captured_),
      lights_(scene.captured_, seed),
      bounces_(scene.bounces_ > 0),
      seed_(seed) {
  // large planes of the set get a list that is drawn for their very normal
  const StandIn& set = captured_.stand_in();
  plane_of_.resize(set.size());
  std::map<std::tuple<long, long, long>, uint32_t> known;  // of rounded normals
  for (uint32_t f = 0; f < set.size(); ++f) {
    const Vec3 n = set.normal(f);
    const auto rounded = [](float x) { return std::lround(x * 2e3f); };
    const auto key = std::tuple(rounded(n.x), rounded(n.y), rounded(n.z));
    const auto [entry, fresh] = known.try_emplace(key, uint32_t(plane_normal_.size()));
    if (fresh) plane_normal_.push_back(n);
    plane_of_[f] = 2 * entry->second;
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
    const uint64_t number = uint64_t(owner) * LightLists::kBins + bin;
    const float u = float(mix64(mix64(seed_ + uint64_t(epoch_)) + number) >> 40) * 0x1p-24f;
    lazy.list = set ? lights_.draw(around.centre, around.radius, n, 0, kFloorLamps, u)
                    : lights_.draw(around.centre, around.radius, n, LightLists::kSlack,
                                   kObjectLamps, u);
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
  distance_.resize(n), face_.resize(n), object_distance_.resize(n);
  object_.assign(n, 0);
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
        packet.forget_hit(k);
      }
      if (!objects || !count) continue;
      intersect(scene_.objects_->scene(), packet, true), traced += count;
      for (int k = 0; k < 16; ++k) {
        if (packet.valid[k] && packet.hits(k)) {
          const size_t pixel = size_t(y + (k >> 2)) * width_ + x + (k & 3);
          if (object_[pixel]) continue;
          object_[pixel] = uint8_t(1 + packet.hit(k).instance % 255);
          object_distance_[pixel] = packet.rays.ray.tfar[k];
        }
      }
    }
  }
  return traced;
}

// Where a pixel's middle is looked for in this pass.
Pair Direct::middle() const {
  return passes_ == 0 ? Pair{0.5f, 0.5f, 0} : spread(uint32_t(passes_));
}

uint64_t Direct::pass(const PixelRays& rays, Vec3 camera, int samples) {
  std::atomic<uint64_t> traced{0};
  draw_lamps(passes_ / kPassesOfLamps);
  const Pair at = middle();
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
  tiles([&](int x, int y) {
    static thread_local Tile tile;
    return tile.shade(*this, rays, camera, samples, x, y);
  });
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
              film.depths[at] > 0 ? film.depth[at] / film.depths[at] : middle_depth(i), share);
      }
    }
  });
  return clipped;
}

}  // namespace chromeball
