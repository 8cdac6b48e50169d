// Triangles with a material each, and the surface at a hit.
#pragma once

#include <span>
#include <vector>

#include "embree.h"

namespace chromeball {

enum class Kind : uint8_t { diffuse = 0, mirror = 1, glass = 2 };

// Views of arrays that the caller keeps alive.
struct Mesh {
  std::span<const float> vertices;    // (V, 3)
  std::span<const float> normals;     // (V, 3), or empty: flat faces
  std::span<const uint32_t> faces;    // (F, 3)
  std::span<const float> albedo;      // (F, 3)
  std::span<const float> emission;    // (F, 3)
  std::span<const uint8_t> kind;      // (F,)
  std::span<const float> ior;         // (F,)

  size_t size() const { return kind.size(); }
  Vec3 corner(uint32_t face, int k) const { return Vec3(&vertices[3 * faces[3 * face + k]]); }
  Vec3 face_albedo(uint32_t face) const { return Vec3(&albedo[3 * face]); }
  Vec3 face_emission(uint32_t face) const { return Vec3(&emission[3 * face]); }
};

struct Surface {
  Vec3 p;
  Vec3 ng;  // unit, on the ray's side
  Vec3 ns;  // shading normal, unit, on the ray's side
  bool outside;  // the ray meets the face from where its corners run counter-clockwise
};

inline Surface surface_at(const Mesh& mesh, const Hit& hit, Vec3 d) {
  Surface s;
  const Vec3 a = mesh.corner(hit.face, 0), b = mesh.corner(hit.face, 1),
             c = mesh.corner(hit.face, 2);
  s.p = a + hit.u * (b - a) + hit.v * (c - a);  // nearer to the face than o + t d
  s.ng = normalize(hit.ng);
  s.outside = dot(s.ng, d) < 0;
  if (!s.outside) s.ng = -s.ng;
  s.ns = s.ng;
  if (!mesh.normals.empty()) {
    const uint32_t* f = &mesh.faces[3 * hit.face];
    const Vec3 n = (1 - hit.u - hit.v) * Vec3(&mesh.normals[3 * f[0]]) +
                   hit.u * Vec3(&mesh.normals[3 * f[1]]) +
                   hit.v * Vec3(&mesh.normals[3 * f[2]]);
    const float l = length(n);
    if (l > 1e-6f) {
      const Vec3 ns = n * ((s.outside ? 1 : -1) / l);
      if (dot(ns, d) < -1e-3f && dot(ns, s.ng) > 0) s.ns = ns;
    }
  }
  return s;
}

// Where a smooth surface sends a ray, and how likely.
struct Bounce {
  Vec3 d;
  bool through;  // refracted, to the other side
};

// Reflectance of a smooth dielectric, unpolarised (Fresnel); eta = n_inside / n_outside as the
// ray sees it, cosi > 0. Fills the cosine of the refracted ray; 1 at total reflection.
inline float fresnel(float cosi, float eta, float& cost) {
  const float sin2 = (1 - cosi * cosi) / (eta * eta);
  if (sin2 >= 1) return 1;
  cost = std::sqrt(1 - sin2);
  const float s = (cosi - eta * cost) / (cosi + eta * cost);
  const float p = (eta * cosi - cost) / (eta * cosi + cost);
  return 0.5f * (s * s + p * p);
}

inline Bounce bounce_specular(const Surface& s, Vec3 d, Kind kind, float ior, float u) {
  // A shading normal may bend the ray to the wrong side of the face; then the face's own is used.
  for (const Vec3 n : {s.ns, s.ng}) {
    Bounce b{reflect(d, n), false};
    if (kind == Kind::glass) {
      const float eta = s.outside ? ior : 1 / ior;
      const float cosi = std::min(1.0f, -dot(d, n));
      float cost = 0;
      if (u >= fresnel(cosi, eta, cost)) {
        b = {normalize(d * (1 / eta) + n * (cosi / eta - cost)), true};
      }
    }
    if ((dot(b.d, s.ng) > 0) != b.through) return b;
  }
  return {reflect(d, s.ng), false};
}

}  // namespace chromeball
