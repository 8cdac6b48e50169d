// Direct light, fast: packets of rays, shadow rays only to lamps that an object may hide, and a
// filter over what they find that never touches the photograph.
//
// A pixel of the set keeps its bits where no lamp of its tile can be hidden. Elsewhere
// Q = 1 - blocked / E. An object's surface adds up the lamps that it sees.
#pragma once

#include <mutex>
#include <vector>

#include "composite.h"
#include "filter.h"
#include "light_list.h"
#include "packet.h"

namespace chromeball {

class Direct {
 public:
  Direct(const Compositor& scene, uint64_t seed);

  // To be called where objects were moved or exchanged, before `begin`.
  void objects_moved();
  // Starts over, for a picture of that size.
  void begin(int height, int width);
  // Adds `samples` to each pixel: as many shadow rays where the set may lie in shadow, as many
  // sub-samples of two shadow rays where a pixel meets an object. Returns rays traced.
  uint64_t pass(const PixelRays& rays, Vec3 camera, int samples);
  // The composite (H, W, 3) of all passes. `layers` (H, W, kLayers), where wanted, gets the mean
  // of each pixel: objects 3, alpha 1, Q 3, standard error of the brightness 1, depth 1, and
  // (Q - 1) times the set's share of the pixel 3.
  static constexpr int kLayers = 12;
  // Returns how many pixels would be negative, which are cut at 0.
  size_t resolve(const PixelRays& rays, Vec3 camera, const float* plate, bool difference,
                 bool filter, float* rgb, float* layers) const;

  int passes() const { return passes_; }

 private:
  static constexpr int kTile = FilmTile::kSide;
  static constexpr int kPassesOfLamps = 8;  // then others are drawn
  static constexpr size_t kMostOwners = 32;  // of lists; more objects share theirs
  static constexpr uint32_t kFloorLamps = 2048, kObjectLamps = 1024;

  uint32_t owner_of(uint32_t instance) const;
  class Tile;
  struct ShadowRays;
  struct GatherRays;
  uint32_t plane_at(uint32_t face, Vec3 d) const;
  Vec3 normal_of(uint32_t plane) const;
  uint32_t set_lists() const { return uint32_t(owners_.size()) - 1; }
  bool gathers() const { return bounces_ || scene_.objects_->shines(); }  // objects light the set
  bool set_matters(const Packet& packet, int lane) const;

  // The choices that an object may hide from somewhere in the sphere, in their order.
  void find_hidable(const LightLists::List& list, Vec3 centre, float radius,
                    std::vector<uint32_t>& found) const;
  void draw_lamps(int epoch);
  void forget_lists();
  const LightLists::List& list(uint32_t owner, uint32_t bin) const;
  bool sees_objects(const PixelRays& rays, Vec3 camera, int x0, int x1, int y0, int y1) const;
  int tiles_across() const { return (width_ + kTile - 1) / kTile; }
  int tiles_down() const { return (height_ + kTile - 1) / kTile; }
  uint64_t find_surfaces(const PixelRays& rays, Vec3 camera, Pair at, int x0, int y0);
  Pair middle() const;

  const Compositor& scene_;
  const Captured& captured_;
  LightLists lights_;
  bool bounces_;   // whether objects and set light each other, once
  int epoch_ = 0;  // how many times the lamps were drawn anew
  std::vector<Sphere> owners_;  // of lists: an object each; the last holds them all, for the set
  struct LazyList {
    std::once_flag once;
    LightLists::List list;
  };
  mutable std::unique_ptr<LazyList[]> lists_;  // an owner's bins side by side, exact planes last
  std::vector<uint32_t> plane_of_;             // of each stand-in face: its bin among the lists
  std::vector<Vec3> plane_normal_;

  int height_ = 0, width_ = 0, passes_ = 0;
  uint64_t seed_;
  std::vector<float> distance_;   // of the stand-in through the pixel's middle, this pass
  std::vector<uint32_t> face_;
  // Which object was first met in a pixel, 0: none so far; large numbers wrap. What one pass finds
  // must not choose how that pass samples: pixels seen from the object's side would count more.
  std::vector<uint8_t> object_;
  std::vector<float> object_distance_;
  std::vector<std::unique_ptr<FilmTile>> film_;
  std::vector<uint8_t> touched_;  // of each tile, over all passes: its film counts
};

}  // namespace chromeball
