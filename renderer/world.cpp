#include "world.h"

#include <algorithm>
#include <numeric>

namespace chromeball {
namespace {

constexpr int kSplits = 3;  // at most eight spheres a mesh

Mat3 abs(const Mat3& m) { return {abs(m.x), abs(m.y), abs(m.z)}; }

Mat3 product(const Mat3& a, const Mat3& b) {
  const auto row = [&](Vec3 r) { return r.x * b.x + r.y * b.y + r.z * b.z; };
  return {row(a.x), row(a.y), row(a.z)};
}

Mat3 transpose(const Mat3& m) {
  return {{m.x.x, m.y.x, m.z.x}, {m.x.y, m.y.y, m.z.y}, {m.x.z, m.y.z, m.z.z}};
}

Sphere around(std::span<const float> vertices, std::span<const uint32_t> faces,
              std::span<const uint32_t> chosen) {
  Vec3 low(kInfinity), high(-kInfinity);
  const auto each = [&](auto&& use) {
    for (const uint32_t f : chosen) {
      for (int k = 0; k < 3; ++k) use(Vec3(&vertices[3 * faces[3 * f + k]]));
    }
  };
  each([&](Vec3 p) {
    low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
  });
  const Vec3 centre = 0.5f * low + 0.5f * high;
  float r2 = 0;
  each([&](Vec3 p) { r2 = std::max(r2, length2(p - centre)); });
  return {centre, std::sqrt(r2)};
}

// Spheres around parts of a mesh where they are together much smaller than one around it all.
void split(std::span<const float> vertices, std::span<const uint32_t> faces,
           std::span<uint32_t> chosen, const Sphere& whole, int depth,
           std::vector<Sphere>& into) {
  const auto first = [&](uint32_t f) { return Vec3(&vertices[3 * faces[3 * f]]); };
  Vec3 low(kInfinity), high(-kInfinity);
  for (const uint32_t f : chosen) {
    const Vec3 p = first(f);
    low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
  }
  const Vec3 extent = high - low;
  const int axis = extent.x >= largest(extent) ? 0 : extent.y >= largest(extent) ? 1 : 2;
  const float middle = 0.5f * ((&low.x)[axis] + (&high.x)[axis]);
  const auto cut = std::partition(chosen.begin(), chosen.end(), [&](uint32_t f) {
    const Vec3 p = first(f);
    return (&p.x)[axis] < middle;
  });
  const size_t count = size_t(cut - chosen.begin());
  if (depth == 0 || count == 0 || count == chosen.size()) {
    into.push_back(whole);
    return;
  }
  const auto a = chosen.first(count), b = chosen.subspan(count);
  const Sphere one = around(vertices, faces, a), other = around(vertices, faces, b);
  if (one.radius * one.radius + other.radius * other.radius >
      0.75f * whole.radius * whole.radius) {
    into.push_back(whole);
    return;
  }
  split(vertices, faces, a, one, depth - 1, into);
  split(vertices, faces, b, other, depth - 1, into);
}

}  // namespace

uint32_t World::add(const Texture& texture) {
  textures_.push_back(texture);
  return uint32_t(textures_.size() - 1);
}

uint32_t World::add(const Material& material) {
  materials_.push_back(material);
  Material& m = materials_.back();
  settle(m);
  m.power = mean(m.emission);
  if (m.emission_texture >= 0) m.power *= mean(textures_[m.emission_texture].mean());
  transmits_ |= m.transmits;
  return uint32_t(materials_.size() - 1);
}

uint32_t World::add(const MeshView& view) {
  MeshData mesh{view, {}, device_.scene(RTC_BUILD_QUALITY_HIGH), {}};
  if (!view.faces.empty()) {
    mesh.triangles = attach_triangles(device_, mesh.scene.get(), view.vertices.data(),
                                      view.vertices.size() / 3, view.faces.data(),
                                      view.faces.size() / 3);
    std::vector<uint32_t> all(mesh.triangles.size);
    std::iota(all.begin(), all.end(), 0);
    split(view.vertices, view.faces, all, around(view.vertices, view.faces, all), kSplits,
          mesh.bounds);
  }
  rtcCommitScene(mesh.scene.get());
  device_.check();
  for (const uint32_t m : view.material) {
    mesh.shines |= materials_[m].power > 0;
    mesh.sharp |= materials_[m].sharp;
  }
  // the corners are read from Embree's buffers
  mesh.view.vertices = {mesh.triangles.vertices, view.vertices.size()};
  mesh.view.faces = {mesh.triangles.faces, view.faces.size()};
  meshes_.push_back(std::move(mesh));
  return uint32_t(meshes_.size() - 1);
}

Mat3 larger(const Mat3& a, const Mat3& b) {
  const auto row = [](Vec3 a, Vec3 b) {
    return Vec3(std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z));
  };
  return {row(a.x, b.x), row(a.y, b.y), row(a.z, b.z)};
}

void World::set(Instance& instance, const double* matrices, size_t steps) {
  rtcSetGeometryTimeStepCount(instance.geometry.get(), uint32_t(steps));
  instance.steps.clear();
  set_step(instance, matrices, 0);
  if (steps > 1) {
    const Instance first{0, {}, instance.to_world, instance.normal, {}, {}, {}, 0, {}};
    Mat3 size = instance.size, spread = instance.spread;
    Vec3 slack = instance.slack;
    float scale = instance.scale;
    instance.steps.push_back(instance.to_world);
    for (size_t k = 1; k < steps; ++k) {
      set_step(instance, matrices + 12 * k, uint32_t(k));
      instance.steps.push_back(instance.to_world);
      size = larger(size, instance.size), spread = larger(spread, instance.spread);
      slack = larger({slack, {}, {}}, {instance.slack, {}, {}}).x;
      scale = std::max(scale, instance.scale);
    }
    // steps turn little, so that what lies between two of them has about their inverse
    instance.size = size, instance.spread = {1.2f * spread.x, 1.2f * spread.y, 1.2f * spread.z};
    instance.slack = 1.2f * slack, instance.scale = scale;
    instance.to_world = first.to_world, instance.normal = first.normal;
  }
  rtcCommitGeometry(instance.geometry.get());
}

World::Moment World::moment(const Instance& instance, float time) {
  if (instance.steps.empty()) return {instance.to_world, instance.normal};
  const float at = time * float(instance.steps.size() - 1);
  const size_t k = std::min(size_t(at), instance.steps.size() - 2);
  const float w = at - float(k);
  const auto between = [w](Vec3 a, Vec3 b) { return (1 - w) * a + w * b; };
  const Affine &a = instance.steps[k], &b = instance.steps[k + 1];
  const Mat3 m{between(a.linear.x, b.linear.x), between(a.linear.y, b.linear.y),
               between(a.linear.z, b.linear.z)};
  // the cofactors are the inverse transpose times the determinant
  Mat3 normal{cross(m.y, m.z), cross(m.z, m.x), cross(m.x, m.y)};
  const float common = largest_magnitude({largest_magnitude(normal.x),
                                          largest_magnitude(normal.y),
                                          largest_magnitude(normal.z)});
  const float factor = std::copysign(1 / common, dot(m.x, normal.x));
  return {{m, between(a.t, b.t)}, {factor * normal.x, factor * normal.y, factor * normal.z}};
}

void World::set_step(Instance& instance, const double* m, uint32_t step) {
  const auto row = [](const double* r) { return Vec3(float(r[0]), float(r[1]), float(r[2])); };
  const double* r[3] = {m, m + 4, m + 8};
  double inverse[3][3], determinant = 0;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {  // cofactors, transposed
      const double *a = r[(j + 1) % 3], *b = r[(j + 2) % 3];
      const int p = (i + 1) % 3, q = (i + 2) % 3;
      inverse[i][j] = a[p] * b[q] - a[q] * b[p];
    }
  }
  for (int i = 0; i < 3; ++i) determinant += r[0][i] * inverse[i][0];
  if (!(std::abs(determinant) > 0) || !std::isfinite(1 / determinant)) {
    throw std::invalid_argument("the transform of an instance is singular");
  }
  for (auto& line : inverse) {
    for (double& x : line) x /= determinant;
  }
  const double t[3] = {m[3], m[7], m[11]};
  Vec3 back;  // |linear^-1 t|
  float* to = &back.x;
  for (int i = 0; i < 3; ++i) {
    to[i] = float(std::abs(inverse[i][0] * t[0] + inverse[i][1] * t[1] + inverse[i][2] * t[2]));
  }
  instance.to_world = {{row(r[0]), row(r[1]), row(r[2])}, row(t)};
  const Mat3 inv{row(inverse[0]), row(inverse[1]), row(inverse[2])};
  // scaled so that tiny and huge objects have normals of a common size
  const float common = largest_magnitude(
      {largest_magnitude(inv.x), largest_magnitude(inv.y), largest_magnitude(inv.z)});
  const Mat3 turned = transpose(inv);
  instance.normal = {turned.x * (1 / common), turned.y * (1 / common), turned.z * (1 / common)};
  instance.size = abs(instance.to_world.linear);
  instance.spread = product(instance.size, abs(inv));
  instance.slack = instance.size * back + abs(instance.to_world.t);
  const Mat3 columns = transpose(instance.to_world.linear);
  // Gershgorin's bound of the largest singular value is tight for scaled rotations
  const auto overlap = [&](Vec3 c) {
    return std::abs(dot(c, columns.x)) + std::abs(dot(c, columns.y)) +
           std::abs(dot(c, columns.z));
  };
  instance.scale =
      std::sqrt(std::max({overlap(columns.x), overlap(columns.y), overlap(columns.z)}));
  const float matrix[12] = {columns.x.x, columns.x.y, columns.x.z, columns.y.x,
                            columns.y.y, columns.y.z, columns.z.x, columns.z.y,
                            columns.z.z, instance.to_world.t.x, instance.to_world.t.y,
                            instance.to_world.t.z};
  rtcSetGeometryTransform(instance.geometry.get(), step, RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR,
                          matrix);
}

uint32_t World::place(uint32_t mesh, const double* matrices, size_t steps) {
  if (!top_) top_ = device_.scene(RTC_BUILD_QUALITY_LOW);
  Instance instance{};
  instance.mesh = mesh;
  instance.geometry.reset(rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_INSTANCE));
  rtcSetGeometryInstancedScene(instance.geometry.get(), meshes_[mesh].scene.get());
  set(instance, matrices, steps);
  const uint32_t k = uint32_t(instances_.size());
  rtcAttachGeometryByID(top_.get(), instance.geometry.get(), k);
  instances_.push_back(std::move(instance));
  return k;
}

void World::commit() {
  if (!top_) top_ = device_.scene(RTC_BUILD_QUALITY_LOW);
  rtcCommitScene(top_.get());
  device_.check();
  find_bounds();
  find_emitters();
}

void World::move(uint32_t k, const double* matrices, size_t steps) {
  if (k >= instances_.size()) throw std::out_of_range("there is no such instance");
  set(instances_[k], matrices, steps);
  rtcCommitScene(top_.get());
  device_.check();
  find_bounds();
  if (meshes_[instances_[k].mesh].shines) find_emitters();
}

size_t World::triangles() const {
  size_t sum = 0;
  for (const Instance& i : instances_) sum += meshes_[i.mesh].triangles.size;
  return sum;
}

Sphere World::bound(uint32_t instance) const {
  const Instance& of = instances_[instance];
  const auto& spheres = meshes_[of.mesh].bounds;
  Sphere all{{}, 0};
  for (const Sphere& s : spheres) all.centre += s.centre * (1 / float(spheres.size()));
  for (const Sphere& s : spheres) {
    all.radius = std::max(all.radius, length(s.centre - all.centre) + s.radius);
  }
  return {of.to_world.point(all.centre), of.scale * all.radius};
}

void World::find_bounds() {
  bounds_.clear(), sharp_bounds_.clear();
  for (const Instance& i : instances_) {
    for (const Sphere& s : meshes_[i.mesh].bounds) {
      Vec3 low = i.to_world.point(s.centre), high = low;  // of the centre's path
      for (const Affine& step : i.steps) {
        const Vec3 c = step.point(s.centre);
        low = {std::min(low.x, c.x), std::min(low.y, c.y), std::min(low.z, c.z)};
        high = {std::max(high.x, c.x), std::max(high.y, c.y), std::max(high.z, c.z)};
      }
      const Vec3 c = 0.5f * low + 0.5f * high;
      const float rounding = kLift * (largest_magnitude(c) + largest_magnitude(i.slack));
      const float path = 0.5f * length(high - low);
      bounds_.push_back({c, s.radius * i.scale * (1 + 1e-5f) + path + rounding});
      if (meshes_[i.mesh].sharp) sharp_bounds_.push_back(bounds_.back());
    }
  }
}

void World::find_emitters() {
  emissive_.clear();
  std::vector<float> power;
  for (uint32_t k = 0; k < instances_.size(); ++k) {
    const Instance& i = instances_[k];
    const MeshData& mesh = meshes_[i.mesh];
    if (!mesh.shines) continue;
    for (uint32_t f = 0; f < mesh.triangles.size; ++f) {
      const Material& m = materials_[mesh.view.material[f]];
      if (!(m.power > 0)) continue;
      const Vec3 a = mesh.triangles.corner(f, 0);
      const Vec3 n = cross(i.to_world.linear * (mesh.triangles.corner(f, 1) - a),
                           i.to_world.linear * (mesh.triangles.corner(f, 2) - a));
      emissive_.push_back({k, f});
      power.push_back(0.5f * length(n) * m.power);
    }
  }
  emitters_ = Distribution(power);
  inverse_power_ = emitters_.empty() ? 0 : float(1 / emitters_.sum());
}

Vec3 World::interpolate(const float* values, const Hit& hit) const {
  const uint32_t* f = &meshes_[instances_[hit.instance].mesh].triangles.faces[3 * hit.face];
  return (1 - hit.u - hit.v) * Vec3(values + 3 * f[0]) + hit.u * Vec3(values + 3 * f[1]) +
         hit.v * Vec3(values + 3 * f[2]);
}

Surface World::surface_at(const Hit& hit, Vec3 d) const {
  const Instance& instance = instances_[hit.instance];
  const auto [to_world, normal] = moment(instance, hit.time);
  const MeshData& mesh = meshes_[instance.mesh];
  const uint32_t* f = mesh.triangles.faces + 3 * hit.face;
  const float* vertices = mesh.triangles.vertices;
  const Vec3 a(vertices + 3 * f[0]), b(vertices + 3 * f[1]), c(vertices + 3 * f[2]);
  const float w = 1 - hit.u - hit.v;
  const Material& m = materials_[mesh.view.material[hit.face]];

  Surface s;
  s.material = &m;
  // nearer to the face than o + t d
  s.p = to_world.point(w * a + hit.u * b + hit.v * c);
  const Vec3 e1 = b - a, e2 = c - a;
  // edges of a common size: their product must not vanish for tiny faces
  const float grow = 1 / std::max(std::max(largest_magnitude(e1), largest_magnitude(e2)), 1e-37f);
  s.ng = unit_or(normal * cross(e1 * grow, e2 * grow), -d);
  s.outside = dot(s.ng, d) < 0;
  if (!s.outside) s.ng = -s.ng;
  const Vec3 size = instance.size * (w * abs(a) + hit.u * abs(b) + hit.v * abs(c)) +
                    instance.spread * abs(s.p) + instance.slack;
  s.rise = rise(size, s.ng);

  Vec3 ns = s.ng;
  if (!mesh.view.normals.empty()) {
    const float* normals = mesh.view.normals.data();
    const Vec3 n = w * Vec3(normals + 3 * f[0]) + hit.u * Vec3(normals + 3 * f[1]) +
                   hit.v * Vec3(normals + 3 * f[2]);
    if (length2(n) > 1e-12f) {
      const Vec3 smooth = unit_or(normal * n, s.ng);
      ns = s.outside ? smooth : -smooth;
    }
  }
  float u = 0, v = 0;
  if (!mesh.view.uv.empty()) {
    const float* uv = mesh.view.uv.data();
    const float *ta = uv + 2 * f[0], *tb = uv + 2 * f[1], *tc = uv + 2 * f[2];
    u = w * ta[0] + hit.u * tb[0] + hit.v * tc[0];
    v = w * ta[1] + hit.u * tb[1] + hit.v * tc[1];
    if (m.normal_texture >= 0) {
      // the tangent runs along growing u, the bitangent along growing v (glTF 2.0, 3.7.2.1)
      const float u1 = tb[0] - ta[0], v1 = tb[1] - ta[1];
      const float u2 = tc[0] - ta[0], v2 = tc[1] - ta[1];
      const float turn = u1 * v2 - u2 * v1 < 0 ? -1.0f : 1.0f;
      const Mat3& linear = to_world.linear;
      const Vec3 along = turn * (linear * (v2 * e1 - v1 * e2));
      const Vec3 across = turn * (linear * (u1 * e2 - u2 * e1));
      const Vec3 t = unit_or(along - dot(along, ns) * ns, {});
      if (!is_zero(t)) {
        Vec3 bitangent = cross(ns, t);
        if (dot(bitangent, across) < 0) bitangent = -bitangent;
        Vec3 bump = 2.0f * textures_[m.normal_texture].at(u, v).rgb() - Vec3(1.0f);
        bump.x *= m.normal_scale, bump.y *= m.normal_scale;
        const float side = s.outside ? 1.0f : -1.0f;  // the bump stays on its own side
        ns = unit_or(side * (bump.x * t + bump.y * bitangent) + bump.z * ns, ns);
      }
    }
  }
  // a normal that turns away from the ray or from the face would send light through it
  s.ns = dot(ns, d) < -1e-3f && dot(ns, s.ng) > 0 ? ns : s.ng;

  s.model = m.model;
  s.base = m.base;
  s.emission = m.emission;
  s.alpha = m.alpha;
  s.metallic = m.metallic;
  s.roughness = m.roughness;
  if (m.base_texture >= 0) {
    const auto texel = textures_[m.base_texture].at(u, v);
    for (int k = 0; k < 3; ++k) (&s.base.x)[k] *= std::clamp(texel.c[k], 0.0f, 1.0f);
    s.alpha *= texel.c[3];
  }
  if (m.metallic_roughness_texture >= 0) {
    const auto texel = textures_[m.metallic_roughness_texture].at(u, v);
    s.roughness *= std::clamp(texel.c[1], 0.0f, 1.0f);
    s.metallic *= std::clamp(texel.c[2], 0.0f, 1.0f);
  }
  s.transmission = m.transmission * (1 - s.metallic);
  if (m.emission_texture >= 0) s.emission *= textures_[m.emission_texture].at(u, v).rgb();
  switch (m.alpha_mode) {
    case AlphaMode::opaque: s.alpha = 1; break;
    case AlphaMode::mask: s.alpha = s.alpha < m.alpha_cutoff ? 0 : 1; break;
    case AlphaMode::blend: s.alpha = std::clamp(s.alpha, 0.0f, 1.0f); break;
  }
  if (s.alpha < 1) s.emission *= s.alpha;
  return s;
}

Vec3 World::transmittance(Vec3 o, Vec3 d, float tfar, float time) const {
  if (!transmits_) return Vec3(occluded(o, d, tfar, time) ? 0.0f : 1.0f);
  Vec3 share(1.0f);
  for (int k = 0; k < 256; ++k) {
    const Hit hit = intersect(o, d, tfar, time);
    if (!hit) return share;
    if (!material(hit).transmits) return {};
    const Surface s = surface_at(hit, d);
    share *= transmit(s, -d);
    if (is_zero(share)) return {};
    const Vec3 next = s.start(d);
    tfar -= dot(next - o, d) / length2(d);
    if (!(tfar > 0)) return share;
    o = next;
  }
  return {};
}

World::Emitter World::sample_emitter(Pair u, float time) const {
  const auto pick = emitters_.sample(u.bits);
  const Face at = emissive_[pick.index];
  const float root = std::sqrt(pick.rest);
  Hit hit;
  hit.instance = at.instance, hit.face = at.face, hit.time = time;
  hit.u = root * (1 - u.y), hit.v = root * u.y;
  const Triangles& t = meshes_[instances_[at.instance].mesh].triangles;
  const Vec3 a = t.corner(at.face, 0);
  const Mat3 normal = moment(instances_[at.instance], time).normal;
  const Vec3 n = unit_or(normal * cross(t.corner(at.face, 1) - a, t.corner(at.face, 2) - a), {});
  const Surface s = surface_at(hit, -n);
  return {s.p, n, s.emission, emitter_density(hit), s.rise};
}

}  // namespace chromeball
