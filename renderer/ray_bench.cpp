// For the benchmark: our rays beside bare Embree loops over the same rays.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include "camera.h"
#include "packet.h"

namespace nb = nanobind;
using namespace chromeball;

namespace {

using In3f = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using In3u = nb::ndarray<const uint32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using InCorners = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using InPackets = nb::ndarray<const float, nb::shape<-1, 3, 16>, nb::c_contig, nb::device::cpu>;
using Out1 = nb::ndarray<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Out3 = nb::ndarray<float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

Vec3 start(Vec3 p, Vec3 n) { return p + n * (1e-5f * largest_magnitude(p) + 1e-5f); }

class RayBench {
 public:
  RayBench(In3f vertices, In3u faces) {
    accel_.add(vertices.data(), vertices.shape(0), faces.data(), faces.shape(0));
    accel_.commit();
    // the same once more, without a line of ours in between
    device_ = rtcNewDevice(nullptr);
    scene_ = rtcNewScene(device_);
    rtcSetSceneFlags(scene_, RTC_SCENE_FLAG_ROBUST);
    rtcSetSceneBuildQuality(scene_, RTC_BUILD_QUALITY_HIGH);
    RTCGeometry g = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_TRIANGLE);
    std::copy_n(vertices.data(), vertices.size(),
                static_cast<float*>(rtcSetNewGeometryBuffer(
                    g, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, vertices.shape(0))));
    std::copy_n(faces.data(), faces.size(),
                static_cast<uint32_t*>(rtcSetNewGeometryBuffer(
                    g, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, faces.shape(0))));
    rtcCommitGeometry(g);
    rtcAttachGeometry(scene_, g);
    rtcReleaseGeometry(g);
    rtcCommitScene(scene_);
  }
  ~RayBench() {
    rtcReleaseScene(scene_);
    rtcReleaseDevice(device_);
  }
  RayBench(const RayBench&) = delete;
  RayBench& operator=(const RayBench&) = delete;

  // Irradiance of points with normals from point lights: the ray is made, traced and shaded.
  void shadow_ours(In3f points, In3f normals, In3f lights, Out1 irradiance) const {
    nb::gil_scoped_release release;
    const tbb::blocked_range<size_t> all(0, points.shape(0), 256);
    tbb::parallel_for(all, [&](const auto& range) {
      const FlushDenormals flush;
      for (size_t i = range.begin(); i < range.end(); ++i) {
        const Vec3 n(normals.data() + 3 * i), x = start(Vec3(points.data() + 3 * i), n);
        float sum = 0;
        for (size_t k = 0; k < lights.shape(0); ++k) {
          const Vec3 to = Vec3(lights.data() + 3 * k) - x;
          const float cos = dot(to, n);
          if (cos <= 0 || accel_.occluded(x, to, 1)) continue;
          const float t2 = length2(to);
          sum += cos / (t2 * std::sqrt(t2));
        }
        irradiance.data()[i] = sum;
      }
    });
  }

  // Rays made beforehand, straight through Embree's own interface; 1 where nothing is met.
  void shadow_bare(Out3 origins, Out3 directions, Out1 visible) const {
    nb::gil_scoped_release release;
    const tbb::blocked_range<size_t> all(0, origins.shape(0), 4096);
    tbb::parallel_for(all, [&](const auto& range) {
      const FlushDenormals flush;
      for (size_t i = range.begin(); i < range.end(); ++i) {
        const float* o = origins.data() + 3 * i;
        const float* d = directions.data() + 3 * i;
        RTCRay ray;
        ray.org_x = o[0], ray.org_y = o[1], ray.org_z = o[2];
        ray.dir_x = d[0], ray.dir_y = d[1], ray.dir_z = d[2];
        ray.tnear = 0, ray.tfar = 1, ray.time = 0, ray.mask = ~0u, ray.id = 0, ray.flags = 0;
#if CHROMEBALL_EMBREE >= 4
        rtcOccluded1(scene_, &ray);
#else
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        rtcOccluded1(scene_, &context, &ray);
#endif
        visible.data()[i] = ray.tfar < 0 ? 0.0f : 1.0f;
      }
    });
  }

  // Distances along a camera's rays through the middles of pixels, in blocks of 4 x 4;
  // the rays are made here.
  void look_ours(InCorners corners, std::array<float, 3> camera, Out1 distance) const {
    nb::gil_scoped_release release;
    const PixelRays rays{corners.data(), int(corners.shape(0)) - 1, int(corners.shape(1)) - 1};
    const Vec3 o(camera.data());
    const int across = rays.width / 4;
    const tbb::blocked_range<int> all(0, across * (rays.height / 4), 16);
    tbb::parallel_for(all, [&](const auto& range) {
      const FlushDenormals flush;
      Packet packet;
      for (int block = range.begin(); block < range.end(); ++block) {
        packet.clear();
        for (int k = 0; k < Packet::kWidth; ++k) {
          const int x = block % across * 4 + (k & 3), y = block / across * 4 + (k >> 2);
          packet.set(k, o, rays.direction(y, x, 0.5f, 0.5f));
        }
        intersect(accel_.scene(), packet, true);
        std::copy_n(packet.rays.ray.tfar, Packet::kWidth,
                    distance.data() + size_t(Packet::kWidth) * block);
      }
    });
  }

  // Rays made beforehand, sixteen in a row that run alike, x y z apart: (N / 16, 3, 16).
  void look_bare(std::array<float, 3> camera, InPackets directions, Out1 distance) const {
    nb::gil_scoped_release release;
    const tbb::blocked_range<size_t> all(0, directions.shape(0), 16);
    tbb::parallel_for(all, [&](const auto& range) {
      const FlushDenormals flush;
      alignas(64) int valid[16];
      std::fill_n(valid, 16, -1);
      for (size_t i = range.begin(); i < range.end(); ++i) {
        const float* d = directions.data() + 48 * i;
        RTCRayHit16 r;
        std::fill_n(r.ray.org_x, 16, camera[0]);
        std::fill_n(r.ray.org_y, 16, camera[1]);
        std::fill_n(r.ray.org_z, 16, camera[2]);
        std::copy_n(d, 16, r.ray.dir_x);
        std::copy_n(d + 16, 16, r.ray.dir_y);
        std::copy_n(d + 32, 16, r.ray.dir_z);
        std::fill_n(r.ray.tnear, 16, 0.0f);
        std::fill_n(r.ray.tfar, 16, kInfinity);
        std::fill_n(r.ray.time, 16, 0.0f);
        std::fill_n(r.ray.mask, 16, ~0u);
        std::fill_n(r.ray.flags, 16, 0u);
        std::fill_n(r.hit.geomID, 16, RTC_INVALID_GEOMETRY_ID);
        std::fill_n(r.hit.instID[0], 16, RTC_INVALID_GEOMETRY_ID);
#if CHROMEBALL_EMBREE >= 4
        RTCIntersectArguments arguments;
        rtcInitIntersectArguments(&arguments);
        arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
        rtcIntersect16(valid, scene_, &r, &arguments);
#else
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
        rtcIntersect16(valid, scene_, &context, &r);
#endif
        std::copy_n(r.ray.tfar, 16, distance.data() + 16 * i);
      }
    });
  }

 private:
  Accel accel_;
  RTCDevice device_;
  RTCScene scene_;
};

}  // namespace

NB_MODULE(ray_bench, m) {
  nb::class_<RayBench>(m, "RayBench")
      .def(nb::init<In3f, In3u>(), nb::arg("vertices"), nb::arg("faces"))
      .def("shadow_ours", &RayBench::shadow_ours, nb::arg("points"), nb::arg("normals"), nb::arg("lights"),
           nb::arg("irradiance"))
      .def("shadow_bare", &RayBench::shadow_bare, nb::arg("origins"), nb::arg("directions"),
           nb::arg("visible"))
      .def("look_ours", &RayBench::look_ours, nb::arg("corners"), nb::arg("camera"),
           nb::arg("distance"))
      .def("look_bare", &RayBench::look_bare, nb::arg("camera"), nb::arg("directions"),
           nb::arg("distance"));
}
