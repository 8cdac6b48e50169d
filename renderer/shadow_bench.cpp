// For the benchmark: our shadow rays beside a bare Embree loop over the same rays.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include "embree.h"

namespace nb = nanobind;
using namespace chromeball;

namespace {

using In3f = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using In3u = nb::ndarray<const uint32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Out1 = nb::ndarray<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Out3 = nb::ndarray<float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

Vec3 start(Vec3 p, Vec3 n) { return p + n * (1e-5f * largest_magnitude(p) + 1e-5f); }

class ShadowBench {
 public:
  ShadowBench(In3f vertices, In3u faces) {
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
  ~ShadowBench() {
    rtcReleaseScene(scene_);
    rtcReleaseDevice(device_);
  }
  ShadowBench(const ShadowBench&) = delete;
  ShadowBench& operator=(const ShadowBench&) = delete;

  // Irradiance of points with normals from point lights: the ray is made, traced and shaded.
  void ours(In3f points, In3f normals, In3f lights, Out1 irradiance) const {
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
  void bare(Out3 origins, Out3 directions, Out1 visible) const {
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

 private:
  Accel accel_;
  RTCDevice device_;
  RTCScene scene_;
};

}  // namespace

NB_MODULE(shadow_bench, m) {
  nb::class_<ShadowBench>(m, "ShadowBench")
      .def(nb::init<In3f, In3u>(), nb::arg("vertices"), nb::arg("faces"))
      .def("ours", &ShadowBench::ours, nb::arg("points"), nb::arg("normals"), nb::arg("lights"),
           nb::arg("irradiance"))
      .def("bare", &ShadowBench::bare, nb::arg("origins"), nb::arg("directions"),
           nb::arg("visible"));
}
