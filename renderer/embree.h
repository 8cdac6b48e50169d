// Embree 3.13 and Embree 4 as one: a scene of triangle meshes that rays are traced through.
// Embree 4 takes arguments by flags where Embree 3 takes a context; all else is the same.
#pragma once

#if CHROMEBALL_EMBREE >= 4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <pmmintrin.h>
#include <xmmintrin.h>

#include <limits>
#include <memory>
#include <stdexcept>
#include <string>

#include "vec.h"

namespace chromeball {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

struct Hit {
  float t = kInfinity;
  float u = 0, v = 0;
  uint32_t face = RTC_INVALID_GEOMETRY_ID;
  uint32_t instance = RTC_INVALID_GEOMETRY_ID;  // of a scene without instances: the geometry
  float time = 0;  // of the shutter's opening, 0..1
  explicit operator bool() const { return instance != RTC_INVALID_GEOMETRY_ID; }
};

// Denormal floats cost Embree dearly; every worker sets this for its piece of work.
class FlushDenormals {
 public:
  FlushDenormals() : saved_(_mm_getcsr()) {
    _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
    _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
  }
  ~FlushDenormals() { _mm_setcsr(saved_); }
  FlushDenormals(const FlushDenormals&) = delete;
  FlushDenormals& operator=(const FlushDenormals&) = delete;

 private:
  unsigned saved_;
};

// Owners of Embree's handles.
struct Release {
  void operator()(RTCDevice d) const { rtcReleaseDevice(d); }
  void operator()(RTCScene s) const { rtcReleaseScene(s); }
  void operator()(RTCGeometry g) const { rtcReleaseGeometry(g); }
};
using SceneHandle = std::unique_ptr<RTCSceneTy, Release>;
using GeometryHandle = std::unique_ptr<RTCGeometryTy, Release>;

class Device {
 public:
  Device() : device_(rtcNewDevice(nullptr)) {
    if (!device_) throw std::runtime_error("Embree: no device");
    rtcSetDeviceErrorFunction(
        device_.get(),
        [](void* self, RTCError, const char* text) { static_cast<Device*>(self)->error_ = text; },
        this);
  }
  Device(const Device&) = delete;
  Device& operator=(const Device&) = delete;

  RTCDevice get() const { return device_.get(); }
  void check() const {
    if (!error_.empty()) throw std::runtime_error("Embree: " + error_);
  }
  SceneHandle scene(RTCBuildQuality quality) const {
    SceneHandle scene(rtcNewScene(device_.get()));
    rtcSetSceneFlags(scene.get(), RTC_SCENE_FLAG_ROBUST);
    rtcSetSceneBuildQuality(scene.get(), quality);
    return scene;
  }

 private:
  std::string error_;  // first, so that it outlives the device that reports into it
  std::unique_ptr<RTCDeviceTy, Release> device_;
};

// Triangles in Embree's own buffers: v vertices and f faces, copied.
struct Triangles {
  const float* vertices = nullptr;
  const uint32_t* faces = nullptr;
  size_t size = 0;

  Vec3 corner(uint32_t face, int k) const { return Vec3(vertices + 3 * faces[3 * face + k]); }
};

inline Triangles attach_triangles(const Device& device, RTCScene scene, const float* vertices,
                                  size_t v, const uint32_t* faces, size_t f) {
  const GeometryHandle g(rtcNewGeometry(device.get(), RTC_GEOMETRY_TYPE_TRIANGLE));
  auto* to_v = static_cast<float*>(rtcSetNewGeometryBuffer(
      g.get(), RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 3 * sizeof(float), v));
  auto* to_f = static_cast<uint32_t*>(rtcSetNewGeometryBuffer(
      g.get(), RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 3 * sizeof(uint32_t), f));
  device.check();
  std::copy(vertices, vertices + 3 * v, to_v);
  std::copy(faces, faces + 3 * f, to_f);
  rtcCommitGeometry(g.get());
  rtcAttachGeometry(scene, g.get());
  return {to_v, to_f, f};
}

inline RTCRay make_ray(Vec3 o, Vec3 d, float tfar, float time) {
  RTCRay r;
  r.org_x = o.x, r.org_y = o.y, r.org_z = o.z;
  r.dir_x = d.x, r.dir_y = d.y, r.dir_z = d.z;
  r.tnear = 0, r.tfar = tfar, r.time = time, r.mask = ~0u, r.id = 0, r.flags = 0;
  return r;
}

inline Hit intersect(RTCScene scene, Vec3 o, Vec3 d, float tfar, float time = 0) {
  if (!is_finite(o + d)) return {};  // Embree may end the process
  RTCRayHit r;
  r.ray = make_ray(o, d, tfar, time);
  r.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  r.hit.primID = RTC_INVALID_GEOMETRY_ID;
  r.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if CHROMEBALL_EMBREE >= 4
  rtcIntersect1(scene, &r);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcIntersect1(scene, &context, &r);
#endif
  const uint32_t in = r.hit.instID[0];
  return {r.ray.tfar, r.hit.u, r.hit.v, r.hit.primID,
          in != RTC_INVALID_GEOMETRY_ID ? in : r.hit.geomID, time};
}

inline bool occluded(RTCScene scene, Vec3 o, Vec3 d, float tfar, float time = 0) {
  if (!is_finite(o + d)) return true;
  RTCRay r = make_ray(o, d, tfar, time);
#if CHROMEBALL_EMBREE >= 4
  rtcOccluded1(scene, &r);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcOccluded1(scene, &context, &r);
#endif
  return r.tfar < 0;
}

// One level of triangles.
class Accel {
 public:
  Accel() : scene_(device_.scene(RTC_BUILD_QUALITY_HIGH)) {}

  // Copies V vertices and F faces.
  Triangles add(const float* vertices, size_t v, const uint32_t* faces, size_t f) {
    empty_ = false;
    return attach_triangles(device_, scene_.get(), vertices, v, faces, f);
  }
  void commit() {
    rtcCommitScene(scene_.get());
    device_.check();
  }
  bool empty() const { return empty_; }
  RTCScene scene() const { return scene_.get(); }

  Hit intersect(Vec3 o, Vec3 d, float tfar = kInfinity) const {
    return chromeball::intersect(scene_.get(), o, d, tfar);
  }
  bool occluded(Vec3 o, Vec3 d, float tfar = kInfinity) const {
    return chromeball::occluded(scene_.get(), o, d, tfar);
  }

 private:
  Device device_;
  SceneHandle scene_;
  bool empty_ = true;
};

// Half the spacing of floats at 1, and Higham's bound of the error of n roundings.
constexpr float kHalfUlp = 0x1p-24f;
constexpr float gamma(int n) { return n * kHalfUlp / (1 - n * kHalfUlp); }
// Roundings between a hit and the next ray that must clear its face: the hit is interpolated,
// moved, lifted, taken back into the mesh's space by Embree and subtracted from the corners.
constexpr float kLift = gamma(16);

// How far from a face with normal n a ray has to start that leaves p, which was interpolated
// from corners of absolute sizes up to `size` (Pharr, Jakob, Humphreys 2016, section 3.9).
inline float rise(Vec3 size, Vec3 n) { return kLift * dot(abs(n), size) + 1e-30f; }

}  // namespace chromeball
