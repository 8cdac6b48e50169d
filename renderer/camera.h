// Rays of a camera: directions at the corners of its pixels, so that any calibrated lens will
// do; the pixel's filter, the aperture and the shutter on top.
#pragma once

#include "embree.h"
#include "sampler.h"
#include "vec.h"

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

// What a camera has beyond a pinhole that sees the pixel's area at one moment.
struct Lens {
  // The reconstruction filter by its quantiles along an axis, pixels from the centre: samples
  // are drawn from it instead of being weighted (Ernst, Stamminger, Greiner 2006).
  const float* filter = nullptr;
  int quantiles = 0;
  // A thin lens: radius of the aperture and distance in focus, metres. With an axis (unit) a
  // plane across it is in focus, else a sphere.
  float radius = 0, focus = kInfinity;
  Vec3 axis;
  // Rays get a time in 0..1 of the shutter's opening. Until it closes the camera moves by
  // `shift` and turns about `pivot` (unit) by `angle`.
  bool shutter = false;
  Vec3 shift, pivot;
  float angle = 0;
};

struct CameraRay {
  Vec3 o, d;
  float time = 0;
};

struct Camera {
  PixelRays rays;
  Vec3 origin;
  Lens lens{};

  bool sees(int y, int x) const { return is_finite(rays.direction(y, x, 0.5f, 0.5f)); }

  // A ray of a pixel that is seen; takes as many numbers as the lens needs.
  CameraRay sample(int y, int x, Sampler& sampler) const {
    const Pair u = sampler.pair();
    CameraRay ray{origin, lens.filter ? filtered(y, x, u) : rays.direction(y, x, u.x, u.y)};
    Vec3 axis = lens.axis;
    if (lens.shutter) {
      ray.time = sampler.pair().x;
      ray.o += ray.time * lens.shift;
      if (lens.angle != 0) {
        const float c = std::cos(ray.time * lens.angle), s = std::sin(ray.time * lens.angle);
        ray.d = turned(ray.d, c, s), axis = turned(axis, c, s);
      }
    }
    if (lens.radius > 0) {
      const Pair v = sampler.pair();
      const bool plane = !is_zero(axis);
      const float along = plane ? dot(ray.d, axis) : 1;
      if (along > 1e-3f) {
        const Frame disc(plane ? axis : ray.d);
        const float r = lens.radius * std::sqrt(v.x), phi = 2 * kPi * v.y;
        const Vec3 off = r * std::cos(phi) * disc.s + r * std::sin(phi) * disc.t;
        ray.o += off;
        ray.d = normalize(ray.d - (along / lens.focus) * off);
      }
    }
    return ray;
  }

 private:
  float quantile(float u) const {
    const float at = u * float(lens.quantiles - 1);
    const int i = std::min(int(at), lens.quantiles - 2);
    return lens.filter[i] + (at - float(i)) * (lens.filter[i + 1] - lens.filter[i]);
  }

  // The filter is wider than the pixel: its samples lie in neighbours, too. At the rim of the
  // picture or of the lens the pixel's own directions go on.
  Vec3 filtered(int y, int x, Pair u) const {
    const float px = 0.5f + quantile(u.x), py = 0.5f + quantile(u.y);
    const int nx = std::clamp(x + int(std::floor(px)), 0, rays.width - 1);
    const int ny = std::clamp(y + int(std::floor(py)), 0, rays.height - 1);
    const Vec3 d = rays.direction(ny, nx, px - float(nx - x), py - float(ny - y));
    return is_finite(d) ? d : rays.direction(y, x, px, py);
  }

  Vec3 turned(Vec3 v, float c, float s) const {  // Rodrigues
    return c * v + s * cross(lens.pivot, v) + (1 - c) * dot(lens.pivot, v) * lens.pivot;
  }
};

}  // namespace chromeball
