// The photograph as a texture of the set: what it shows at a place (seeds F12).
#pragma once

#include <vector>

#include "camera.h"

namespace chromeball {

class Plate {
 public:
  // Views of the camera's rays and of pixels (H, W, 3), which the caller keeps alive.
  Plate(const PixelRays& rays, Vec3 eye, const float* rgb);

  Vec3 eye() const { return eye_; }
  struct Seen {
    Vec3 radiance;
    float weight = 0;  // 0..1: 0 outside the picture, rising over a few pixels from its border
  };
  // In direction d, unit, from the eye; bilinear.
  Seen at(Vec3 d) const;

 private:
  static constexpr int kStarts = 32;    // of each side of the octahedral map of directions
  static constexpr int kCoarse = 16;    // pixels between directions that are tried there
  static constexpr float kFeather = 4;  // pixels

  struct Position {
    float x, y;  // corners at integers
  };
  Vec3 corner(int y, int x) const {
    return Vec3(rays_.corner + 3 * (size_t(y) * (rays_.width + 1) + x));
  }
  Vec3 pixel(int y, int x) const { return Vec3(rgb_ + 3 * (size_t(y) * rays_.width + x)); }
  bool find(Vec3 d, Position& at) const;

  PixelRays rays_;
  Vec3 eye_;
  const float* rgb_;
  std::vector<Position> starts_;
};

}  // namespace chromeball
