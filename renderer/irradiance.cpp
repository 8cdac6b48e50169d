#include "irradiance.h"

#include <map>
#include <tuple>

namespace chromeball {

Irradiance::Irradiance(const Captured& captured, uint64_t seed)
    : captured_(captured), table_(kSamples, seed ^ 0x49727261u) {
  const StandIn& stand_in = captured.stand_in();
  Vec3 least(kInfinity), most(-kInfinity);
  for (size_t i = 0; i < stand_in.vertices.size(); i += 3) {
    const Vec3 p(&stand_in.vertices[i]);
    least = {std::min(least.x, p.x), std::min(least.y, p.y), std::min(least.z, p.z)};
    most = {std::max(most.x, p.x), std::max(most.y, p.y), std::max(most.z, p.z)};
  }
  const Vec3 middle = 0.5f * least + 0.5f * most;
  const float extent = stand_in.vertices.empty() ? 1 : std::max(length(most - least), 1e-30f);
  // faces of one plane share a lattice: rounded normal and offset
  std::map<std::tuple<long, long, long, long>, uint32_t> known;
  std::vector<std::vector<uint32_t>> members;
  group_.resize(stand_in.size());
  for (uint32_t f = 0; f < stand_in.size(); ++f) {
    if (stand_in.surface[f] != 0) continue;
    const Vec3 a = stand_in.corner(f, 0);
    const Vec3 n = stand_in.normal(f);
    const float offset = dot(n, a - middle) / extent;
    const auto key = std::tuple(std::lround(n.x * 1e3f), std::lround(n.y * 1e3f),
                                std::lround(n.z * 1e3f), std::lround(offset * 4e3f));
    const auto [entry, fresh] = known.try_emplace(key, uint32_t(normals_.size()));
    if (fresh) normals_.push_back(n), members.emplace_back();
    group_[f] = entry->second;
    members[entry->second].push_back(f);
  }
  // many small planes (a scanned surface) need no lattice as fine as one large floor
  const float finest = members.empty() ? 0 : extent / (2 * kCells);
  for (size_t g = 0; g < members.size(); ++g) {
    const Frame frame(normals_[g]);
    float low[2] = {kInfinity, kInfinity}, high[2] = {-kInfinity, -kInfinity};
    for (const uint32_t f : members[g]) {
      for (int k = 0; k < 3; ++k) {
        const Vec3 p = stand_in.corner(f, k);
        const float at[2] = {dot(p, frame.s), dot(p, frame.t)};
        for (int axis : {0, 1}) {
          low[axis] = std::min(low[axis], at[axis]);
          high[axis] = std::max(high[axis], at[axis]);
        }
      }
    }
    const float a = high[0] - low[0], b = high[1] - low[1];
    // over one plane and nothing else the light is infinitely far, the irradiance even
    const int cells = members[g].size() == stand_in.size() ? 1 : kCells;
    const float step = std::max({std::hypot(a, b) / cells, finest, 1e-6f * extent});
    const float offset = dot(stand_in.corner(members[g][0], 0), frame.n);
    for (const float side : {1.0f, -1.0f}) {
      Lattice lattice;
      lattice.corner = low[0] * frame.s + low[1] * frame.t + offset * frame.n;
      lattice.s = frame.s, lattice.t = frame.t, lattice.n = side * frame.n;
      lattice.step = step;
      lattice.rise = 8 * kLift * (largest_magnitude(middle) + extent);
      lattice.width = int(a / step) + 2, lattice.height = int(b / step) + 2;
      const size_t count = size_t(lattice.width) * lattice.height;
      lattice.nodes = std::make_unique<Node[]>(count);
      lattice.cells = std::make_unique<std::atomic<uint8_t>[]>(count);
      lattice.finer = std::make_unique<tbb::concurrent_unordered_map<uint64_t, Vec3>>();
      lattices_.push_back(std::move(lattice));
    }
  }
}

Vec3 Irradiance::solve(Vec3 x, Vec3 n) const {
  const Frame frame(n);
  Vec3 sum;
  for (uint32_t i = 0; i < kSamples; ++i) {
    Sampler sampler(table_, 0, i);
    if (const auto light = captured_.sample(x, sampler.pair())) {
      const float cos = dot(light.d, n);
      if (cos > 0) {
        const Place place = captured_.trace(x, light.d);
        if (Captured::reaches(light, place)) {
          sum += (cos / (light.density + cos / kPi)) * captured_.radiance(place, light.d);
        }
      }
    }
    const Pair u = sampler.pair();
    const Vec3 local = sample_cosine(u.x, u.y), d = frame.world(local);
    const float cos = std::max(local.z, 1e-6f);
    const Place place = captured_.trace(x, d);
    sum += (cos / (captured_.density(x, d, place) + cos / kPi)) * captured_.radiance(place, d);
  }
  return sum * (1.0f / kSamples);
}

Vec3 Irradiance::node(const Lattice& lattice, int i, int j) const {
  Node& node = lattice.nodes[size_t(j) * lattice.width + i];
  // 0 unsolved, 1 being written, 2 ready; a thread that comes second solves for itself
  if (node.ready.load(std::memory_order_acquire) == 2) return node.value;
  const Vec3 value = solve(lattice.node_place(i, j), lattice.n);
  uint8_t unsolved = 0;
  if (node.ready.compare_exchange_strong(unsolved, 1)) {
    node.value = value;
    node.ready.store(2, std::memory_order_release);
  }
  return value;
}

Vec3 Irradiance::finer_node(const Lattice& lattice, int i, int j, int level) const {
  if (level == 0) return node(lattice, i, j);
  const uint64_t key = uint64_t(level) << 60 | uint64_t(j) << 30 | uint64_t(i);
  if (const auto known = lattice.finer->find(key); known != lattice.finer->end()) {
    return known->second;
  }
  const Vec3 value = solve(lattice.node_place(i, j, level), lattice.n);
  lattice.finer->emplace(key, value);
  return value;
}

// Whether the four nodes of a cell see each other.
bool Irradiance::is_open(const Lattice& lattice, int i, int j) const {
  std::atomic<uint8_t>& cell = lattice.cells[size_t(j) * lattice.width + i];
  uint8_t state = cell.load(std::memory_order_relaxed);
  if (state == 0) {
    state = 1;
    for (int a = 0; a < 4; ++a) {
      for (int b = a + 1; b < 4; ++b) {
        const Vec3 p = lattice.node_place(i + (a & 1), j + (a >> 1));
        const Vec3 q = lattice.node_place(i + (b & 1), j + (b >> 1));
        if (captured_.blocked(p, q - p, 1)) state = 2;
      }
    }
    cell.store(state, std::memory_order_relaxed);
  }
  return state == 1;
}

Vec3 Irradiance::at(const Place& place) const {
  const uint32_t g = group_[place.face];
  const Lattice& lattice = lattices_[2 * g + (dot(place.n, normals_[g]) < 0)];
  const Vec3 from = place.p - lattice.corner, x = place.start();
  const float u = dot(from, lattice.s) / lattice.step, v = dot(from, lattice.t) / lattice.step;
  // in a cell that is cut, a node behind the wall or inside a box has no say
  const bool open = is_open(lattice, std::clamp(int(u), 0, lattice.width - 2),
                            std::clamp(int(v), 0, lattice.height - 2));
  for (int level = 0;; ++level) {
    const float fine = std::ldexp(1.0f, level);
    const int i = std::clamp(int(u * fine), 0, ((lattice.width - 1) << level) - 1);
    const int j = std::clamp(int(v * fine), 0, ((lattice.height - 1) << level) - 1);
    const float a = std::clamp(u * fine - i, 0.0f, 1.0f);
    const float b = std::clamp(v * fine - j, 0.0f, 1.0f);
    Vec3 sum;
    float weights = 0, least = kInfinity, most = 0;
    for (int k = 0; k < 4; ++k) {
      const int di = i + (k & 1), dj = j + (k >> 1);
      const float weight = (k & 1 ? a : 1 - a) * (k >> 1 ? b : 1 - b);
      if (!open && captured_.blocked(x, lattice.node_place(di, dj, level) - x, 1)) continue;
      const Vec3 value = finer_node(lattice, di, dj, level);
      sum += weight * value;
      weights += weight;
      least = std::min(least, mean(value)), most = std::max(most, mean(value));
    }
    if (most > kSmooth * least && level < kLevels) continue;
    return weights > 0 ? sum * (1 / weights) : solve(x, place.n);
  }
}

}  // namespace chromeball
