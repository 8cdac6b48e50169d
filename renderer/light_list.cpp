#include "light_list.h"

namespace chromeball {

LightLists::LightLists(const Captured& captured, uint64_t seed)
    : lamps_(captured.lamps(kLamps, seed)) {}

uint32_t LightLists::bin_of(Vec3 n) {
  const float ax = std::abs(n.x), ay = std::abs(n.y), az = std::abs(n.z);
  int face;
  float u, v, major;
  if (ay >= ax && ay >= az) {
    face = n.y < 0, u = n.x, v = n.z, major = ay;
  } else if (ax >= az) {
    face = 2 + (n.x < 0), u = n.y, v = n.z, major = ax;
  } else {
    face = 4 + (n.z < 0), u = n.x, v = n.y, major = az;
  }
  const auto cell = [&](float a) {
    return std::min(kGrid - 1, int((a / major + 1) * (0.5f * kGrid)));
  };
  return uint32_t((face * kGrid + cell(v)) * kGrid + cell(u));
}

Vec3 LightLists::middle_of(uint32_t bin) {
  const float u = (float(bin % kGrid) + 0.5f) * (2.0f / kGrid) - 1;
  const float v = (float(bin / kGrid % kGrid) + 0.5f) * (2.0f / kGrid) - 1;
  const uint32_t face = bin / (kGrid * kGrid);
  const float sign = face & 1 ? -1.0f : 1.0f;
  const Vec3 n = face < 2 ? Vec3(u, sign, v) : face < 4 ? Vec3(sign, u, v) : Vec3(u, v, sign);
  return normalize(n);
}

LightLists::List LightLists::draw(Vec3 x, float radius, Vec3 n, float slack, uint32_t count,
                                  float u) const {
  List list;
  std::vector<float> power(lamps_.size());
  double sum = 0;
  for (size_t k = 0; k < lamps_.size(); ++k) {
    const Lamp& lamp = lamps_[k];
    Vec3 d = lamp.place;
    float share = 1, aside = 0;
    if (lamp.finite) {
      const Vec3 to = lamp.place - x;
      const float nearest = Lamp::kNear * lamp.distance;
      const float x2 = std::max(length2(to), nearest * nearest), t = std::sqrt(x2);
      d = to * (1 / t);
      aside = radius / t;  // seen from elsewhere in the sphere it may stand higher
      share = lamp.spread(std::min(1.0f, std::abs(dot(d, lamp.n)) + 0.05f), x2);
    }
    power[k] = mean(lamp.flux) * share * std::max(0.0f, dot(d, n) + slack + aside);
    sum += power[k];
  }
  if (!(sum > 0)) return list;
  // systematic: the i-th choice is where the running sum passes i + u
  const double step = sum / count;
  double next = u * step, running = 0;
  list.choices.reserve(count);
  for (uint32_t k = 0; k < power.size(); ++k) {
    running += power[k];
    while (next < running && list.choices.size() < count) {
      const Lamp& lamp = lamps_[k];
      list.choices.push_back({float(step / power[k]) * lamp.flux, k});
      list.x.push_back(lamp.place.x), list.y.push_back(lamp.place.y);
      list.z.push_back(lamp.place.z), list.finite.push_back(lamp.finite);
      next += step;
    }
  }
  return list;
}

}  // namespace chromeball
