// The filter over what few shadow rays found: a mean over neighbours on the same surface that
// differ by no more than their noise (after the non-local means of Buades, Coll and Morel 2005;
// means over small windows are compared, as in Rousselle, Manzi and Zwicker 2013).
//
// It sees the change of the set and the light on objects, never the photograph.
#pragma once

#include "vec.h"

namespace chromeball {

// A square of the picture: sums over the passes.
struct FilmTile {
  static constexpr int kSide = 16, kPixels = kSide * kSide;
  using Plane = float[kPixels];
  // One of the two layers. `variance` sums the variances of the passes' means; `share` is the
  // part of the pixel that shows the layer; normal and group (a surface's number) guide.
  struct Layer {
    alignas(64) Plane r, g, b, variance, share, nx, ny, nz, group;
  };
  Layer set;             // dE / E of the set
  Layer objects;         // diffuse radiance, times pi
  Plane albedo[3];       // diffuse
  Plane other[3];        // radiance of objects that is left alone
  Plane depth, depths;         // of samples, and how many these are
  bool has_change = false, has_objects = false;  // whether the layers hold anything but 0
};

class Filter {
 public:
  static constexpr int kTile = FilmTile::kSide;

  // Filters one layer of the middle one of 3 x 3 tiles, of which some may be null.
  void run(const FilmTile* const (&around)[9], bool objects, int passes, bool filter);
  Vec3 value(int at) const { return {out_[0][at], out_[1][at], out_[2][at]}; }
  float variance(int at) const { return out_[3][at]; }  // of the mean of the channels

 private:
  static constexpr int kReach = 4, kMeans = 2;  // half windows: of the filter, of the means
  static constexpr int kApron = kReach + kMeans, kSide = kTile + 2 * kApron;
  void load(const FilmTile* const (&around)[9], bool objects, int passes);
  void load(const FilmTile& tile, bool objects, int i, int count, int at, int passes);
  template <bool kGuided>
  void smooth(int passes);

  alignas(64) float v_[3][kSide * kSide], variance_[kSide * kSide], share_[kSide * kSide];
  alignas(64) float n_[3][kSide * kSide], group_[kSide * kSide];
  alignas(64) float mean_[kSide * kSide], noise_[kSide * kSide];
  alignas(64) float out_[4][kTile * kTile];
};

}  // namespace chromeball
