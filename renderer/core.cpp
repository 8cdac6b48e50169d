// The Python face of the C++ core: arrays in, arrays out, the GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tbb/parallel_for.h>

#include <deque>

#include "composite.h"
#include "direct.h"
#include "path.h"
#include "world.h"

namespace nb = nanobind;
using namespace chromeball;

namespace {

using In3f = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using In3u = nb::ndarray<const uint32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using In2f = nb::ndarray<const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using In1u = nb::ndarray<const uint32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Matrices = nb::ndarray<const double, nb::shape<-1, 3, 4>, nb::c_contig, nb::device::cpu>;
using In1f = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using In1b = nb::ndarray<const uint8_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Picture = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Pixels = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<const uint16_t, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using InOut = nb::ndarray<float, nb::shape<-1, -1, Film::kCount>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, float, nb::ndim<3>>;

template <typename Array>
auto view(const Array& a) {
  return std::span(a.data(), a.size());
}

// A float32 picture that Python will own.
struct NewPicture {
  size_t height, width, channels;
  float* data;
  NewPicture(size_t h, size_t w, size_t c)
      : height(h), width(w), channels(c), data(new float[h * w * c]()) {}
  Out release() {
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<float*>(p); });
    return Out(data, {height, width, channels}, owner);
  }
};

void check_faces(const In3u& faces, size_t vertices) {
  for (const uint32_t i : view(faces)) {
    if (i >= vertices) throw nb::value_error("face index out of range");
  }
}

// A world and the arrays that it looks at; indices are checked by the Python side.
class WorldArrays {
 public:
  World world;

  uint32_t add_texture(Pixels pixels, std::array<uint8_t, 2> wrap) {
    pixels_.push_back(pixels);
    return world.add(Texture{view(pixels), int(pixels.shape(0)), int(pixels.shape(1)),
                             int(pixels.shape(2)), {Wrap(wrap[0]), Wrap(wrap[1])}});
  }
  uint32_t add_mesh(In3f vertices, std::optional<In3f> normals, std::optional<In2f> uv,
                    In3u faces, In1u material) {
    const size_t v = vertices.shape(0);
    if ((normals && normals->shape(0) != v) || (uv && uv->shape(0) != v) ||
        material.shape(0) != faces.shape(0)) {
      throw nb::value_error("arrays of one mesh differ in length");
    }
    check_faces(faces, v);
    meshes_.push_back({normals, uv, material});
    const nb::gil_scoped_release release;
    return world.add(MeshView{view(vertices),
                              normals ? view(*normals) : std::span<const float>(),
                              uv ? view(*uv) : std::span<const float>(), view(faces),
                              view(material)});
  }

 private:
  struct MeshArrays {
    std::optional<In3f> normals;
    std::optional<In2f> uv;
    In1u material;
  };
  std::vector<Pixels> pixels_;
  std::vector<MeshArrays> meshes_;
};

struct StandInArrays {
  In3f vertices, original;
  In3u faces;
  In1b surface;

  StandIn stand_in() const {
    return {view(vertices), view(original), view(faces), view(surface)};
  }
};

// The compositor with all that it looks at.
class CompositorArrays {
 public:
  CompositorArrays(nb::object objects, StandInArrays stand_in, Picture environment,
                   std::array<float, 3> origin, int bounces, uint64_t seed, uint32_t samples)
      : objects_(objects), stand_in_(std::move(stand_in)) {
    World& world = nb::cast<WorldArrays&>(objects_).world;
    nb::gil_scoped_release release;
    environment_.emplace(environment.data(), int(environment.shape(0)),
                         int(environment.shape(1)));
    compositor_.emplace(world, stand_in_.stand_in(), *environment_,
                        Vec3(origin.data()), bounces, seed, samples);
  }
  void place(nb::object objects) {
    compositor_->place(nb::cast<WorldArrays&>(objects).world);
    objects_ = std::move(objects);
  }
  void set_others(const std::vector<Picture>& environments, In3f origins) {
    if (environments.size() != origins.shape(0)) throw nb::value_error("an origin a map");
    const nb::gil_scoped_release release;
    std::vector<OtherProbe> probes;
    for (size_t i = 0; i < environments.size(); ++i) {
      const Picture& e = environments[i];
      others_.emplace_back(e.data(), int(e.shape(0)), int(e.shape(1)));
      probes.push_back({&others_.back(), Vec3(origins.data() + 3 * i)});
    }
    compositor_->set_others(std::move(probes));
  }
  Compositor* operator->() { return &*compositor_; }
  const Compositor* operator->() const { return &*compositor_; }
  const Compositor& operator*() const { return *compositor_; }

 private:
  nb::object objects_;  // a WorldArrays
  StandInArrays stand_in_;
  std::optional<Environment> environment_;
  std::deque<Environment> others_;
  std::optional<Compositor> compositor_;
};

// A camera and the arrays that it looks at.
struct CameraArrays {
  Picture corners;
  std::optional<In1f> filter;
  Camera camera;
};

PixelRays pixel_rays(const Picture& corners) {
  return {corners.data(), int(corners.shape(0)) - 1, int(corners.shape(1)) - 1};
}

size_t steps(const Matrices& matrices) {
  if (matrices.shape(0) < 1) throw nb::value_error("no matrix");
  return matrices.shape(0);
}

// The first hit of each ray: distance (inf: none), place, normal of the face on the ray's side,
// shading normal, where a ray that goes on starts, instance and face: (N, 1, 15).
Out hits(const WorldArrays& self, In3f origins, In3f directions) {
  if (origins.shape(0) != directions.shape(0)) {
    throw nb::value_error("origins and directions differ in length");
  }
  NewPicture out(origins.shape(0), 1, 15);
  {
    const nb::gil_scoped_release release;
    const auto range = tbb::blocked_range<size_t>(0, out.height, 256);
    tbb::parallel_for(range, [&](const auto& piece) {
      const FlushDenormals flush;
      for (size_t i = piece.begin(); i < piece.end(); ++i) {
        const Vec3 o(origins.data() + 3 * i), d(directions.data() + 3 * i);
        float* to = out.data + out.channels * i;
        const Hit hit = self.world.intersect(o, d);
        to[0] = hit.t;
        if (!hit) continue;
        const Surface s = self.world.surface_at(hit, d);
        const Vec3 rows[] = {s.p, s.ng, s.ns, s.start(s.ng)};
        for (int k = 0; k < 12; ++k) to[1 + k] = (&rows[k / 3].x)[k % 3];
        to[13] = float(hit.instance), to[14] = float(hit.face);
      }
    });
  }
  return out.release();
}

// For tests and plots: what the surface that a ray meets does.
Surface met(const WorldArrays& self, const std::array<float, 3>& o,
            const std::array<float, 3>& d) {
  const Hit hit = self.world.intersect(Vec3(o.data()), Vec3(d.data()));
  if (!hit) throw nb::value_error("the ray meets nothing");
  return self.world.surface_at(hit, normalize(Vec3(d.data())));
}

// f cos (3) and density of directions that leave it: (N, 1, 4).
Out evaluate(const WorldArrays& self, std::array<float, 3> origin, std::array<float, 3> ray,
             In3f directions) {
  const Surface s = met(self, origin, ray);
  const Vec3 wo = -normalize(Vec3(ray.data()));
  NewPicture out(directions.shape(0), 1, 4);
  for (size_t i = 0; i < out.height; ++i) {
    const Vec3 wi(directions.data() + 3 * i);
    add(out.data + 4 * i, shade(s, wo, wi));
    out.data[4 * i + 3] = density(s, wo, wi);
  }
  return out.release();
}

// Directions (3) that it samples, their weight (3), density and whether they blur: (N, 1, 8).
Out scatter(const WorldArrays& self, std::array<float, 3> origin, std::array<float, 3> ray,
            uint32_t count, uint64_t seed) {
  const Surface s = met(self, origin, ray);
  const SampleTable table(count, seed);
  NewPicture out(count, 1, 8);
  for (uint32_t i = 0; i < count; ++i) {
    Sampler sampler(table, seed, i);
    const Scatter next = sample(s, -normalize(Vec3(ray.data())), sampler);
    add(out.data + 8 * i, next.wi);
    add(out.data + 8 * i + 3, next.weight);
    out.data[8 * i + 6] = next.density, out.data[8 * i + 7] = next.blurs;
  }
  return out.release();
}

// The share of light that comes straight through along each ray: (N, 1, 3).
Out transmittance(const WorldArrays& self, In3f origins, In3f directions) {
  if (origins.shape(0) != directions.shape(0)) {
    throw nb::value_error("origins and directions differ in length");
  }
  NewPicture out(origins.shape(0), 1, 3);
  for (size_t i = 0; i < out.height; ++i) {
    add(out.data + 3 * i, self.world.transmittance(Vec3(origins.data() + 3 * i),
                                                   Vec3(directions.data() + 3 * i)));
  }
  return out.release();
}

}  // namespace

NB_MODULE(core, m) {
  nb::class_<CameraArrays>(m, "Camera")
      .def("__init__",
           [](CameraArrays* self, Picture corners, std::array<float, 3> origin,
              std::optional<In1f> filter, float radius, float focus, std::array<float, 3> axis,
              bool shutter, std::array<float, 3> shift, std::array<float, 3> pivot,
              float angle) {
             if (corners.shape(0) < 1 || corners.shape(1) < 1) throw nb::value_error("no corners");
             if (filter && filter->shape(0) < 2) throw nb::value_error("a filter of one quantile");
             Lens lens;
             if (filter) lens.filter = filter->data(), lens.quantiles = int(filter->shape(0));
             lens.radius = radius, lens.focus = focus, lens.axis = Vec3(axis.data());
             lens.shutter = shutter, lens.shift = Vec3(shift.data());
             lens.pivot = Vec3(pivot.data()), lens.angle = angle;
             const Camera camera{pixel_rays(corners), Vec3(origin.data()), lens};
             new (self) CameraArrays{corners, filter, camera};
           },
           nb::kw_only(), nb::arg("corners"), nb::arg("origin"), nb::arg("filter").none(),
           nb::arg("radius"), nb::arg("focus"), nb::arg("axis"), nb::arg("shutter"),
           nb::arg("shift"), nb::arg("pivot"), nb::arg("angle"));

  nb::class_<WorldArrays>(m, "World")
      .def(nb::init<>())
      .def(
          "add_light",
          [](WorldArrays& self, std::optional<std::array<float, 3>> position,
             std::array<float, 3> intensity, std::array<float, 3> direction, float cos_inner,
             float cos_outer) {
            DeltaLight light;
            light.sun = !position;
            if (position) light.position = Vec3(position->data());
            light.intensity = Vec3(intensity.data());
            light.direction = normalize(Vec3(direction.data()));
            light.cos_inner = cos_inner, light.cos_outer = cos_outer;
            self.world.add(light);
          },
          nb::arg("position").none(), nb::arg("intensity"), nb::arg("direction"),
          nb::arg("cos_inner"), nb::arg("cos_outer"))
      .def("add_texture", &WorldArrays::add_texture, nb::arg("pixels"), nb::arg("wrap"))
      .def(
          "add_material",
          [](WorldArrays& self, std::array<float, 3> base, float metallic, float roughness,
             float specular, float ior, float transmission, bool thin, float clearcoat,
             float clearcoat_roughness, std::array<float, 3> emission, float alpha,
             uint8_t alpha_mode, float alpha_cutoff, float normal_scale,
             std::array<int32_t, 4> textures) {
            Material m{};
            m.base = Vec3(base.data()), m.metallic = metallic, m.roughness = roughness;
            m.specular = specular, m.ior = ior, m.transmission = transmission, m.thin = thin;
            m.clearcoat = clearcoat, m.clearcoat_roughness = clearcoat_roughness;
            m.emission = Vec3(emission.data());
            m.alpha = alpha, m.alpha_mode = AlphaMode(alpha_mode);
            m.alpha_cutoff = alpha_cutoff, m.normal_scale = normal_scale;
            m.base_texture = textures[0], m.metallic_roughness_texture = textures[1];
            m.normal_texture = textures[2], m.emission_texture = textures[3];
            return self.world.add(m);
          },
          nb::kw_only(), nb::arg("base"), nb::arg("metallic"), nb::arg("roughness"),
          nb::arg("specular"), nb::arg("ior"), nb::arg("transmission"), nb::arg("thin"),
          nb::arg("clearcoat"), nb::arg("clearcoat_roughness"), nb::arg("emission"),
          nb::arg("alpha"), nb::arg("alpha_mode"), nb::arg("alpha_cutoff"),
          nb::arg("normal_scale"), nb::arg("textures"))
      .def("add_mesh", &WorldArrays::add_mesh, nb::arg("vertices"), nb::arg("normals").none(),
           nb::arg("uv").none(), nb::arg("faces"), nb::arg("material"))
      .def(
          "place",
          [](WorldArrays& self, uint32_t mesh, Matrices matrices) {
            return self.world.place(mesh, matrices.data(), steps(matrices));
          },
          nb::arg("mesh"), nb::arg("matrices"))
      .def("commit", [](WorldArrays& self) { self.world.commit(); })
      .def("hits", &hits, nb::arg("origins"), nb::arg("directions"))
      .def("evaluate", &evaluate, nb::arg("origin"), nb::arg("ray"), nb::arg("directions"))
      .def("scatter", &scatter, nb::arg("origin"), nb::arg("ray"), nb::arg("count"),
           nb::arg("seed"))
      .def("transmittance", &transmittance, nb::arg("origins"), nb::arg("directions"));

  m.def(
      "path_trace",
      [](const WorldArrays& arrays, const CameraArrays& camera, int spp, uint64_t seed,
         int bounces, std::optional<Picture> environment, std::optional<In3f> irradiance,
         float gather_from) {
        const PixelRays& rays = camera.camera.rays;
        NewPicture out(rays.height, rays.width, 3);
        {
          nb::gil_scoped_release release;
          std::optional<Environment> light;
          if (environment) {
            light.emplace(environment->data(), int(environment->shape(0)),
                          int(environment->shape(1)));
          }
          path_trace(arrays.world, camera.camera, spp, seed, bounces, light ? &*light : nullptr,
                     irradiance ? irradiance->data() : nullptr, gather_from, out.data);
        }
        return out.release();
      },
      nb::arg("world"), nb::arg("camera"), nb::arg("spp"), nb::arg("seed"), nb::arg("bounces"),
      nb::arg("environment").none(), nb::arg("irradiance").none(), nb::arg("gather_from"));

  m.def(
      "irradiance",
      [](const WorldArrays& arrays, In3f points, In3f normals, int spp, uint64_t seed,
         int bounces) {
        if (points.shape(0) != normals.shape(0)) {
          throw nb::value_error("points and normals differ in length");
        }
        NewPicture out(points.shape(0), 1, 3);
        {
          nb::gil_scoped_release release;
          irradiance(arrays.world, points.data(), normals.data(), points.shape(0), spp, seed,
                     bounces, nullptr, out.data);
        }
        return out.release();
      },
      nb::arg("world"), nb::arg("points"), nb::arg("normals"), nb::arg("spp"), nb::arg("seed"),
      nb::arg("bounces"));

  nb::class_<StandInArrays>(m, "StandIn")
      .def("__init__",
           [](StandInArrays* self, In3f vertices, In3f original, In3u faces, In1b surface) {
             if (original.shape(0) != vertices.shape(0) || surface.shape(0) != faces.shape(0)) {
               throw nb::value_error("arrays of one stand-in differ in length");
             }
             check_faces(faces, vertices.shape(0));
             new (self) StandInArrays{vertices, original, faces, surface};
           },
           nb::arg("vertices"), nb::arg("original"), nb::arg("faces"), nb::arg("surface"));

  nb::class_<CompositorArrays>(m, "Compositor")
      .def(nb::init<nb::object, StandInArrays, Picture, std::array<float, 3>, int, uint64_t,
                    uint32_t>(),
           nb::arg("objects"), nb::arg("stand_in"),
           nb::arg("environment"), nb::arg("origin"), nb::arg("bounces"), nb::arg("seed"),
           nb::arg("samples"))
      .def("place", &CompositorArrays::place, nb::arg("objects"))
      .def("set_others", &CompositorArrays::set_others, nb::arg("environments"),
           nb::arg("origins"))
      .def(
          "move",
          [](CompositorArrays& self, uint32_t object, Matrices matrices) {
            self->move(object, matrices.data(), steps(matrices));
          },
          nb::arg("object"), nb::arg("matrices"))
      .def(
          "set_gloss",
          [](CompositorArrays& self, float reflectance, float roughness) {
            self->set_gloss(reflectance, roughness);
          },
          nb::arg("reflectance"), nb::arg("roughness"))
      .def(
          "add",
          [](CompositorArrays& self, const CameraArrays& camera, Picture plate,
             bool difference, bool reflects_plate, Counts counts, std::array<uint32_t, 3> caustics, InOut film) {
            const PixelRays& rays = camera.camera.rays;
            for (const auto& a : {std::pair(plate.shape(0), plate.shape(1)),
                                  std::pair(counts.shape(0), counts.shape(1)),
                                  std::pair(film.shape(0), film.shape(1))}) {
              if (int(a.first) != rays.height || int(a.second) != rays.width) {
                throw nb::value_error("rays, plate, counts and film differ in size");
              }
            }
            nb::gil_scoped_release release;
            return self->pass(camera.camera, plate.data(), difference, reflects_plate, counts.data(),
                              {caustics[0], caustics[1], caustics[2]}, film.data());
          },
          nb::arg("camera"), nb::arg("plate"), nb::arg("difference"),
          nb::arg("reflects_plate"), nb::arg("counts"),
          nb::arg("caustics"), nb::arg("film").noconvert())
      .def(
          "background",
          [](const CompositorArrays& self, const CameraArrays& camera, uint32_t count) {
            const PixelRays& rays = camera.camera.rays;
            NewPicture out(rays.height, rays.width, 3);
            {
              nb::gil_scoped_release release;
              self->background(camera.camera, count, out.data);
            }
            return out.release();
          },
          nb::arg("camera"), nb::arg("count"))
      .def(
          "irradiance",
          [](const CompositorArrays& self, std::array<float, 3> p, std::array<float, 3> n) {
            const Vec3 E = self->irradiance(Vec3(p.data()), normalize(Vec3(n.data())));
            return std::array{E.x, E.y, E.z};
          },
          nb::arg("point"), nb::arg("normal"));

  nb::class_<Direct>(m, "Direct")
      .def("__init__",
           [](Direct* self, const CompositorArrays& scene, uint64_t seed) {
             nb::gil_scoped_release release;
             new (self) Direct(*scene, seed);
           },
           nb::arg("scene"), nb::arg("seed"), nb::keep_alive<1, 2>())
      .def("objects_moved", &Direct::objects_moved)
      .def("begin", &Direct::begin, nb::arg("height"), nb::arg("width"))
      .def(
          "add",
          [](Direct& self, Picture corners, std::array<float, 3> camera, int samples) {
            nb::gil_scoped_release release;
            return self.pass(pixel_rays(corners), Vec3(camera.data()), samples);
          },
          nb::arg("corners"), nb::arg("camera"), nb::arg("samples"))
      .def(
          "resolve",
          [](const Direct& self, Picture corners, std::array<float, 3> camera, Picture plate,
             bool difference, bool filter, bool layers) {
            const PixelRays rays = pixel_rays(corners);
            if (int(plate.shape(0)) != rays.height || int(plate.shape(1)) != rays.width) {
              throw nb::value_error("rays and plate differ in size");
            }
            NewPicture rgb(rays.height, rays.width, 3);
            NewPicture out(layers ? rays.height : 0, layers ? rays.width : 0, Direct::kLayers);
            size_t clipped;
            {
              nb::gil_scoped_release release;
              clipped = self.resolve(rays, Vec3(camera.data()), plate.data(), difference, filter,
                                     rgb.data, layers ? out.data : nullptr);
            }
            return std::tuple(rgb.release(), out.release(), clipped);
          },
          nb::arg("corners"), nb::arg("camera"), nb::arg("plate"), nb::arg("difference"),
          nb::arg("filter"), nb::arg("layers"));
}
