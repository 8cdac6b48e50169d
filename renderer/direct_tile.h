// One tile of the picture in one pass of the direct integrator.
#pragma once

#include <array>

#include "direct_rays.h"

namespace chromeball {

// A thread keeps one and takes it from tile to tile: its memory stays.
//
// Pixels are numbered so that 16 in a row lie four apart, in both directions: these ask the same
// lamps, so that their shadow rays run side by side.
class Direct::Tile {
 public:
  // Adds `samples` to the pixels from (x0, y0) on; returns rays traced.
  uint64_t shade(Direct& direct, const PixelRays& rays, Vec3 camera, int samples, int x0, int y0);

 private:
  static constexpr int kWidth = Packet::kWidth, kPixels = FilmTile::kPixels;
  using Plane = std::array<float, kPixels>;

  struct Pixel {
    int x, y;
  };
  static Pixel offset(int at);  // of a pixel from the tile's corner
  Pixel pixel(int at) const { return {x0_ + offset(at).x, y0_ + offset(at).y}; }
  static int film_index(int at) { return offset(at).y * kTile + offset(at).x; }
  bool is_inside(Pixel p) const { return p.x < direct_->width_ && p.y < direct_->height_; }
  size_t index(Pixel p) const { return size_t(p.y) * direct_->width_ + p.x; }
  uint32_t random_index(int at) const { return uint32_t(direct_->seed_ + index(pixel(at))); }

  // Points of the set on one plane.
  struct Group {
    uint32_t plane;
    Vec3 normal, centre;
    float radius;
    const LightLists::List* list;
    std::vector<uint32_t> choices;  // lamps that an object may hide from here
    float potential = 0;            // about the part of E that they make up
  };
  Group& group_of(uint32_t plane);

  // A ray through a pixel that shows, or neighbours, an object.
  struct Sample {
    int at;
    Vec3 d;
    uint32_t i;          // its number in the pixel's sequence
    int rank = 0;        // among those of its kind that are shaded
    int of = 1;          // how many these are
    float weight = 0;    // its part of the pixel; 0: it only told what the pixel shows
    Hit hit;             // of an object
    uint32_t face = kNowhere;  // of the set
    float t = kInfinity;
    Vec3 share{1, 1, 1};  // of what is seen that comes through panes in front
    bool on_object = false;
    uint32_t group = kNowhere;  // of lists, or the plane of the set
    Vec3 n{};
    Vec3 factor{};       // albedo of the object; 1 / E of the set
    Vec3 value{};        // irradiance of the object; dE of the set
    float square = 0;    // of what each ray says, summed
    int rays = 0;
    Vec3 other{};        // radiance of the object; dE of the set
  };
  struct Moments {  // of a pixel's samples and their rays
    float sum = 0, square = 0;
    int samples = 0, rays = 0;
    void add(float value, float squares, int count) {
      sum += value, square += squares, ++samples, rays += count;
    }
    float of_mean() const {  // variance of the mean; of a single ray nothing is known
      if (rays == 0) return 0;
      const float n = float(rays), per_sample = 1 / float(samples), m = sum * per_sample;
      if (rays == 1) return 0.5f * m * m;
      return std::max(square * per_sample * per_sample - m * m / n, 0.0f) * n / (n - 1);
    }
  };
  enum class Shows : uint8_t { set, inside, edge };
  // Sub-samples of a pixel: inside objects few, each with many shadow rays; along edges many tell
  // how much of the pixel is what, and few of them are shaded.
  int subsamples(Shows shows) const {
    return shows == Shows::edge ? std::max(8 * std::min(samples_, 2), samples_) : (samples_ + 1) / 2;
  }

  void look_at_pixels();
  void find_hidable_lamps();
  FilmTile* film();  // none: nothing in this tile has ever been changed

  // The set, through the middles of pixels that are far from objects.
  struct Asked {  // how many shadow rays a pixel of a group has, and the part of pixels that ask
    int rays;
    float part;
  };
  Asked asked(const Group& g) const;
  void find_irradiance();
  void shadow_set();
  void shadow_row(const Group& g, int row);
  void shadow_row(const Group& g, int row, const LightLists::Choice& choice);
  int keep_those_that_may_hit(Packet& packet) const;
  void light_set();
  void add_set(FilmTile& film);

  // Samples where objects are.
  void trace_samples();
  void choose_samples();
  void shade_samples();
  // Whether pixels of the set send rays to the objects: for their light, or for what they hide.
  bool looks() const { return direct_->gathers() || set_hides_; }
  void look_through(Sample& s);
  void shade_object(Sample& s, ShadowRays& shadows, GatherRays& gather);
  void shade_set(Sample& s, ShadowRays& shadows, GatherRays& gather);
  void add_samples(FilmTile& film);

  Vec3 irradiance(uint32_t face, Vec3 x, uint32_t plane) const;
  void look_at_objects(GatherRays& gather, Vec3 x, Vec3 n, int at, uint32_t i, float lamp,
                       float weight, Vec3* sum, float* square) const;
  Vec3 delta_change(Vec3 x, Vec3 n, int at);
  float turn(int at, int across = 0, int down = 0) const;
  Pair spread_at(uint32_t i, float x, float y) const;

  Direct* direct_ = nullptr;
  const PixelRays* rays_ = nullptr;
  Vec3 camera_;
  int samples_ = 0, x0_ = 0, y0_ = 0;
  uint64_t traced_ = 0;
  Pair start_{};  // of sequences: another for each seed
  float pass_turn_ = 0;
  bool positional_ = false;
  bool set_hides_ = false;  // the set may keep light from what is above it
  Vec3 above_;              // of a flat set: its normal, towards the camera

  std::vector<Group> groups_;
  size_t group_count_ = 0;  // in use: the others' memory is kept

  std::array<Shows, kPixels> shows_;
  std::array<uint32_t, kPixels> plane_;  // of the set at a pixel's middle
  std::array<uint8_t, kPixels> asks_;    // the pixel shows nothing but the set
  Plane x_, y_, z_;                      // of that middle
  Plane inverse_[3];                     // 1 / E
  Plane q_[3], square_;                  // - blocked / E, and the squares of what each ray says
  std::array<Vec3, kPixels> sent_;       // light by objects
  Plane sent_square_;
  std::array<Vec3, kPixels> lit_;        // change of what lights without size give
  std::vector<Sample> samples_of_;
  std::array<Moments, kPixels> on_set_, on_object_;
  std::vector<uint32_t> shaded_;
};

}  // namespace chromeball
