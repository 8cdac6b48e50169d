// Environment maps: mappings, resampling with the energy kept, and a fast way of it.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "fast.h"
#include "survey.h"
#include "warp.h"

namespace nb = nanobind;
using namespace envmap;

namespace {

using Table = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Rgb = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Plane = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Turn = nb::ndarray<const double, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Result = nb::ndarray<nb::numpy, double, nb::ndim<2>>;
template <int n>
using Out = nb::ndarray<nb::numpy, float, nb::ndim<n>>;

template <class T, class Array>
Array make_array(std::initializer_list<std::size_t> shape, T*& data, bool zero = true) {
  std::size_t count = 1;
  for (const std::size_t n : shape) count *= n;
  data = zero ? new T[count]() : new T[count];
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return Array(data, shape, owner);
}

bool fits(const auto& array, const Projection& p) {
  return array.shape(0) == std::size_t(p.height) && array.shape(1) == std::size_t(p.width);
}

// (H, W), or (H, 1) where a row is all the same.
Solid solid_of(const Plane& plane, const Projection& p) {
  if (plane.shape(0) != std::size_t(p.height) ||
      (plane.shape(1) != std::size_t(p.width) && plane.shape(1) != 1))
    throw nb::value_error("solid angles and map differ in size");
  return {plane.data(), plane.shape(1) == 1 ? 0 : 1, Index(plane.shape(1))};
}

Matrix matrix_of(const Turn& turn) {
  Matrix m{};
  for (std::size_t i = 0; i < 3; ++i)
    m.row[i] = {float(turn(i, 0)), float(turn(i, 1)), float(turn(i, 2))};
  return m;
}

// A resampling under way; it keeps the arrays that it looks at alive.
class Resampling {
 public:
  Resampling(Rgb rgb, std::optional<Mask> valid, Plane source_solid, Plane target_solid,
             std::optional<Rgb> variance, const Projection& from, const Projection& to,
             const Turn& source_from_target, float cap, float typical, bool smooth)
      : rgb_(rgb),
        valid_(valid),
        source_solid_(source_solid),
        target_solid_(target_solid),
        variance_(variance),
        from_(from),
        to_(to),
        source_{from_, rgb.data(), valid ? valid->data() : nullptr, solid_of(source_solid, from_),
                cap},
        turn_(matrix_of(source_from_target)),
        warp_(source_, to_, solid_of(target_solid, to_), turn_, typical, smooth, 
              variance ? variance->data() : nullptr) {
    if (!fits(rgb, from) || (valid && !fits(*valid, from)) || (variance && !fits(*variance, from)))
      throw nb::value_error("arrays and projections differ in size");
  }

  void scatter(const nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig>& hot) {
    nb::gil_scoped_release release;
    for (std::size_t k = 0; k < hot.size(); ++k)
      if (hot.data()[k] < 0 || hot.data()[k] >= Index(from_.width) * from_.height)
        throw std::out_of_range("no such pixel");
    hot_.assign(hot.data(), hot.data() + hot.size());
    warp_.scatter(hot_.data(), hot_.size());
  }

  auto rows(int first, int last) {
    if (first < 0 || last > to_.height || first >= last) throw nb::value_error("no such rows");
    const std::size_t h = std::size_t(last - first), w = std::size_t(to_.width);
    Band band{first, last, nullptr, nullptr, nullptr, nullptr};
    auto radiance = make_array<float, Out<3>>({h, w, 3}, band.radiance);
    auto coverage = make_array<float, Out<2>>({h, w}, band.coverage);
    auto energy = make_array<double, Result>({h, 3}, band.energy);
    std::optional<Out<3>> variance;
    if (variance_) variance = make_array<float, Out<3>>({h, w, 3}, band.variance);
    {
      nb::gil_scoped_release release;
      warp_.gather(band);
      warp_.settle(band);
      warp_.add_up(band);
    }
    return std::tuple(radiance, coverage, variance, energy);
  }

  // All of it, the fast way. `energy` of the source's channels: balanced with it, or null.
  auto fast(const std::optional<std::array<double, 3>>& energy) {
    const std::size_t h = std::size_t(to_.height), w = std::size_t(to_.width);
    Band band{0, to_.height, nullptr, nullptr, nullptr, nullptr};
    auto radiance = make_array<float, Out<3>>({h, w, 3}, band.radiance, false);
    auto coverage = make_array<float, Out<2>>({h, w}, band.coverage, false);
    auto sums = make_array<double, Result>({h, 3}, band.energy);
    std::array<double, 3> factor{1, 1, 1};
    {
      nb::gil_scoped_release release;
      const Solid solid = solid_of(target_solid_, to_);
      Fast(source_, hot_.data(), hot_.size()).gather(to_, solid, turn_, band);
      if (energy) {
        for (std::size_t c = 0; c < 3; ++c) {
          double gathered = 0;
          for (std::size_t y = 0; y < h; ++y) gathered += band.energy[3 * y + c];
          if (gathered > 0) factor[c] = ((*energy)[c] - warp_.scattered()[c]) / gathered;
        }
        for_rows(0, to_.height, [&](int y) {
          float* row = band.radiance + 3 * std::size_t(y) * w;
          for (std::size_t x = 0; x < w; ++x)
            for (std::size_t c = 0; c < 3; ++c) row[3 * x + c] *= float(factor[c]);
        });
      }
      warp_.settle(band);
      warp_.add_up(band);
    }
    return std::tuple(radiance, coverage, sums, factor);
  }

  void forget() { warp_.forget(); }
  std::array<double, 3> outside() const { return warp_.tally().outside; }

 private:
  Rgb rgb_;
  std::optional<Mask> valid_;
  Plane source_solid_, target_solid_;
  std::optional<Rgb> variance_;
  Projection from_, to_;
  Source source_;
  Matrix turn_;
  std::vector<Index> hot_;
  Warp warp_;
};

// Sums of each row, (H, 5), and the number of bad pixels: see survey.h.
auto survey(const Rgb& rgb, const std::optional<Mask>& valid, const Plane& solid, float cap) {
  const Index h = Index(rgb.shape(0)), w = Index(rgb.shape(1));
  const Projection shape{.width = int(w), .height = int(h)};
  const Solid omega = solid_of(solid, shape);
  if (valid && !fits(*valid, shape)) throw nb::value_error("mask and map differ in size");
  double* out;
  auto sums = make_array<double, Result>({std::size_t(h), 5}, out);
  std::atomic<Index> bad = 0;
  {
    nb::gil_scoped_release release;
    for_rows(0, int(h), [&](int y) {
      RowSums row;
      const bool even = omega.across == 0 && !valid;
      if (!even || !survey_even_row(rgb.data() + 3 * w * y, omega(0, y), w, cap, row))
        row = survey_row(rgb.data() + 3 * w * y, valid ? valid->data() + w * y : nullptr,
                                     omega.values + omega.down * y, omega.across, w, cap);
      std::copy(row.sum, row.sum + 5, out + 5 * Index(y));
      bad += row.bad;
    });
  }
  return std::tuple(sums, bad.load());
}

// Indices of the usable pixels with a channel above `cap`, in order.
auto hot_pixels(const Rgb& rgb, const std::optional<Mask>& valid, const Plane& solid, float cap) {
  const Index h = Index(rgb.shape(0)), w = Index(rgb.shape(1));
  const Projection shape{.width = int(w), .height = int(h)};
  const Solid omega = solid_of(solid, shape);
  if (valid && !fits(*valid, shape)) throw nb::value_error("mask and map differ in size");
  std::vector<std::vector<std::int64_t>> rows(static_cast<std::size_t>(h));
  std::vector<std::int64_t> all;
  {
    nb::gil_scoped_release release;
    for_rows(0, int(h), [&](int y) {
      find_hot(rgb.data() + 3 * w * y, valid ? valid->data() + w * y : nullptr,
               omega.values + omega.down * y, omega.across, w, cap, w * y, rows[std::size_t(y)]);
    });
    for (const auto& row : rows) all.insert(all.end(), row.begin(), row.end());
  }
  std::int64_t* out;
  using Indices = nb::ndarray<nb::numpy, std::int64_t, nb::ndim<1>>;
  auto result = make_array<std::int64_t, Indices>({all.size()}, out);
  std::copy(all.begin(), all.end(), out);
  return result;
}

std::vector<float> copy(const Table& table) {
  return {table.data(), table.data() + table.size()};
}

Projection make_cube(int width, int height, int face, const Table& axes, const Table& places) {
  if (axes.size() != 54 || places.size() != 12) throw nb::value_error("a cube has six faces");
  Projection p{.kind = Projection::Kind::cube, .width = width, .height = height, .face = face};
  for (std::size_t k = 0; k < 6; ++k) {
    const float *a = axes.data() + 9 * k, *q = places.data() + 2 * k;
    p.faces[k] = {{a[0], a[1], a[2]}, {a[3], a[4], a[5]}, {a[6], a[7], a[8]}, q[0], q[1]};
  }
  return p;
}

// Pixels of the picture, (N, 2); NaN where unseen.
Result project(const Projection& p, const Doubles& directions) {
  const std::size_t n = directions.shape(0);
  double* out;
  auto result = make_array<double, Result>({n, 2}, out);
  Rays rays{};
  Places places;
  for (std::size_t k = 0; k < n; ++k) {
    rays.set(0, {float(directions(k, 0)), float(directions(k, 1)), float(directions(k, 2))});
    p.project(rays, 1, places);
    const bool seen = places.sheet[0] >= 0;
    const Cell corner = seen ? p.pixel(places.sheet[0], 0, 0) : Cell{};
    out[2 * k] = seen ? double(places.x[0]) + corner.x : NAN;
    out[2 * k + 1] = seen ? double(places.y[0]) + corner.y : NAN;
  }
  return result;
}

// Directions and dOmega / dA, (N, 4); NaN where there is none.
Result unproject(const Projection& p, const Doubles& pixels) {
  const std::size_t n = pixels.shape(0);
  double* out;
  auto result = make_array<double, Result>({n, 4}, out);
  Rays rays{};
  for (std::size_t k = 0; k < n; ++k) {
    const float x = float(pixels(k, 0)), y = float(pixels(k, 1));
    p.unproject(&x, &y, 1, rays);
    const double values[4] = {rays.x[0], rays.y[0], rays.z[0], rays.jacobian[0]};
    for (std::size_t c = 0; c < 4; ++c) out[4 * k + c] = rays.jacobian[0] > 0 ? values[c] : NAN;
  }
  return result;
}

}  // namespace

NB_MODULE(kernel, m) {
  nb::set_leak_warnings(false);  // a mapping kept in a global is no leak
  using Kind = Projection::Kind;
  nb::class_<Projection>(m, "Projection")
      .def_static("latlong",
                  [](int width, int height) {
                    return Projection{.kind = Kind::latlong, .width = width, .height = height};
                  })
      .def_static("octahedral",
                  [](int width, int height) {
                    return Projection{.kind = Kind::octahedral, .width = width, .height = height};
                  })
      .def_static("cube", &make_cube)
      .def_static("radial",
                  [](int width, int height, float fx, float fy, float cx, float cy,
                     float max_angle, float rim, const Table& radius, const Table& angle,
                     const Table& density) {
                    return Projection{.kind = Kind::radial, .width = width, .height = height,
                                      .fx = fx, .fy = fy, .cx = cx, .cy = cy,
                                      .max_angle = max_angle, .rim = rim, .radius = copy(radius),
                                      .angle = copy(angle), .density = copy(density)};
                  })
      .def_static("table",
                  [](int width, int height, int nodes, const Table& pixels,
                     const Table& directions) {
                    if (pixels.size() != std::size_t(12) * nodes * nodes ||
                        directions.size() != std::size_t(3) * (width + 1) * (height + 1))
                      throw nb::value_error("tables of the wrong size");
                    return Projection{.kind = Kind::table, .width = width, .height = height,
                                      .nodes = nodes, .pixels = copy(pixels),
                                      .directions = copy(directions)};
                  })
      .def("project", &project)
      .def("unproject", &unproject);
  m.def("survey", &survey, nb::arg("rgb"), nb::arg("valid").none(), nb::arg("solid"),
        nb::arg("cap"));
  m.def("hot_pixels", &hot_pixels, nb::arg("rgb"), nb::arg("valid").none(), nb::arg("solid"),
        nb::arg("cap"));
  nb::class_<Resampling>(m, "Resampling")
      .def(nb::init<Rgb, std::optional<Mask>, Plane, Plane, std::optional<Rgb>, const Projection&,
                    const Projection&, const Turn&, float, float, bool>(),
           nb::arg("rgb"), nb::arg("valid").none(), nb::arg("source_solid"),
           nb::arg("target_solid"), nb::arg("variance").none(), nb::arg("source"),
           nb::arg("target"), nb::arg("source_from_target"), nb::arg("cap"), nb::arg("typical"),
           nb::arg("smooth"))
      .def("scatter", &Resampling::scatter)
      .def("rows", &Resampling::rows)
      .def("fast", &Resampling::fast, nb::arg("energy").none())
      .def("forget", &Resampling::forget)
      .def("outside", &Resampling::outside);
}
