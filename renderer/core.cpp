// The Python face of the C++ core: arrays in, arrays out, the GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include "composite.h"
#include "path.h"

namespace nb = nanobind;
using namespace chromeball;

namespace {

using In3f = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using In3u = nb::ndarray<const uint32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using In4f = nb::ndarray<const float, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
using In1f = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using In1b = nb::ndarray<const uint8_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Picture = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
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

// The faces with their materials; indices are checked by the Python side.
struct MeshArrays {
  In3f vertices;
  std::optional<In3f> normals;
  In3u faces;
  In3f albedo, emission;
  In1b kind;
  In1f ior;

  Mesh mesh() const {
    return {view(vertices), normals ? view(*normals) : std::span<const float>(), view(faces),
            view(albedo), view(emission), view(kind), view(ior)};
  }
};

struct StandInArrays {
  In3f vertices, original;
  In3u faces;
  In1b surface;

  StandIn stand_in() const {
    return {view(vertices), view(original), view(faces), view(surface)};
  }
};

void check_faces(const In3u& faces, size_t vertices) {
  for (const uint32_t i : view(faces)) {
    if (i >= vertices) throw nb::value_error("face index out of range");
  }
}

// The compositor with all that it looks at.
class CompositorArrays {
 public:
  CompositorArrays(MeshArrays objects, In4f bounds, StandInArrays stand_in, Picture environment,
                   std::array<float, 3> origin, int bounces, uint64_t seed, uint32_t samples)
      : objects_(std::move(objects)), stand_in_(std::move(stand_in)) {
    std::vector<Sphere> spheres;
    for (size_t i = 0; i < bounds.shape(0); ++i) {
      spheres.push_back({Vec3(bounds.data() + 4 * i), bounds.data()[4 * i + 3]});
    }
    nb::gil_scoped_release release;
    environment_.emplace(environment.data(), int(environment.shape(0)),
                         int(environment.shape(1)));
    compositor_.emplace(objects_.mesh(), std::move(spheres), stand_in_.stand_in(),
                        *environment_, Vec3(origin.data()), bounces, seed, samples);
  }
  const Compositor* operator->() const { return &*compositor_; }

 private:
  MeshArrays objects_;
  StandInArrays stand_in_;
  std::optional<Environment> environment_;
  std::optional<Compositor> compositor_;
};

PixelRays pixel_rays(const Picture& corners) {
  return {corners.data(), int(corners.shape(0)) - 1, int(corners.shape(1)) - 1};
}

}  // namespace

NB_MODULE(core, m) {
  nb::class_<MeshArrays>(m, "Mesh")
      .def("__init__",
           [](MeshArrays* self, In3f vertices, std::optional<In3f> normals, In3u faces,
              In3f albedo, In3f emission, In1b kind, In1f ior) {
             const size_t f = faces.shape(0);
             if (albedo.shape(0) != f || emission.shape(0) != f || kind.shape(0) != f ||
                 ior.shape(0) != f || (normals && normals->shape(0) != vertices.shape(0))) {
               throw nb::value_error("arrays of one mesh differ in length");
             }
             check_faces(faces, vertices.shape(0));
             new (self) MeshArrays{vertices, normals, faces, albedo, emission, kind, ior};
           },
           nb::arg("vertices"), nb::arg("normals").none(), nb::arg("faces"), nb::arg("albedo"),
           nb::arg("emission"), nb::arg("kind"), nb::arg("ior"));

  m.def(
      "path_trace",
      [](const MeshArrays& arrays, Picture corners, std::array<float, 3> origin, int spp,
         uint64_t seed, int bounces, std::optional<Picture> environment,
         std::optional<In3f> irradiance, float gather_from) {
        if (irradiance && irradiance->shape(0) != arrays.vertices.shape(0)) {
          throw nb::value_error("irradiance and vertices differ in length");
        }
        const PixelRays rays = pixel_rays(corners);
        NewPicture out(rays.height, rays.width, 3);
        {
          nb::gil_scoped_release release;
          std::optional<Environment> light;
          if (environment) {
            light.emplace(environment->data(), int(environment->shape(0)),
                          int(environment->shape(1)));
          }
          path_trace(arrays.mesh(), rays, Vec3(origin.data()), spp, seed, bounces,
                     light ? &*light : nullptr, irradiance ? irradiance->data() : nullptr,
                     gather_from, out.data);
        }
        return out.release();
      },
      nb::arg("mesh"), nb::arg("corners"), nb::arg("origin"), nb::arg("spp"), nb::arg("seed"),
      nb::arg("bounces"), nb::arg("environment").none(), nb::arg("irradiance").none(),
      nb::arg("gather_from"));

  m.def(
      "irradiance",
      [](const MeshArrays& arrays, In3f points, In3f normals, int spp, uint64_t seed,
         int bounces) {
        if (points.shape(0) != normals.shape(0)) {
          throw nb::value_error("points and normals differ in length");
        }
        NewPicture out(points.shape(0), 1, 3);
        {
          nb::gil_scoped_release release;
          irradiance(arrays.mesh(), points.data(), normals.data(), points.shape(0), spp, seed,
                     bounces, nullptr, out.data);
        }
        return out.release();
      },
      nb::arg("mesh"), nb::arg("points"), nb::arg("normals"), nb::arg("spp"), nb::arg("seed"),
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
      .def(nb::init<MeshArrays, In4f, StandInArrays, Picture, std::array<float, 3>, int,
                    uint64_t, uint32_t>(),
           nb::arg("objects"), nb::arg("bounds"), nb::arg("stand_in"), nb::arg("environment"),
           nb::arg("origin"), nb::arg("bounces"), nb::arg("seed"), nb::arg("samples"))
      .def(
          "add",
          [](const CompositorArrays& self, Picture corners, std::array<float, 3> camera,
             Picture plate, bool difference, Counts counts, InOut film) {
            const PixelRays rays = pixel_rays(corners);
            for (const auto& a : {std::pair(plate.shape(0), plate.shape(1)),
                                  std::pair(counts.shape(0), counts.shape(1)),
                                  std::pair(film.shape(0), film.shape(1))}) {
              if (int(a.first) != rays.height || int(a.second) != rays.width) {
                throw nb::value_error("rays, plate, counts and film differ in size");
              }
            }
            nb::gil_scoped_release release;
            return self->pass(rays, Vec3(camera.data()), plate.data(), difference, counts.data(),
                              film.data());
          },
          nb::arg("corners"), nb::arg("camera"), nb::arg("plate"), nb::arg("difference"),
          nb::arg("counts"), nb::arg("film").noconvert())
      .def(
          "background",
          [](const CompositorArrays& self, Picture corners, std::array<float, 3> camera,
             uint32_t count) {
            const PixelRays rays = pixel_rays(corners);
            NewPicture out(rays.height, rays.width, 3);
            {
              nb::gil_scoped_release release;
              self->background(rays, Vec3(camera.data()), count, out.data);
            }
            return out.release();
          },
          nb::arg("corners"), nb::arg("camera"), nb::arg("count"))
      .def(
          "irradiance",
          [](const CompositorArrays& self, std::array<float, 3> p, std::array<float, 3> n) {
            const Vec3 E = self->irradiance(Vec3(p.data()), normalize(Vec3(n.data())));
            return std::array{E.x, E.y, E.z};
          },
          nb::arg("point"), nb::arg("normal"));
}
