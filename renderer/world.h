// The synthetic scene: meshes that each have a BVH of their own, instances of them, materials
// and textures, and the surface at a hit.
#pragma once

#include <algorithm>
#include <array>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "bounds.h"
#include "delta_light.h"
#include "embree.h"
#include "light.h"
#include "surface/surface.h"

namespace chromeball {

// Views of arrays that the caller keeps alive; `material` numbers those of the world.
struct MeshView {
  std::span<const float> vertices;   // (V, 3)
  std::span<const float> normals;    // (V, 3), or empty: flat faces
  std::span<const float> uv;         // (V, 2), or empty
  std::span<const uint32_t> faces;   // (F, 3)
  std::span<const uint32_t> material;  // (F,)
};

// world = linear p + t
struct Affine {
  Mat3 linear;
  Vec3 t;
  Vec3 point(Vec3 p) const { return linear * p + t; }
};

class World {
 public:
  uint32_t add(const Texture& texture);
  uint32_t add(const Material& material);
  void add(const DeltaLight& light) { delta_lights_.push_back(light); }
  // Builds the mesh's BVH.
  uint32_t add(const MeshView& mesh);
  // `matrices`: 12 numbers each, the rows of [linear | t], not singular, at even times while the
  // shutter is open; one for what stands still. Between them each number runs linearly.
  uint32_t place(uint32_t mesh, const double* matrices, size_t steps = 1);
  // Once all is there.
  void commit();
  // A new place for an instance: the top level alone is built again.
  void move(uint32_t instance, const double* matrices, size_t steps = 1);

  size_t instances() const { return instances_.size(); }
  size_t triangles() const;
  bool empty() const { return instances_.empty(); }
  Sphere bound(uint32_t instance) const;  // around its bounding spheres
  // Whether any surface lets light straight through.
  bool transmits() const { return transmits_; }
  // Whether any instance moves while the shutter is open.
  bool moves() const {
    return std::ranges::any_of(instances_, [](const Instance& i) { return !i.steps.empty(); });
  }
  RTCScene scene() const { return top_.get(); }
  // Spheres around the parts of the instances, in the world.
  std::span<const Sphere> bounds() const { return bounds_; }

  // Those of instances that can throw caustics.
  std::span<const Sphere> sharp_bounds() const { return sharp_bounds_; }

  // `time`: of the shutter's opening, 0..1.
  Hit intersect(Vec3 o, Vec3 d, float tfar = kInfinity, float time = 0) const {
    return chromeball::intersect(top_.get(), o, d, tfar, time);
  }
  bool occluded(Vec3 o, Vec3 d, float tfar = kInfinity, float time = 0) const {
    return chromeball::occluded(top_.get(), o, d, tfar, time);
  }
  // The share of light that comes straight through from o + tfar d to o.
  Vec3 transmittance(Vec3 o, Vec3 d, float tfar = kInfinity, float time = 0) const;

  Surface surface_at(const Hit& hit, Vec3 d) const;
  const Material& material(const Hit& hit) const {
    return materials_[meshes_[instances_[hit.instance].mesh].view.material[hit.face]];
  }

  // A point on a face that shines, picked by power, for light sampling beside other strategies.
  struct Emitter {
    Vec3 p;
    Vec3 n;  // of the face, unit; it shines on both sides
    Vec3 radiance;
    float density;  // 1/m^2
    float rise;     // how far before the face a ray has to end
  };
  bool shines() const { return !emitters_.empty(); }
  double power() const { return emitters_.sum(); }  // radiance times area of all that shines
  Emitter sample_emitter(Pair u, float time = 0) const;
  float emitter_density(const Hit& hit) const {  // of that point, 1/m^2
    return material(hit).power * inverse_power_;
  }

  std::span<const DeltaLight> delta_lights() const { return delta_lights_; }

  // Values (V, 3) at the vertices of the only mesh, interpolated; for gathered light.
  Vec3 interpolate(const float* values, const Hit& hit) const;

 private:
  struct MeshData {
    MeshView view;
    Triangles triangles;
    SceneHandle scene;
    std::vector<Sphere> bounds;
    bool shines = false, sharp = false;
  };
  struct Instance {
    uint32_t mesh;
    GeometryHandle geometry;
    Affine to_world;  // while it stands still, or when the shutter opens
    Mat3 normal;   // inverse transpose, up to a positive factor
    Mat3 size;     // |linear|, for error bounds
    Mat3 spread;   // |linear| |linear^-1|
    Vec3 slack;    // |linear| |linear^-1 t| + |t|
    float scale;   // largest
    std::vector<Affine> steps;  // of what moves; the bounds above hold for all of them
  };
  // Where an instance is at a time.
  struct Moment {
    Affine to_world;
    Mat3 normal;
  };
  static Moment moment(const Instance& instance, float time);
  struct Face {
    uint32_t instance, face;
  };
  static void set(Instance& instance, const double* matrices, size_t steps);
  static void set_step(Instance& instance, const double* matrix, uint32_t step);
  void find_bounds();
  void find_emitters();

  Device device_;
  std::vector<Texture> textures_;
  std::vector<Material> materials_;
  std::vector<MeshData> meshes_;
  std::vector<Instance> instances_;
  std::vector<DeltaLight> delta_lights_;
  SceneHandle top_;
  std::vector<Sphere> bounds_, sharp_bounds_;
  bool transmits_ = false;
  std::vector<Face> emissive_;
  Distribution emitters_{std::span<const float>()};
  float inverse_power_ = 0;
};

}  // namespace chromeball
