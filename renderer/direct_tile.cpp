#include "direct_tile.h"

namespace chromeball {
namespace {

constexpr float kMuch = 0.15f;  // of E that may be hidden: the full number of rays is spent
constexpr float kEven = 0.01f;  // of 1 / E, within 4 x 4 pixels
constexpr float kJump = 0.02f;  // of the distance, between neighbours: an edge
constexpr int kRays = 2;        // shadow rays for each sample of a pixel

// Neighbours in 4 x 4 pixels look at different lamps; the filter joins what they see.
constexpr uint8_t kOrder[16] = {0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5};

}  // namespace

Direct::Tile::Pixel Direct::Tile::offset(int at) {
  const int cell = at / kWidth, block = at % kWidth;
  return {block % 4 * 4 + cell % 4, block / 4 * 4 + cell / 4};
}

// The pixel's place in an order of 4 x 4, or that of one further on: numbers to turn sequences by.
float Direct::Tile::turn(int at, int across, int down) const {
  const Pixel p = offset(at);
  return (float(kOrder[(p.y + down) % 4 * 4 + (p.x + across) % 4]) + 0.5f) / 16;
}

// Of a sequence that fills the square evenly, another one for each pixel of 4 x 4 and each seed.
Pair Direct::Tile::spread_at(uint32_t i, float x, float y) const {
  const Pair u = spread(i);
  return {fraction(u.x + start_.x + x), fraction(u.y + start_.y + y), 0};
}

uint64_t Direct::Tile::shade(Direct& direct, const PixelRays& rays, Vec3 camera, int samples,
                             int x0, int y0) {
  direct_ = &direct, rays_ = &rays, camera_ = camera, samples_ = samples, x0_ = x0, y0_ = y0;
  traced_ = 0;
  start_ = spread(uint32_t(direct.seed_ ^ direct.seed_ >> 32) * 2654435761u);
  pass_turn_ = fraction(float(direct.passes_) * 0.618034f + start_.x);
  positional_ = direct.captured_.positional();
  const bool flat = positional_ && direct.captured_.flat();
  set_hides_ = positional_ && !flat;
  if (flat) {
    const Vec3 n = direct.plane_normal_[0];
    above_ = n * (dot(camera - direct.captured_.stand_in().corner(0, 0), n) < 0 ? -1.0f : 1.0f);
  }
  look_at_pixels();
  find_hidable_lamps();
  find_irradiance();
  shadow_set();
  light_set();
  trace_samples();
  choose_samples();
  shade_samples();
  if (FilmTile* film = this->film()) {
    add_set(*film);
    add_samples(*film);
  }
  return traced_;
}

Direct::Tile::Group& Direct::Tile::group_of(uint32_t plane) {
  for (size_t k = 0; k < group_count_; ++k) {
    if (groups_[k].plane == plane) return groups_[k];
  }
  if (group_count_ == groups_.size()) groups_.emplace_back();
  Group& g = groups_[group_count_++];
  g.plane = plane, g.normal = direct_->normal_of(plane), g.choices.clear();
  return g;
}

void Direct::Tile::look_at_pixels() {
  const Direct& d = *direct_;
  const StandIn& set = d.captured_.stand_in();
  const Pair middle = d.middle();
  group_count_ = 0;
  samples_of_.clear();
  bool objects = false;
  for (int y = std::max(y0_ - 1, 0); y < std::min(y0_ + kTile + 1, d.height_); ++y) {
    const uint8_t* const row = &d.object_[index({0, y})];
    const int from = std::max(x0_ - 1, 0), to = std::min(x0_ + kTile + 1, d.width_);
    objects |= std::any_of(row + from, row + to, [](uint8_t one) { return one != 0; });
  }
  const auto shows = [&](Pixel p) {
    if (!objects) return Shows::set;
    const uint8_t one = d.object_[index(p)];
    const float distance = d.object_distance_[index(p)], jump = kJump * distance;
    bool same = true;
    for (int v = std::max(p.y - 1, 0); v <= std::min(p.y + 1, d.height_ - 1); ++v) {
      for (int u = std::max(p.x - 1, 0); u <= std::min(p.x + 1, d.width_ - 1); ++u) {
        const size_t beside = index({u, v});
        same &= d.object_[beside] == one;
        same &= !one || std::abs(d.object_distance_[beside] - distance) < jump;
      }
    }
    return !same ? Shows::edge : one ? Shows::inside : Shows::set;
  };
  for (int at = 0; at < kPixels; ++at) {
    plane_[at] = kNowhere, asks_[at] = 0, shows_[at] = Shows::set;
    const Pixel p = pixel(at);
    if (!is_inside(p)) continue;
    shows_[at] = shows(p);
    const uint32_t face = d.face_[index(p)];
    if (face == kNowhere || set.surface[face] != 0) continue;
    const Vec3 w = rays_->direction(p.y, p.x, middle.x, middle.y);
    const Vec3 x = camera_ + d.distance_[index(p)] * w;
    x_[at] = x.x, y_[at] = x.y, z_[at] = x.z;
    plane_[at] = d.plane_at(face, w);
    asks_[at] = shows_[at] == Shows::set;
    group_of(plane_[at]);
  }
  // in blocks of 4 x 4, so that sixteen rays keep together
  for (int block = 0; block < kWidth; ++block) {
    for (int cell = 0; cell < kPixels / kWidth; ++cell) {
      const int at = cell * kWidth + block;
      if (shows_[at] == Shows::set) continue;
      const Pixel p = pixel(at);
      const uint32_t count = uint32_t(subsamples(shows_[at]));
      for (uint32_t k = 0; k < count; ++k) {
        const uint32_t i = uint32_t(d.passes_) * count + k;
        const Pair u = spread_at(i, turn(at), turn(at, 2, 1));
        const Vec3 w = rays_->direction(p.y, p.x, u.x, u.y);
        if (!is_finite(w)) continue;
        Sample s;
        s.at = at, s.d = w, s.i = i;
        samples_of_.push_back(s);
      }
    }
  }
}

// The lamps that an object may hide from each group.
void Direct::Tile::find_hidable_lamps() {
  for (size_t k = 0; k < group_count_; ++k) {
    Group& g = groups_[k];
    Vec3 least(kInfinity), most(-kInfinity);
    for (int at = 0; at < kPixels; ++at) {
      if (plane_[at] != g.plane) continue;
      least = {std::min(least.x, x_[at]), std::min(least.y, y_[at]), std::min(least.z, z_[at])};
      most = {std::max(most.x, x_[at]), std::max(most.y, y_[at]), std::max(most.z, z_[at])};
    }
    g.centre = 0.5f * (least + most);
    g.radius = 0.55f * length(most - least);
    g.list = &direct_->list(direct_->set_lists(), g.plane);
    direct_->find_hidable(*g.list, g.centre, g.radius, g.choices);
    g.potential = g.list->size() ? float(g.choices.size()) / float(g.list->size()) : 0;
  }
}

Vec3 Direct::Tile::irradiance(uint32_t face, Vec3 x, uint32_t plane) const {
  Place place;
  place.p = x, place.n = direct_->normal_of(plane), place.face = face, place.t = 1;
  place.rise = clearance(x, camera_);
  return direct_->scene_.irradiance_.at(place);
}

// Where E is smooth one value will do for 4 x 4 pixels of a plane: where the first and the last
// of them agree.
void Direct::Tile::find_irradiance() {
  const auto inverse_at = [&](int at) {
    const Vec3 x{x_[at], y_[at], z_[at]};
    return over(Vec3(1.0f), irradiance(direct_->face_[index(pixel(at))], x, plane_[at]));
  };
  for (int block = 0; block < kWidth; ++block) {
    int first = -1, last = -1;
    bool one_plane = true;
    for (int at = block; at < kPixels; at += kWidth) {
      if (!asks_[at]) continue;
      if (first < 0) first = at;
      last = at;
      one_plane &= plane_[at] == plane_[first];
    }
    if (first < 0) continue;
    const Vec3 from = inverse_at(first), to = inverse_at(last);
    const bool even = one_plane && mean(abs(to - from)) < kEven * mean(from);
    for (int at = block; at < kPixels; at += kWidth) {
      if (!asks_[at]) continue;
      const Vec3 inverse = even ? 0.5f * (from + to) : inverse_at(at);
      inverse_[0][at] = inverse.x, inverse_[1][at] = inverse.y, inverse_[2][at] = inverse.z;
    }
  }
}

// Where little can be hidden few rays will do, and some pixels go without. Two rays tell of their
// noise, one does not.
Direct::Tile::Asked Direct::Tile::asked(const Group& g) const {
  const float wanted = std::sqrt(g.potential / kMuch) * float(samples_);
  const int most = int(std::min<size_t>(g.choices.size(), size_t(kRays * samples_)));
  const int rays = std::clamp(int(std::ceil(wanted)), std::min(2, most), most);
  return {rays, std::min(1.0f, wanted / float(rays))};
}

void Direct::Tile::shadow_set() {
  for (Plane& q : q_) q.fill(0);
  square_.fill(0);
  for (size_t k = 0; k < group_count_; ++k) {
    if (groups_[k].choices.empty()) continue;
    for (int row = 0; row < kPixels; row += kWidth) shadow_row(groups_[k], row);
  }
}

// Sixteen pixels, four apart: of a group they ask the same lamps.
void Direct::Tile::shadow_row(const Group& g, int row) {
  bool any = false;
  for (int k = 0; k < kWidth; ++k) any |= asks_[row + k] && plane_[row + k] == g.plane;
  const Asked asked = this->asked(g);
  // of a tile's 16 rows a whole number asks, of many tiles the right part
  const int number = y0_ / kTile * direct_->tiles_across() + x0_ / kTile;
  const float shift = fraction(turn(row) + pass_turn_ + float(number) * 0.754878f);
  if (!any || shift >= asked.part) return;
  const size_t m = g.choices.size();
  for (int j = 0; j < asked.rays; ++j) {
    const float u = (float(j) + shift / asked.part) / float(asked.rays);
    shadow_row(g, row, g.list->choices[g.choices[std::min(m - 1, size_t(u * float(m)))]]);
  }
}

// Rays that pass by the spheres around the objects are taken out; returns how many are left.
int Direct::Tile::keep_those_that_may_hit(Packet& packet) const {
  const RTCRay16& ray = packet.rays.ray;
  alignas(64) int keep[kWidth] = {};
  for (const Sphere& s : direct_->scene_.bounds_.few()) {
    const float r2 = s.radius * s.radius;
#pragma GCC ivdep
    for (int k = 0; k < kWidth; ++k) {
      const float x = s.centre.x - ray.org_x[k], y = s.centre.y - ray.org_y[k];
      const float z = s.centre.z - ray.org_z[k];
      const float along = x * ray.dir_x[k] + y * ray.dir_y[k] + z * ray.dir_z[k];
      const float distance2 = x * x + y * y + z * z;
      const bool ahead = (along > 0) & (distance2 - along * along <= r2 + 1e-6f * distance2);
      keep[k] |= (distance2 <= r2) | ahead;
    }
  }
  int left = 0;
  for (int k = 0; k < kWidth; ++k) {
    packet.valid[k] = packet.valid[k] && keep[k] ? -1 : 0;
    left += packet.valid[k] != 0;
  }
  return left;
}

// What an object keeps away of one lamp's light.
void Direct::Tile::shadow_row(const Group& g, int row, const LightLists::Choice& choice) {
  const Lamp lamp = direct_->lights_.lamp(choice.lamp);
  const World& objects = *direct_->scene_.objects_;
  alignas(64) float share[kWidth];  // of the lamp's flux that arrives
  alignas(64) float far[kWidth];
  alignas(64) Packet packet;
  RTCRay16& ray = packet.rays.ray;
  const float lift = 8 * kLift, near2 = Lamp::kNear * Lamp::kNear * lamp.distance * lamp.distance;
  const float cos_o = lamp.cos_o > 1e-4f ? lamp.distance * lamp.distance / lamp.cos_o : 0;
  const float many = float(g.choices.size());
  const bool finite = lamp.finite;
  int left = 0;
#pragma GCC ivdep
  for (int k = 0; k < kWidth; ++k) {
    const float x = x_[row + k], y = y_[row + k], z = z_[row + k];
    const float large = std::max(std::abs(x), std::max(std::abs(y), std::abs(z)));
    const float away = std::max(std::abs(x - camera_.x),
                                std::max(std::abs(y - camera_.y), std::abs(z - camera_.z)));
    const float rise = lift * (large + away);
    const float ox = x + rise * g.normal.x, oy = y + rise * g.normal.y, oz = z + rise * g.normal.z;
    const float tx = finite ? lamp.place.x - ox : lamp.place.x;
    const float ty = finite ? lamp.place.y - oy : lamp.place.y;
    const float tz = finite ? lamp.place.z - oz : lamp.place.z;
    const float t2 = tx * tx + ty * ty + tz * tz, t = std::sqrt(t2), inverse = 1 / t;
    const float dx = tx * inverse, dy = ty * inverse, dz = tz * inverse;
    const float cos = dx * g.normal.x + dy * g.normal.y + dz * g.normal.z;
    const float cos_x = std::abs(dx * lamp.n.x + dy * lamp.n.y + dz * lamp.n.z);
    const float spread = finite ? (t2 < near2 ? 0.0f : cos_x * cos_o / t2) : 1.0f;
    const bool asks = (asks_[row + k] != 0) & (plane_[row + k] == g.plane);
    share[k] = asks & (cos > 0) ? spread * cos * many : 0.0f;
    far[k] = finite ? t * (1 - 1e-3f) : kInfinity;
    ray.org_x[k] = ox, ray.org_y[k] = oy, ray.org_z[k] = oz;
    ray.dir_x[k] = dx, ray.dir_y[k] = dy, ray.dir_z[k] = dz;
    ray.tnear[k] = 0, ray.tfar[k] = far[k], ray.time[k] = 0;
    ray.mask[k] = ~0u, ray.id[k] = 0, ray.flags[k] = 0;
    packet.valid[k] = share[k] > 0 ? -1 : 0;
    left += share[k] > 0;
  }
  if (left) left = keep_those_that_may_hit(packet);
  if (!left) return;
  occluded(objects.scene(), packet, false);
  traced_ += uint64_t(left);
  left = 0;
#pragma GCC ivdep
  for (int k = 0; k < kWidth; ++k) {
    share[k] = packet.valid[k] && ray.tfar[k] < 0 ? share[k] : 0.0f;
    left += share[k] > 0;
  }
  if (!left) return;
  if (set_hides_) {  // what the set itself keeps away cannot be taken
    for (int k = 0; k < kWidth; ++k) {
      packet.valid[k] = share[k] > 0 ? -1 : 0;
      ray.tfar[k] = far[k];
    }
    occluded(direct_->captured_.accel().scene(), packet, false);
    traced_ += uint64_t(left);
    for (int k = 0; k < kWidth; ++k) {
      if (packet.valid[k] && ray.tfar[k] < 0) share[k] = 0;
    }
  }
  Vec3 through[kWidth];  // of what objects let pass
  if (objects.transmits()) {
    for (int k = 0; k < kWidth; ++k) {
      if (!(share[k] > 0)) continue;
      through[k] = objects.transmittance(packet.origin(k), packet.direction(k), far[k]);
    }
  }
#pragma GCC ivdep
  for (int k = 0; k < kWidth; ++k) {
    const int at = row + k;
    const float r = share[k] * choice.flux.x * inverse_[0][at] * (1 - through[k].x);
    const float g = share[k] * choice.flux.y * inverse_[1][at] * (1 - through[k].y);
    const float b = share[k] * choice.flux.z * inverse_[2][at] * (1 - through[k].z);
    const bool counts = share[k] > 0;  // elsewhere 1 / E may be anything
    q_[0][at] -= counts ? r : 0.0f;
    q_[1][at] -= counts ? g : 0.0f;
    q_[2][at] -= counts ? b : 0.0f;
    const float brightness = (r + g + b) * (1.0f / 3);
    square_[at] += counts ? brightness * brightness : 0.0f;
  }
}

// Lights without size have no noise, so that one ray each is enough.
Vec3 Direct::Tile::delta_change(Vec3 x, Vec3 n, int at) {
  Sampler sampler(direct_->scene_.table_, random_index(at), uint32_t(direct_->passes_));
  Compositor::Path path{sampler};
  const Vec3 dE = direct_->scene_.delta_change(x + clearance(x, camera_) * n, n, path);
  traced_ += path.rays;
  return dE;
}

// The light that objects send to the set.
void Direct::Tile::light_set() {
  sent_.fill({}), sent_square_.fill(0), lit_.fill({});
  const World& objects = *direct_->scene_.objects_;
  const bool lights = !objects.delta_lights().empty();
  if (!looks() && !lights) return;
  ShadowRays shadows(*direct_);
  GatherRays near(*direct_, shadows, nullptr), gather(*direct_, shadows, &near);
  const uint32_t rays = looks() ? uint32_t(subsamples(Shows::inside)) : 0;
  for (int at = 0; at < kPixels; ++at) {
    if (!asks_[at]) continue;
    const Vec3 x{x_[at], y_[at], z_[at]}, n = direct_->normal_of(plane_[at]);
    if (lights) lit_[at] = delta_change(x, n, at);
    for (uint32_t k = 0; k < rays; ++k) {
      const float lamp = fraction(turn(at, 1, 0) + pass_turn_ + 0.618034f * float(k));
      look_at_objects(gather, x, n, at, uint32_t(direct_->passes_) * rays + k, lamp,
                      1 / float(rays), &sent_[at], &sent_square_[at]);
    }
  }
  gather.flush(), near.flush(), shadows.flush();
  traced_ += gather.traced + near.traced + shadows.traced;
}

// One ray towards the objects, the i-th of a pixel.
void Direct::Tile::look_at_objects(GatherRays& gather, Vec3 x, Vec3 n, int at, uint32_t i,
                                   float lamp, float weight, Vec3* sum, float* square) const {
  const Vec3 start = x + clearance(x, camera_) * n;
  const Cones cones(start, n, direct_->scene_.bounds_);
  if (cones.empty()) return;
  const Vec3 d = cones.sample(spread_at(i, turn(at, 0, 1), turn(at)));
  const float cos = dot(d, n);
  if (cos <= 0) return;
  const Pair v = spread_at(3 * i + 1, turn(at, 3, 0), turn(at, 2, 3));
  gather.push(start, d, {sum, square, Vec3(weight * cos / cones.density(d)), lamp, v, false,
                         set_hides_});
}

FilmTile* Direct::Tile::film() {
  Direct& d = *direct_;
  const size_t number = size_t(y0_ / kTile) * d.tiles_across() + x0_ / kTile;
  if (!d.touched_[number]) {
    bool anything = !samples_of_.empty();
    for (const Vec3& light : sent_) anything |= !is_zero(light);
    for (const Vec3& light : lit_) anything |= !is_zero(light);
    for (size_t k = 0; k < group_count_; ++k) anything |= !groups_[k].choices.empty();
    if (!anything) return nullptr;
    if (!d.film_[number]) d.film_[number] = std::make_unique<FilmTile>();
    *d.film_[number] = {};
    d.touched_[number] = 1;
    // earlier passes found nothing to change
    std::fill_n(d.film_[number]->set.share, FilmTile::kPixels, float(d.passes_));
  }
  return d.film_[number].get();
}

void Direct::Tile::add_set(FilmTile& film) {
  for (int k = 0; k < kPixels; ++k) {
    if (!asks_[k]) continue;
    const Group& g = group_of(plane_[k]);
    const int at = film_index(k);
    film.set.share[at] += 1;
    film.set.group[at] = float(plane_[k] + 1);
    const Vec3 inverse{inverse_[0][k], inverse_[1][k], inverse_[2][k]};
    Vec3 q = inverse * (sent_[k] + lit_[k]);
    const float sent = mean(inverse * sent_[k]), scale = mean(inverse);
    const float rays = float(subsamples(Shows::inside));
    film.set.variance[at] +=
        rays > 1 ? std::max(scale * scale * sent_square_[k] - sent * sent / rays, 0.0f) *
                       rays / (rays - 1)
                 : sent * sent;
    if (!g.choices.empty()) {
      const Asked asked = this->asked(g);
      const float n = float(asked.rays), all = 1 / (n * asked.part);
      const Vec3 hidden = Vec3(q_[0][k], q_[1][k], q_[2][k]) * all;
      q += hidden;
      const float m = mean(hidden), square = square_[k] * all / asked.part;
      // a single ray says 0 or all of it: its variance is bounded by what it may say
      film.set.variance[at] += asked.rays > 1
                                   ? std::max(square - m * m, 0.0f) / (n - 1)
                                   : 0.1f * g.potential * g.potential / asked.part;
      film.set.variance[at] += m * m * (1 - asked.part);  // others go without
    }
    film.set.r[at] += q.x, film.set.g[at] += q.y, film.set.b[at] += q.z;
    film.has_change |= !is_zero(q);
  }
}

// The first surface of each sample.
void Direct::Tile::trace_samples() {
  const Direct& d = *direct_;
  Packet packet;
  for (size_t first = 0; first < samples_of_.size(); first += kWidth) {
    const int count = int(std::min<size_t>(kWidth, samples_of_.size() - first));
    Sample* const s = &samples_of_[first];
    packet.clear();
    for (int k = 0; k < count; ++k) packet.set(k, camera_, s[k].d);
    intersect(d.scene_.objects_->scene(), packet, true);
    int left = 0;
    for (int k = 0; k < count; ++k) {
      if (packet.hits(k)) s[k].hit = packet.hit(k);
      packet.forget_hit(k);
      packet.valid[k] = positional_ && d.set_matters(packet, k) ? -1 : 0;
      left += packet.valid[k] != 0;
    }
    if (left) intersect(d.captured_.accel().scene(), packet, true);
    traced_ += uint64_t(count + left);
    for (int k = 0; k < count; ++k) {
      s[k].t = packet.rays.ray.tfar[k];
      if (packet.valid[k] && packet.hits(k)) {
        s[k].face = packet.rays.hit.primID[k];
        s[k].hit = {};
      }
    }
  }
}

// Which samples of a pixel are shaded: as many of those on objects, and of those on the set, as a
// pixel inside an object has. From a random one on, evenly, so that all are as likely.
void Direct::Tile::choose_samples() {
  shaded_.clear();
  const int most = subsamples(Shows::inside);
  for (size_t first = 0; first < samples_of_.size();) {
    const int at = samples_of_[first].at;
    size_t last = first;
    int count[2] = {};  // on the set, on objects
    for (; last < samples_of_.size() && samples_of_[last].at == at; ++last) {
      ++count[samples_of_[last].hit ? 1 : 0];
    }
    const float whole = 1 / float(subsamples(shows_[at]));
    const uint32_t some = random_index(at) * 2654435761u + uint32_t(direct_->passes_) * 40503u;
    for (int kind = 0; kind < 2; ++kind) {
      const int n = count[kind], of = std::min(n, most);
      int number = n > of ? int((some >> 8) % uint32_t(n)) : 0, rank = 0;
      for (size_t k = first; k < last; ++k) {
        Sample& s = samples_of_[k];
        if ((s.hit ? 1 : 0) != kind) continue;
        if (number * of % n < of) {
          s.rank = rank++, s.of = of;
          s.weight = whole * float(n) / float(of);
          shaded_.push_back(uint32_t(k));
        }
        number = (number + 1) % n;
      }
    }
    first = last;
  }
}

void Direct::Tile::shade_samples() {
  ShadowRays shadows(*direct_);
  GatherRays near(*direct_, shadows, nullptr), gather(*direct_, shadows, &near);
  for (const uint32_t k : shaded_) {
    Sample& s = samples_of_[k];
    if (s.hit && direct_->scene_.objects_->material(s.hit).transmits) look_through(s);
    s.on_object = bool(s.hit);
    if (s.on_object) {
      shade_object(s, shadows, gather);
    } else if (s.face != kNowhere && direct_->captured_.stand_in().surface[s.face] == 0) {
      shade_set(s, shadows, gather);
    }
  }
  gather.flush(), near.flush(), shadows.flush();
  traced_ += gather.traced + near.traced + shadows.traced;
}

// What is seen through panes.
void Direct::Tile::look_through(Sample& s) {
  Sampler sampler(direct_->scene_.table_, random_index(s.at), s.i);
  Compositor::Path path{sampler};
  const auto met = direct_->scene_.meet(camera_, s.d, s.share, path);
  traced_ += path.rays;
  s.hit = met.hit;
  s.t = met.hit ? met.hit.t : met.place.t;
  s.face = met.place ? met.place.face : kNowhere;
}

// Shadow rays to lamps, and one that looks for light by itself.
void Direct::Tile::shade_object(Sample& s, ShadowRays& shadows, GatherRays& gather) {
  const Direct& d = *direct_;
  const Surface surface = d.scene_.objects_->surface_at(s.hit, s.d);
  s.n = surface.ns;
  s.group = d.owner_of(s.hit.instance);
  const int rays = (kRays * samples_ + s.of - 1) / s.of;
  Sampler sampler(d.scene_.table_, random_index(s.at), s.i);
  Compositor::Path path{sampler};
  if (surface.model != Model::diffuse) {  // by paths: as many as there would be samples
    const int paths = (rays + 1) / kRays;
    for (int j = 0; j < paths; ++j) {
      Sampler another(d.scene_.table_, random_index(s.at), s.i * uint32_t(paths) + uint32_t(j));
      Compositor::Path one{another};
      s.other += s.share * d.scene_.object_radiance(s.hit, s.d, 0, one) * (1 / float(paths));
      traced_ += one.rays;
    }
    return;
  }
  s.factor = surface.alpha * s.share * surface.base;
  s.other = s.share * surface.emission;
  if (!d.scene_.objects_->delta_lights().empty()) {
    s.other += s.share * d.scene_.delta_light(surface, -s.d, path);
    traced_ += path.rays;
  }
  s.rays = rays;
  const Vec3 start = surface.p + surface.rise * surface.ng;
  const LightLists::List& list = d.list(s.group, LightLists::bin_of(s.n));
  const size_t m = list.size();
  const float shift = fraction(turn(s.at) + pass_turn_);
  for (int j = 0; m && j < rays; ++j) {
    const float u = (float(j * s.of + s.rank) + shift) / float(rays * s.of);
    const auto& c = list.choices[std::min(m - 1, size_t(u * float(m)))];
    const Lamp::Incident in = d.lights_.lamp(c.lamp).incident(start);
    const float cos = dot(in.d, s.n);
    if (cos <= 0 || in.share == 0 || dot(in.d, surface.ng) <= 0) continue;
    const Vec3 light = c.flux * (in.share * cos * float(m) / float(rays));
    const bool hides = set_hides_ || (positional_ && in.t == kInfinity && dot(in.d, above_) < 0);
    shadows.push(start, in.d, in.t * (1 - 1e-3f), {&s.value, &s.square, light, false, hides});
  }
  // what is near in the set, and what objects and set send each other
  if (!positional_ && !d.gathers()) return;
  const Pair u = spread_at(s.i, turn(s.at, 1, 0), turn(s.at, 0, 2));
  const Vec3 w = Frame(s.n).world(sample_cosine(u.x, u.y));
  if (dot(w, surface.ng) <= 0) return;
  const float lamp = fraction(shift + 0.618034f * float(s.rank) + 0.5f);
  const Pair v = spread_at(3 * s.i + 1, turn(s.at, 3, 0), turn(s.at, 2, 3));
  gather.push(start, w, {&s.value, &s.square, Vec3(kPi), lamp, v, true, false});
}

// The set beside an object.
void Direct::Tile::shade_set(Sample& s, ShadowRays& shadows, GatherRays& gather) {
  const Direct& d = *direct_;
  const Vec3 x = camera_ + s.t * s.d;
  const uint32_t plane = d.plane_at(s.face, s.d);
  const Group& g = group_of(plane);
  s.group = plane;
  s.factor = over(Vec3(1.0f), irradiance(s.face, x, plane));
  const float shift = fraction(turn(s.at) + pass_turn_);
  const size_t m = g.choices.size();
  s.rays = m ? (kRays * samples_ + s.of - 1) / s.of : 0;
  for (int j = 0; j < s.rays; ++j) {
    const float u = (float(j * s.of + s.rank) + shift) / float(s.rays * s.of);
    const auto& c = g.list->choices[g.choices[std::min(m - 1, size_t(u * float(m)))]];
    const Vec3 start = x + clearance(x, camera_) * g.normal;
    const Lamp::Incident in = d.lights_.lamp(c.lamp).incident(start);
    const float cos = dot(in.d, g.normal);
    if (cos <= 0 || in.share == 0) continue;
    const Vec3 light = c.flux * (in.share * cos * float(m) / float(s.rays));
    shadows.push(start, in.d, in.t * (1 - 1e-3f),
                 {&s.value, &s.square, light, true, set_hides_});
  }
  if (!d.scene_.objects_->delta_lights().empty()) s.other += delta_change(x, g.normal, s.at);
  if (!looks()) return;
  look_at_objects(gather, x, g.normal, s.at, s.i,
                  fraction(shift + 0.618034f * float(s.rank) + 0.25f), 1, &s.other, &s.square);
}

void Direct::Tile::add_samples(FilmTile& film) {
  on_set_.fill({}), on_object_.fill({});
  for (const Sample& s : samples_of_) {
    if (!(s.t < kInfinity)) continue;
    film.depth[film_index(s.at)] += s.t, film.depths[film_index(s.at)] += 1;
  }
  for (const uint32_t k : shaded_) {
    const Sample& s = samples_of_[k];
    const int at = film_index(s.at);
    const float w = s.weight;
    if (s.on_object) {
      const Vec3 albedo = (w / kPi) * s.factor, lit = albedo * s.value;
      FilmTile::Layer& objects = film.objects;
      film.has_objects = true;
      objects.share[at] += w;
      objects.r[at] += lit.x, objects.g[at] += lit.y, objects.b[at] += lit.z;
      objects.nx[at] += w * s.n.x, objects.ny[at] += w * s.n.y, objects.nz[at] += w * s.n.z;
      objects.group[at] = float(s.group + 1);
      film.albedo[0][at] += albedo.x, film.albedo[1][at] += albedo.y;
      film.albedo[2][at] += albedo.z;
      film.other[0][at] += w * s.other.x, film.other[1][at] += w * s.other.y;
      film.other[2][at] += w * s.other.z;
      on_object_[s.at].add(mean(s.value), s.square, s.rays);
    } else {
      // (1 + dE / E) of the plate's radiance, and of that what comes through panes
      const Vec3 change = s.factor * (s.value + s.other);
      const Vec3 q = s.share * (Vec3(1.0f) + change) - Vec3(1.0f);
      const bool support = s.group != kNowhere;
      if (!support && is_zero(q)) continue;
      film.set.share[at] += w;
      film.set.group[at] = support ? float(s.group + 1) : -1;
      film.has_change |= !is_zero(q);
      film.set.r[at] += w * q.x, film.set.g[at] += w * q.y, film.set.b[at] += w * q.z;
      const float f = mean(s.factor);
      on_set_[s.at].add(f * mean(s.value), f * f * s.square, s.rays);
    }
  }
  for (int k = 0; k < kPixels; ++k) {
    if (shows_[k] == Shows::set) continue;
    film.set.variance[film_index(k)] += on_set_[k].of_mean();
    film.objects.variance[film_index(k)] += on_object_[k].of_mean();
  }
}

}  // namespace chromeball
