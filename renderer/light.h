// What shines: a discrete distribution by inverse CDF, and the lat-long environment map.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "sampler.h"
#include "vec.h"

namespace chromeball {

// Picks i with probability weight[i] / sum. Inverting the CDF keeps the stratification of the
// samples over the order of the entries; a guide table makes it O(1) (Chen and Asau 1974).
class Distribution {
 public:
  explicit Distribution(std::span<const float> weight) : cdf_(weight.size() + 1) {
    for (size_t i = 0; i < weight.size(); ++i) cdf_[i + 1] = cdf_[i] + weight[i];
    sum_ = cdf_.back();
    if (!(sum_ > 0)) return;
    for (double& c : cdf_) c /= sum_;
    guide_.resize(weight.size() + 1);
    size_t i = 0;
    for (size_t g = 0; g < guide_.size(); ++g) {
      const double u = double(g) / double(weight.size());
      while (i + 1 < weight.size() && cdf_[i + 1] <= u) ++i;
      guide_[g] = uint32_t(i);
    }
  }

  double sum() const { return sum_; }
  bool empty() const { return !(sum_ > 0); }

  struct Pick {
    uint32_t index;
    float rest;  // what is left of the random number, uniform in 0..1
  };
  Pick sample(uint32_t bits) const {
    const double u = (bits + 0.5) * 0x1p-32;
    uint32_t i = guide_[size_t(u * double(guide_.size() - 1))];
    while (cdf_[i + 1] <= u) ++i;
    return {i, float((u - cdf_[i]) / (cdf_[i + 1] - cdf_[i]))};
  }

 private:
  std::vector<double> cdf_;
  std::vector<uint32_t> guide_;
  double sum_ = 0;
};

// A lat-long radiance map with OpenEXR's axes: centre +Z, image right -X, up +Y.
//
// Sampling is for use beside another strategy that covers all directions: its density is
// proportional to what exceeds the map's mean (MIS compensation, Karlik et al. 2019).
class Environment {
  friend class Peaks;

 public:
  struct Pixel {
    float u, v;  // texel centres at integers
  };
  // (h, w, 3) floats, row 0 is the zenith.
  Environment(const float* rgb, int h, int w);

  int height() const { return h_; }
  int width() const { return w_; }
  // Nothing stands out of the mean, so that there is nothing to sample by importance.
  bool even() const { return distribution_.empty(); }
  bool black() const { return power_.empty(); }

  Vec3 radiance(Vec3 d) const;  // bilinear; d of unit length
  float density(Vec3 d) const;  // of `sample`, 1/sr
  Vec3 texel_direction(uint32_t t) const;  // through its centre
  uint32_t texel_of(Vec3 d) const;

  struct Sample {
    Vec3 direction;
    float density;  // 1/sr, follows the bilinear map
    uint32_t texel;  // that the direction lies in
  };
  Sample sample(uint32_t bits, float v) const;
  // The same in proportion to the whole map, for use without another strategy.
  Sample sample_power(uint32_t bits, float v) const;

 private:
  // Bilinear weights around (u, v), texel centres at integers.
  struct Footprint {
    uint32_t texel[4];
    float weight[4];
  };
  Footprint footprint(float u, float v) const;
  Vec3 texel(uint32_t t) const { return Vec3(&rgb_[3 * size_t(t)]); }
  float solid_angle(int row) const {  // of a texel there
    return 2 * kPi / w_ * (std::cos(kPi * row / h_) - std::cos(kPi * (row + 1) / h_));
  }
  // A place by a tent around the texel's centre; the texel that it lies in.
  Pixel around(uint32_t texel, float u, float v) const;
  uint32_t texel_at(Pixel p) const;
  float density_at(const std::vector<float>& probability, float u, float v) const;
  Sample sample(const Distribution& distribution, const std::vector<float>& probability,
                uint32_t bits, float v) const;

  int h_, w_;
  std::vector<float> rgb_;
  std::vector<float> probability_;  // of each texel, by what exceeds the mean
  std::vector<float> whole_;        // of each texel, by its power
  std::vector<uint32_t> order_;  // texels along a Hilbert curve: near in order, near in space
  Distribution distribution_, power_;
};

// What stands out of a map: the part of each texel's radiance above a multiple of the mean. The
// rest never exceeds that multiple.
class Peaks {
 public:
  explicit Peaks(const Environment& environment);

  bool empty() const { return picks_.empty(); }
  double power() const { return picks_.sum(); }  // of all, the mean channel, over solid angle
  // The share of a radiance that counts as peak.
  float share(Vec3 L) const {
    const float bright = mean(L);
    return bright > level_ ? 1 - level_ / bright : 0;
  }
  Vec3 radiance(Vec3 d) const;  // of the peaks alone, bilinear

  struct Sample {
    Vec3 direction;
    float density;  // 1/sr
    uint32_t texel;
    Vec3 radiance;
  };
  Sample sample(Pair u) const;  // by power; not of an empty map

 private:
  static constexpr float kLevel = 4;
  struct Value {
    Vec3 radiance;
    float power = 0;
  };
  Value at(float u, float v) const;

  const Environment& environment_;
  float level_ = 0;
  std::vector<uint32_t> texels_;  // that stand out, along the map's Hilbert curve
  Distribution picks_{std::span<const float>()};
};

}  // namespace chromeball
