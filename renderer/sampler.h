// Low-discrepancy numbers: Owen-scrambled Sobol pairs, padded over the dimensions of a path.
#pragma once

#include <cstdint>
#include <vector>

namespace chromeball {

inline uint64_t mix64(uint64_t x) {  // splitmix64 (Steele et al. 2014)
  x ^= x >> 30, x *= 0xbf58476d1ce4e5b9u;
  x ^= x >> 27, x *= 0x94d049bb133111ebu;
  return x ^ (x >> 31);
}

inline uint32_t reverse_bits(uint32_t x) {
  x = __builtin_bswap32(x);
  x = ((x & 0x0f0f0f0fu) << 4) | ((x >> 4) & 0x0f0f0f0fu);
  x = ((x & 0x33333333u) << 2) | ((x >> 2) & 0x33333333u);
  return ((x & 0x55555555u) << 1) | ((x >> 1) & 0x55555555u);
}

// The first two Sobol dimensions: bit reversal, and the Pascal matrix mod 2 by its factors.
inline uint32_t sobol0(uint32_t i) { return reverse_bits(i); }
inline uint32_t sobol1(uint32_t i) {
  i ^= (i & 0xffff0000u) >> 16;
  i ^= (i & 0xff00ff00u) >> 8;
  i ^= (i & 0xf0f0f0f0u) >> 4;
  i ^= (i & 0xccccccccu) >> 2;
  i ^= (i & 0xaaaaaaaau) >> 1;
  return reverse_bits(i);
}

// Owen's nested uniform scrambling by a hash that only carries upwards (Laine and Karras 2011,
// constants of Burley 2020).
inline uint32_t owen(uint32_t x, uint32_t seed) {
  x = reverse_bits(x);
  x += seed;
  x ^= x * 0x6c50b47cu;
  x ^= x * 0xb82f1e52u;
  x ^= x * 0xc7afe638u;
  x ^= x * 0x8d22f6e6u;
  return reverse_bits(x);
}

struct Pair {
  float x, y;
  uint32_t bits;  // all of x, for fine distributions
};

// One scrambled set of 2^k pairs for each of the first dimensions; pixels reuse it under their
// own random digit shift and order, which keeps each pair of dimensions a (0, 2)-net.
class SampleTable {
 public:
  static constexpr uint32_t kPairs = 24;
  static constexpr uint32_t kMost = 1024;

  SampleTable(uint32_t samples, uint64_t seed) {
    while (size_ < samples && size_ < kMost) size_ *= 2;
    values_.resize(size_t(kPairs) * size_ * 2);
    for (uint32_t k = 0; k < kPairs; ++k) {
      const uint64_t a = mix64(seed * 0x9e3779b97f4a7c15u + 2 * k + 1);
      const uint64_t b = mix64(a);
      for (uint32_t i = 0; i < size_; ++i) {
        const uint32_t shuffled = owen(i, uint32_t(b)) & (size_ - 1);
        values_[2 * (size_t(k) * size_ + i)] = owen(sobol0(shuffled), uint32_t(a));
        values_[2 * (size_t(k) * size_ + i) + 1] = owen(sobol1(shuffled), uint32_t(a >> 32));
      }
    }
  }
  uint32_t size() const { return size_; }
  const uint32_t* pair(uint32_t k, uint32_t i) const {
    return &values_[2 * (size_t(k) * size_ + i)];
  }

 private:
  uint32_t size_ = 1;
  std::vector<uint32_t> values_;
};

// The numbers of one path: sample `i` of the stream `seed` (pixel and render seed).
class Sampler {
 public:
  Sampler(const SampleTable& table, uint64_t seed, uint32_t i)
      : table_(table), i_(i & (table.size() - 1)) {
    seed_ = mix64(seed + 0x632be59bd9b4e019u * (1 + i / table.size()));
    late_ = uint64_t(i_) << 32;
  }
  Pair pair() {
    const uint32_t k = k_++;
    uint64_t h = mix64(seed_ + k * 0x9e3779b97f4a7c15u);
    uint32_t x, y;
    if (k < SampleTable::kPairs) {
      const uint32_t order = uint32_t((h * 0xd1342543de82ef95u) >> 40);
      const uint32_t* p = table_.pair(k, (i_ ^ order) & (table_.size() - 1));
      x = p[0] ^ uint32_t(h), y = p[1] ^ uint32_t(h >> 32);
    } else {  // deep in a path stratification has nothing left to give
      h = mix64(h + late_ + 1);
      x = uint32_t(h), y = uint32_t(h >> 32);
    }
    return {to_unit(x), to_unit(y), x};
  }

 private:
  static float to_unit(uint32_t x) { return float(x >> 8) * 0x1p-24f; }

  const SampleTable& table_;
  uint64_t seed_, late_;
  uint32_t i_, k_ = 0;
};

}  // namespace chromeball
