// Three floats: points, directions and linear RGB.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace chromeball {

constexpr float kPi = 3.14159265358979f;

struct Vec3 {
  float x = 0, y = 0, z = 0;

  Vec3() = default;
  constexpr Vec3(float x, float y, float z) : x(x), y(y), z(z) {}
  explicit constexpr Vec3(float s) : x(s), y(s), z(s) {}
  explicit Vec3(const float* p) : x(p[0]), y(p[1]), z(p[2]) {}

  Vec3 operator-() const { return {-x, -y, -z}; }
  Vec3& operator+=(Vec3 b) { x += b.x, y += b.y, z += b.z; return *this; }
  Vec3& operator*=(Vec3 b) { x *= b.x, y *= b.y, z *= b.z; return *this; }
  Vec3& operator*=(float s) { x *= s, y *= s, z *= s; return *this; }
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline Vec3 operator/(Vec3 a, Vec3 b) { return {a.x / b.x, a.y / b.y, a.z / b.z}; }
inline Vec3 operator*(Vec3 a, float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec3 operator*(float s, Vec3 a) { return a * s; }
inline float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline float length2(Vec3 a) { return dot(a, a); }
inline float length(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 normalize(Vec3 a) { return a * (1.0f / length(a)); }
inline float mean(Vec3 a) { return (a.x + a.y + a.z) * (1.0f / 3.0f); }
inline float largest(Vec3 a) { return std::max(a.x, std::max(a.y, a.z)); }
inline float largest_magnitude(Vec3 a) {
  return std::max(std::abs(a.x), std::max(std::abs(a.y), std::abs(a.z)));
}
inline bool is_zero(Vec3 a) { return a.x == 0 && a.y == 0 && a.z == 0; }
inline bool is_finite(Vec3 a) {
  return std::isfinite(a.x) && std::isfinite(a.y) && std::isfinite(a.z);
}
inline Vec3 abs(Vec3 a) { return {std::abs(a.x), std::abs(a.y), std::abs(a.z)}; }
inline Vec3 mix(Vec3 a, Vec3 b, float t) { return (1 - t) * a + t * b; }
inline float mix(float a, float b, float t) { return (1 - t) * a + t * b; }
// Unit length whatever the size of the numbers; `otherwise` for a vector without a direction.
inline Vec3 unit_or(Vec3 a, Vec3 otherwise) {
  const float m = largest_magnitude(a);
  return m > 0 && m < 3e38f ? normalize(a * (1 / m)) : otherwise;
}
inline void add(float* to, Vec3 v) { to[0] += v.x, to[1] += v.y, to[2] += v.z; }
inline Vec3 reflect(Vec3 d, Vec3 n) { return d - 2.0f * dot(d, n) * n; }

// An orthonormal basis around n (Duff et al. 2017).
struct Frame {
  Vec3 s, t, n;
  explicit Frame(Vec3 n) : n(n) {
    const float sign = std::copysign(1.0f, n.z);
    const float a = -1.0f / (sign + n.z);
    const float b = n.x * n.y * a;
    s = {1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x};
    t = {b, sign + n.y * n.y * a, -n.y};
  }
  Vec3 world(Vec3 v) const { return v.x * s + v.y * t + v.z * n; }
  Vec3 local(Vec3 v) const { return {dot(v, s), dot(v, t), dot(v, n)}; }
};

struct Mat3 {
  Vec3 x{1, 0, 0}, y{0, 1, 0}, z{0, 0, 1};  // rows
  Vec3 operator*(Vec3 v) const { return {dot(x, v), dot(y, v), dot(z, v)}; }
};

// Cosine-weighted direction around +z; density cos / pi.
inline Vec3 sample_cosine(float u, float v) {
  const float r = std::sqrt(u), phi = 2.0f * kPi * v;
  return {r * std::cos(phi), r * std::sin(phi), std::sqrt(std::max(0.0f, 1.0f - u))};
}

// The two-strategy power heuristic (Veach 1997, exponent 2).
inline float power_heuristic(float mine, float other) {
  const float a = mine * mine, b = other * other;
  return a / (a + b);
}

}  // namespace chromeball
