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
  Vec3 ng;  // not normalised, right-handed around the face's corners
  float u = 0, v = 0;
  uint32_t face = RTC_INVALID_GEOMETRY_ID;
  uint32_t mesh = RTC_INVALID_GEOMETRY_ID;
  explicit operator bool() const { return mesh != RTC_INVALID_GEOMETRY_ID; }
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

class Accel {
 public:
  Accel() : device_(rtcNewDevice(nullptr)) {
    if (!device_) throw std::runtime_error("Embree: no device");
    rtcSetDeviceErrorFunction(
        device_.get(),
        [](void* self, RTCError, const char* text) { static_cast<Accel*>(self)->error_ = text; },
        this);
    scene_.reset(rtcNewScene(device_.get()));
    rtcSetSceneFlags(scene_.get(), RTC_SCENE_FLAG_ROBUST);
    rtcSetSceneBuildQuality(scene_.get(), RTC_BUILD_QUALITY_HIGH);
  }
  Accel(const Accel&) = delete;
  Accel& operator=(const Accel&) = delete;

  // Copies V vertices and F faces; returns the mesh's number.
  uint32_t add(const float* vertices, size_t v, const uint32_t* faces, size_t f) {
    RTCGeometry g = rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_TRIANGLE);
    auto* to_v = static_cast<float*>(rtcSetNewGeometryBuffer(
        g, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 3 * sizeof(float), v));
    auto* to_f = static_cast<uint32_t*>(rtcSetNewGeometryBuffer(
        g, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 3 * sizeof(uint32_t), f));
    if (!to_v || !to_f) throw std::runtime_error("Embree: " + error_);
    std::copy(vertices, vertices + 3 * v, to_v);
    std::copy(faces, faces + 3 * f, to_f);
    rtcCommitGeometry(g);
    const uint32_t id = rtcAttachGeometry(scene_.get(), g);
    rtcReleaseGeometry(g);
    empty_ = false;
    return id;
  }

  void commit() {
    rtcCommitScene(scene_.get());
    if (!error_.empty()) throw std::runtime_error("Embree: " + error_);
  }

  bool empty() const { return empty_; }

  Hit intersect(Vec3 o, Vec3 d, float tfar = kInfinity) const {
    RTCRayHit r;
    r.ray = ray(o, d, tfar);
    r.hit.geomID = RTC_INVALID_GEOMETRY_ID;
    r.hit.primID = RTC_INVALID_GEOMETRY_ID;
    r.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if CHROMEBALL_EMBREE >= 4
    rtcIntersect1(scene_.get(), &r);
#else
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(scene_.get(), &context, &r);
#endif
    return {r.ray.tfar, {r.hit.Ng_x, r.hit.Ng_y, r.hit.Ng_z}, r.hit.u, r.hit.v,
            r.hit.primID, r.hit.geomID};
  }

  bool occluded(Vec3 o, Vec3 d, float tfar = kInfinity) const {
    RTCRay r = ray(o, d, tfar);
#if CHROMEBALL_EMBREE >= 4
    rtcOccluded1(scene_.get(), &r);
#else
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded1(scene_.get(), &context, &r);
#endif
    return r.tfar < 0;
  }

 private:
  static RTCRay ray(Vec3 o, Vec3 d, float tfar) {
    RTCRay r;
    r.org_x = o.x, r.org_y = o.y, r.org_z = o.z;
    r.dir_x = d.x, r.dir_y = d.y, r.dir_z = d.z;
    r.tnear = 0, r.tfar = tfar, r.time = 0, r.mask = ~0u, r.id = 0, r.flags = 0;
    return r;
  }

  struct Release {
    void operator()(RTCDevice d) const { rtcReleaseDevice(d); }
    void operator()(RTCScene s) const { rtcReleaseScene(s); }
  };
  std::string error_;  // first, so that it outlives the device that reports into it
  std::unique_ptr<RTCDeviceTy, Release> device_;
  std::unique_ptr<RTCSceneTy, Release> scene_;
  bool empty_ = true;
};

// A ray's start, lifted off the surface to the side n points to, against rounding.
inline Vec3 lift(Vec3 p, Vec3 n) {
  return p + n * (1e-5f * largest_magnitude(p) + 1e-5f);
}

}  // namespace chromeball
