// The reference: unidirectional path tracing with full light transport.
#pragma once

#include "camera.h"
#include "light.h"
#include "world.h"

namespace chromeball {

// Fills radiance (H, W, 3): the mean of `spp` paths of at most `bounces` scatterings. With
// irradiance (V, 3), at the vertices of a world of one mesh, a path ends where it meets a second diffuse surface, farther off than
// gather_from, whose irradiance is known (finite).
void path_trace(const World& world, const Camera& camera, int spp, uint64_t seed, int bounces,
                const Environment* environment, const float* irradiance, float gather_from,
                float* radiance);

// Irradiance (count, 3) at points with unit normals, the mean of spp paths each. NaN
// where another face lies within 5 mm in front: its light is not that of the neighbourhood.
void irradiance(const World& world, const float* points, const float* normals, size_t count,
                int spp, uint64_t seed, int bounces, const Environment* environment,
                float* irradiance);

}  // namespace chromeball
