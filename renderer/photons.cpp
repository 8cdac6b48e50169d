#include "photons.h"

#include <bit>
#include <cmath>

namespace chromeball {
namespace {

// Photons of a bent or neighbouring surface do not count.
constexpr float kSameSide = 0.9f, kOffPlane = 0.2f;

int cell(float at, float size) {  // far cells meet in one: they only cost time
  return int(std::floor(std::clamp(at / size, -1e9f, 1e9f)));
}

}  // namespace

uint32_t Photons::slot(int x, int y, int z, uint32_t map) const {
  const uint32_t h = uint32_t(x) * 0x8da6b343u ^ uint32_t(y) * 0xd8163841u ^
                     uint32_t(z) * 0xcb1ab31fu;
  return map * (mask_ + 1) + ((h ^ (h >> 15)) & mask_);
}

Photons::Photons(std::vector<std::vector<Photon>> photons, std::vector<float> radius)
    : radius_(std::move(radius)) {
  size_t all = 0, most = 1;
  for (const auto& map : photons) all += map.size(), most = std::max(most, map.size());
  if (all == 0) return;
  mask_ = uint32_t(std::bit_ceil(most)) - 1;
  std::vector<uint32_t> slots;
  slots.reserve(all);
  starts_.resize(size_t(maps()) * (mask_ + 1) + 1);
  for (uint32_t k = 0; k < maps(); ++k) {
    const float size = 2 * radius_[k];
    for (const Photon& photon : photons[k]) {
      const Vec3 p = photon.p;
      slots.push_back(slot(cell(p.x, size), cell(p.y, size), cell(p.z, size), k));
      ++starts_[slots.back() + 1];
    }
  }
  for (size_t i = 1; i < starts_.size(); ++i) starts_[i] += starts_[i - 1];
  photons_.resize(all);
  std::vector<uint32_t> next(starts_.begin(), starts_.end() - 1);
  size_t i = 0;
  for (const auto& map : photons) {
    for (const Photon& photon : map) photons_[next[slots[i++]]++] = photon;
  }
}

Vec3 Photons::irradiance(Vec3 x, Vec3 n, uint32_t map) const {
  const float r = radius_[map], r2 = r * r;
  // the cells of size 2 r that a sphere of radius r about x touches: two along an axis
  const int i = cell(x.x - r, 2 * r), j = cell(x.y - r, 2 * r), k = cell(x.z - r, 2 * r);
  Vec3 sum;
  uint32_t seen[8];
  int count = 0;
  for (int c = 0; c < 8; ++c) {
    const uint32_t s = slot(i + (c & 1), j + ((c >> 1) & 1), k + (c >> 2), map);
    if (starts_[s] == starts_[s + 1]) continue;
    bool again = false;  // cells that share a slot
    for (int b = 0; b < count; ++b) again |= seen[b] == s;
    if (again) continue;
    seen[count++] = s;
    for (uint32_t at = starts_[s]; at < starts_[s + 1]; ++at) {
      const Photon& photon = photons_[at];
      const Vec3 to = photon.p - x;
      const float d2 = length2(to);
      if (d2 >= r2 || dot(photon.n, n) < kSameSide) continue;
      if (std::abs(dot(to, n)) > kOffPlane * r) continue;
      sum += (1 - d2 / r2) * photon.flux;
    }
  }
  return (2 / (kPi * r2)) * sum;  // the kernel's integral over a plane is 1
}

}  // namespace chromeball
