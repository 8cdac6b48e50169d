// Vectors, and minimax polynomials in place of libm's calls, which would take most of the time.
// Their errors are below 3e-7 rad, float's own size. All of it is free of branches and always
// inlined, so that the loops around it turn into SIMD.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <numbers>

#define ENVMAP_INLINE [[gnu::always_inline]] inline

namespace envmap {

constexpr float kPi = std::numbers::pi_v<float>;
using Index = std::ptrdiff_t;
typedef float Float4 __attribute__((vector_size(16)));

struct Vec {
  float x, y, z;
};
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline float length(Vec a) { return std::sqrt(dot(a, a)); }

struct Matrix {
  Vec row[3];
  Vec operator*(Vec d) const { return {dot(row[0], d), dot(row[1], d), dot(row[2], d)}; }
  Matrix transposed() const {
    return {{{row[0].x, row[1].x, row[2].x},
             {row[0].y, row[1].y, row[2].y},
             {row[0].z, row[1].z, row[2].z}}};
  }
};

// By value: references keep GCC from SIMD.
ENVMAP_INLINE float least(float a, float b) { return a < b ? a : b; }
ENVMAP_INLINE float most(float a, float b) { return a > b ? a : b; }
ENVMAP_INLINE float within(float a, float low, float high) { return least(most(a, low), high); }

template <std::size_t n>
ENVMAP_INLINE float horner(const float (&c)[n], float s) {
  float p = c[n - 1];
  for (std::size_t k = n - 1; k-- > 0;) p = p * s + c[k];
  return p;
}
ENVMAP_INLINE float arc_tangent(float y, float x) {
  static constexpr float c[] = {9.999999842e-01f,  -3.333306678e-01f, 1.999248358e-01f,
                                -1.420257051e-01f, 1.063675410e-01f,  -7.495445444e-02f,
                                4.258760747e-02f,  -1.600503050e-02f, 2.834064299e-03f};
  const float ax = std::abs(x), ay = std::abs(y), high = most(ax, ay);
  const float t = high > 0 ? least(ax, ay) / high : 0.f;
  float angle = t * horner(c, t * t);
  angle = ay > ax ? kPi / 2 - angle : angle;
  angle = x < 0 ? kPi - angle : angle;
  return y < 0 ? -angle : angle;
}
ENVMAP_INLINE float sine(float x) {  // within a few turns
  static constexpr float c[] = {1.f,
                                -1.666666662e-01f,
                                8.333330978e-03f,
                                -1.984086155e-04f,
                                2.752528711e-06f,
                                -2.388949816e-08f};
  const float k = std::nearbyint(x * (1 / kPi)), r = x - k * kPi, value = r * horner(c, r * r);
  return std::int32_t(k) & 1 ? -value : value;
}
ENVMAP_INLINE float cosine(float x) { return sine(kPi / 2 - x); }

// Linear interpolation in a table over [0, 1].
ENVMAP_INLINE float lookup(const float* table, std::int32_t size, float u) {
  const float s = within(u, 0.f, 1.f) * float(size - 1);
  const std::int32_t cell = std::int32_t(s), i = cell < size - 2 ? cell : size - 2;
  return table[i] + (s - float(i)) * (table[i + 1] - table[i]);
}

}  // namespace envmap
