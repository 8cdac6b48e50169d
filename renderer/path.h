// The reference: unidirectional path tracing with full light transport.
#pragma once

#include "light.h"
#include "world.h"

namespace chromeball {

// Directions at the corners of H x W pixels; NaN outside the lens.
struct PixelRays {
  const float* corner;  // (H + 1, W + 1, 3)
  int height, width;

  // The direction through (u, v) in 0..1 of a pixel, unit length or NaN.
  Vec3 direction(int y, int x, float u, float v) const {
    const float* a = corner + 3 * (size_t(y) * (width + 1) + x);
    const float* b = a + 3 * (width + 1);
    return normalize((1 - v) * ((1 - u) * Vec3(a) + u * Vec3(a + 3)) +
                     v * ((1 - u) * Vec3(b) + u * Vec3(b + 3)));
  }
};

// Fills radiance (H, W, 3): the mean of `spp` paths of at most `bounces` scatterings. With
// irradiance (V, 3), at the vertices of a world of one mesh, a path ends where it meets a second diffuse surface, farther off than
// gather_from, whose irradiance is known (finite).
void path_trace(const World& world, const PixelRays& rays, Vec3 origin, int spp, uint64_t seed,
                int bounces, const Environment* environment, const float* irradiance,
                float gather_from, float* radiance);

// Irradiance (count, 3) at points with unit normals, the mean of spp paths each. NaN
// where another face lies within 5 mm in front: its light is not that of the neighbourhood.
void irradiance(const World& world, const float* points, const float* normals, size_t count,
                int spp, uint64_t seed, int bounces, const Environment* environment,
                float* irradiance);

}  // namespace chromeball
