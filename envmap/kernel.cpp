// Environment maps: mappings, resampling with the energy kept, and a fast way of it.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <numeric>

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
using Lines = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Columns = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
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

// Solid angles with their table; it keeps the arrays alive.
class SolidAngles {
 public:
  SolidAngles(const Projection& map, Plane values, Lines lines, Columns columns)
      : map_(map),
        values_(values),
        columns_(columns),
        begin_(lines.data(), lines.data() + lines.size()),
        solid_{map_, values_.data(), begin_.data(), columns_.data(), values_.shape(1) == 1, false} {
    const auto outside = [](const auto& a, std::size_t n) {
      return std::any_of(a.data(), a.data() + a.size(),
                         [&](auto k) { return k < 0 || std::size_t(k) >= n; });
    };
    if (lines.size() != std::size_t(map.height) || columns.size() != std::size_t(map.width) ||
        outside(lines, values.shape(0)) || outside(columns, values.shape(1)))
      throw nb::value_error("solid angles and map differ in size");
    for (auto& k : begin_) k *= std::int64_t(values.shape(1));
    solid_.holes = std::any_of(values.data(), values.data() + values.size(),
                               [](float v) { return !(v > 0); });
  }
  SolidAngles(const SolidAngles&) = delete;
  SolidAngles& operator=(const SolidAngles&) = delete;
  const Solid& operator*() const { return solid_; }
  const Projection& map() const { return map_; }

  // Rows of the picture, (last - first, W).
  auto rows(int first, int last) const {
    if (first < 0 || last > map_.height || first > last) throw nb::value_error("no such rows");
    float* out;
    const std::size_t w = std::size_t(map_.width);
    auto result = make_array<float, Out<2>>({std::size_t(last - first), w}, out);
    nb::gil_scoped_release release;
    for_rows(first, last, [&](int y) { solid_.row(y, out + w * std::size_t(y - first)); });
    return result;
  }

  // Their sum.
  double total() const {
    std::vector<double> sums(static_cast<std::size_t>(map_.height));
    nb::gil_scoped_release release;
    for_rows(0, map_.height, [&](int y) {
      thread_local std::vector<float> row;
      row.resize(std::size_t(map_.width));
      solid_.row(y, row.data());
      double sum = 0;
#pragma omp simd reduction(+ : sum)
      for (Index x = 0; x < map_.width; ++x) sum += double(row.data()[x]);
      sums[std::size_t(y)] = sum;
    });
    return std::accumulate(sums.begin(), sums.end(), 0.0);
  }

 private:
  Projection map_;
  Plane values_;
  Columns columns_;
  std::vector<std::int64_t> begin_;
  Solid solid_;
};

Source source_of(const Rgb& rgb, const std::optional<Mask>& valid, const SolidAngles& solid,
                 float cap) {
  if (!fits(rgb, solid.map()) || (valid && !fits(*valid, solid.map())))
    throw nb::value_error("arrays and solid angles differ in size");
  return {solid.map(), rgb.data(), valid ? valid->data() : nullptr, *solid, cap};
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
  Resampling(Rgb rgb, std::optional<Mask> valid, std::optional<Rgb> variance,
             const SolidAngles& source, const SolidAngles& target, const Turn& source_from_target,
             float cap, float typical, bool smooth, float reach)
      : rgb_(rgb),
        valid_(valid),
        variance_(variance),
        to_(target.map()),
        target_solid_(*target),
        source_(source_of(rgb_, valid_, source, cap)),
        turn_(matrix_of(source_from_target)),
        warp_(source_, to_, target_solid_, turn_, typical, smooth,
              variance ? variance->data() : nullptr),
        scatter_(source_, to_, target_solid_, turn_, reach) {
    if (variance && !fits(*variance, source.map())) throw nb::value_error("sigma of another size");
  }

  void scatter(const nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig>& hot) {
    nb::gil_scoped_release release;
    for (std::size_t k = 0; k < hot.size(); ++k)
      if (hot.data()[k] < 0 || hot.data()[k] >= Index(rgb_.shape(0) * rgb_.shape(1)))
        throw std::out_of_range("no such pixel");
    hot_.assign(hot.data(), hot.data() + hot.size());
    scatter_.cut_up(hot_.data(), hot_.size());
  }

  auto rows(int first, int last) {
    if (first < 0 || last > to_.height || first >= last) throw nb::value_error("no such rows");
    const std::size_t h = std::size_t(last - first), w = std::size_t(to_.width);
    Band band{first, last, nullptr, nullptr, nullptr, nullptr};
    auto radiance = make_array<float, Out<3>>({h, w, 3}, band.radiance);
    auto coverage = make_array<float, Out<2>>({h, w}, band.coverage);
    auto energy = make_array<double, Result>({h, 4}, band.energy);
    std::optional<Out<3>> variance;
    if (variance_) variance = make_array<float, Out<3>>({h, w, 3}, band.variance);
    {
      nb::gil_scoped_release release;
      warp_.gather(band);
      scatter_.settle(band);
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
    auto sums = make_array<double, Result>({h, 4}, band.energy);
    std::array<double, 3> factor{1, 1, 1};
    {
      nb::gil_scoped_release release;
      Fast(source_, hot_.data(), hot_.size()).gather(to_, target_solid_, turn_, band);
      if (energy) {
        for (std::size_t c = 0; c < 3; ++c) {
          double gathered = 0;
          for (std::size_t y = 0; y < h; ++y) gathered += band.energy[4 * y + c];
          if (gathered > 0) factor[c] = ((*energy)[c] - scatter_.energy()[c]) / gathered;
        }
        for_rows(0, to_.height, [&](int y) {
          float* row = band.radiance + 3 * std::size_t(y) * w;
          for (std::size_t x = 0; x < w; ++x)
            for (std::size_t c = 0; c < 3; ++c) row[3 * x + c] *= float(factor[c]);
        });
      }
      scatter_.settle(band);
      warp_.add_up(band);
    }
    return std::tuple(radiance, coverage, sums, factor);
  }

  void forget() { warp_.forget(); }
  std::array<double, 3> outside() const { return scatter_.outside(); }

 private:
  Rgb rgb_;
  std::optional<Mask> valid_;
  std::optional<Rgb> variance_;
  const Projection& to_;
  const Solid& target_solid_;
  Source source_;
  Matrix turn_;
  std::vector<Index> hot_;
  Warp warp_;
  Scatter scatter_;
};

// Sums of each row, (H, 5), and the number of bad pixels: see survey.h.
auto survey(const Rgb& rgb, const std::optional<Mask>& valid, const SolidAngles& solid, float cap) {
  const Source source = source_of(rgb, valid, solid, cap);
  const Index h = source.projection.height, w = source.projection.width;
  double* out;
  auto sums = make_array<double, Result>({std::size_t(h), 5}, out);
  std::atomic<Index> bad = 0;
  {
    nb::gil_scoped_release release;
    for_rows(0, int(h), [&](int y) {
      RowSums row;
      const float* pixels = source.rgb + 3 * w * y;
      thread_local std::vector<float> omega;
      omega.resize(std::size_t(w));
      const float own = source.solid(0, y);
      const bool even = source.solid.even && !valid;
      if (!even || !survey_plain_row<true>(pixels, &own, w, cap, row)) {
        source.solid.row(y, omega.data());
        if (valid || !survey_plain_row<false>(pixels, omega.data(), w, cap, row))
          row = survey_row(pixels, valid ? valid->data() + w * y : nullptr, omega.data(), w, cap);
      }
      std::copy(row.sum, row.sum + 5, out + 5 * Index(y));
      bad += row.bad;
    });
  }
  return std::tuple(sums, bad.load());
}

// Indices of the usable pixels with a channel above `cap`, in order.
auto hot_pixels(const Rgb& rgb, const std::optional<Mask>& valid, const SolidAngles& solid,
                float cap) {
  const Source source = source_of(rgb, valid, solid, cap);
  const int h = source.projection.height;
  std::vector<std::vector<std::int64_t>> rows(static_cast<std::size_t>(h));
  std::vector<std::int64_t> all;
  {
    nb::gil_scoped_release release;
    for_rows(0, h, [&](int y) { find_hot(source, y, rows[std::size_t(y)]); });
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
  nb::class_<SolidAngles>(m, "SolidAngles")
      .def(nb::init<const Projection&, Plane, Lines, Columns>())
      .def("rows", &SolidAngles::rows)
      .def("total", &SolidAngles::total);
  m.def("survey", &survey, nb::arg("rgb"), nb::arg("valid").none(), nb::arg("solid"),
        nb::arg("cap"));
  m.def("hot_pixels", &hot_pixels, nb::arg("rgb"), nb::arg("valid").none(), nb::arg("solid"),
        nb::arg("cap"));
  nb::class_<Resampling>(m, "Resampling")
      .def(nb::init<Rgb, std::optional<Mask>, std::optional<Rgb>, const SolidAngles&,
                    const SolidAngles&, const Turn&, float, float, bool, float>(),
           nb::arg("rgb"), nb::arg("valid").none(), nb::arg("variance").none(), nb::arg("source"),
           nb::arg("target"), nb::arg("source_from_target"), nb::arg("cap"), nb::arg("typical"),
           nb::arg("smooth"), nb::arg("reach"), nb::keep_alive<1, 5>(), nb::keep_alive<1, 6>())
      .def("scatter", &Resampling::scatter)
      .def("rows", &Resampling::rows)
      .def("fast", &Resampling::fast, nb::arg("energy").none())
      .def("forget", &Resampling::forget)
      .def("outside", &Resampling::outside);
}
