// Sixteen rays side by side.
#pragma once

#include "embree.h"

namespace chromeball {

struct alignas(64) Packet {
  static constexpr int kWidth = 16;
  alignas(64) int valid[kWidth] = {};  // -1: there is a ray in the lane
  RTCRayHit16 rays;

  void clear() { std::fill(std::begin(valid), std::end(valid), 0); }
  void set(int lane, Vec3 o, Vec3 d, float tfar = kInfinity) {
    RTCRay16& r = rays.ray;
    valid[lane] = -1;
    r.org_x[lane] = o.x, r.org_y[lane] = o.y, r.org_z[lane] = o.z;
    r.dir_x[lane] = d.x, r.dir_y[lane] = d.y, r.dir_z[lane] = d.z;
    r.tnear[lane] = 0, r.tfar[lane] = tfar, r.time[lane] = 0;
    r.mask[lane] = ~0u, r.id[lane] = 0, r.flags[lane] = 0;
    forget_hit(lane);
  }
  void forget_hit(int lane) {
    rays.hit.geomID[lane] = RTC_INVALID_GEOMETRY_ID;
    rays.hit.instID[0][lane] = RTC_INVALID_GEOMETRY_ID;
  }
  Vec3 origin(int lane) const {
    return {rays.ray.org_x[lane], rays.ray.org_y[lane], rays.ray.org_z[lane]};
  }
  Vec3 direction(int lane) const {
    return {rays.ray.dir_x[lane], rays.ray.dir_y[lane], rays.ray.dir_z[lane]};
  }
  bool hits(int lane) const { return rays.hit.geomID[lane] != RTC_INVALID_GEOMETRY_ID; }
  bool blocked(int lane) const { return rays.ray.tfar[lane] < 0; }
  Hit hit(int lane) const {
    const RTCHit16& h = rays.hit;
    const uint32_t in = h.instID[0][lane];
    return {rays.ray.tfar[lane], h.u[lane], h.v[lane], h.primID[lane],
            in != RTC_INVALID_GEOMETRY_ID ? in : h.geomID[lane]};
  }
};

// The nearest hits; `coherent` rays start together and run alike.
inline void intersect(RTCScene scene, Packet& p, bool coherent) {
#if CHROMEBALL_EMBREE >= 4
  RTCIntersectArguments arguments;
  rtcInitIntersectArguments(&arguments);
  if (coherent) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
  rtcIntersect16(p.valid, scene, &p.rays, &arguments);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  if (coherent) context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  rtcIntersect16(p.valid, scene, &context, &p.rays);
#endif
}

// Marks the lanes that meet anything as `blocked`.
inline void occluded(RTCScene scene, Packet& p, bool coherent) {
#if CHROMEBALL_EMBREE >= 4
  RTCOccludedArguments arguments;
  rtcInitOccludedArguments(&arguments);
  if (coherent) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
  rtcOccluded16(p.valid, scene, &p.rays.ray, &arguments);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  if (coherent) context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  rtcOccluded16(p.valid, scene, &context, &p.rays.ray);
#endif
}

}  // namespace chromeball
