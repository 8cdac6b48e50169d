// Resampling of a frame that invents no codes; numpy reference in tests/hdr.

#include <oneapi/tbb/blocked_range.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <type_traits>

#include "kernel.h"

namespace {

template <typename T>
using Picture = nb::ndarray<const T, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

// Catmull-Rom weights of the pixels at -1, 0, 1, 2 (Keys 1981, a = -1/2).
inline std::array<float, 4> cubic(float u) {
  return {u * (-0.5f + u * (1 - 0.5f * u)), 1 + u * u * (-2.5f + 1.5f * u),
          u * (0.5f + u * (2 - 1.5f * u)), u * u * (-0.5f + 0.5f * u)};
}

struct Size {
  std::ptrdiff_t height, width;
};

template <typename T, std::size_t C>
void warp_rows(const T* in, Size size, const double* M, T white, bool held, T* out, bool* valid,
               std::ptrdiff_t from, std::ptrdiff_t to) {
  const auto [height, width] = size;
  for (std::ptrdiff_t y = from; y < to; ++y)
    for (std::ptrdiff_t x = 0; x < width; ++x) {
      const std::ptrdiff_t at = y * width + x;
      const double w = M[6] * x + M[7] * y + M[8];
      double sx = (M[0] * x + M[1] * y + M[2]) / w, sy = (M[3] * x + M[4] * y + M[5]) / w;
      // rounding of the transform is no reason to lose the border
      constexpr double slack = 1e-6;
      const bool inside = sx >= -slack && sy >= -slack && sx <= width - 1 + slack &&
                          sy <= height - 1 + slack;
      valid[at] = inside;
      if (!inside) {
        std::fill_n(out + at * C, C, T(0));
        continue;
      }
      if (std::abs(sx - std::round(sx)) < slack) sx = std::round(sx);
      if (std::abs(sy - std::round(sy)) < slack) sy = std::round(sy);
      const auto x0 = static_cast<std::ptrdiff_t>(sx), y0 = static_cast<std::ptrdiff_t>(sy);
      const float u = static_cast<float>(sx - x0), v = static_cast<float>(sy - y0);
      if (u == 0 && v == 0) {
        std::copy_n(in + (y0 * width + x0) * C, C, out + at * C);
        continue;
      }
      const auto wx = cubic(u), wy = cubic(v);
      std::array<std::ptrdiff_t, 4> cx, cy;
      for (int k = 0; k < 4; ++k) {
        cx[k] = std::clamp<std::ptrdiff_t>(x0 + k - 1, 0, width - 1);
        cy[k] = std::clamp<std::ptrdiff_t>(y0 + k - 1, 0, height - 1) * width;
      }
      const int lastx = u > 0 ? 2 : 1, lasty = v > 0 ? 2 : 1;
      for (std::size_t c = 0; c < C; ++c) {
        T low = in[(cy[1] + cx[1]) * C + c], high = low;
        for (int j = 1; j <= lasty; ++j)
          for (int i = 1; i <= lastx; ++i) {
            const T value = in[(cy[j] + cx[i]) * C + c];
            low = std::min(low, value);
            high = std::max(high, value);
          }
        T& result = out[at * C + c];
        if (held && (high >= white || low <= T(0))) {
          result = high >= white ? high : T(0);
          continue;
        }
        float sum = 0;
        for (int j = 0; j < 4; ++j) {
          float row = 0;
          for (int i = 0; i < 4; ++i) row += wx[i] * static_cast<float>(in[(cy[j] + cx[i]) * C + c]);
          sum += wy[j] * row;
        }
        if (held) sum = std::clamp(sum, static_cast<float>(low), static_cast<float>(high));
        if constexpr (std::is_integral_v<T>)  // unheld sums may leave the type's range
          result = static_cast<T>(std::clamp(sum, 0.0f, static_cast<float>(white)) + 0.5f);
        else
          result = sum;
      }
    }
}

// M: output pixel -> input pixel. Held: within the four nearest pixels, clipped if one of them is.
template <typename T>
nb::tuple warp(Picture<T> frame, Table2 M, double white, bool held) {
  const Size size{static_cast<std::ptrdiff_t>(frame.shape(0)),
                  static_cast<std::ptrdiff_t>(frame.shape(1))};
  const std::size_t C = frame.shape(2), pixels = frame.shape(0) * frame.shape(1);
  if (M.shape(0) != 3 || M.shape(1) != 3) throw std::invalid_argument("a 3 x 3 transform");
  if (C != 1 && C != 3) throw std::invalid_argument("one or three channels");
  std::unique_ptr<T[]> out(new T[pixels * C]);
  std::unique_ptr<bool[]> valid(new bool[pixels]);
  {
    nb::gil_scoped_release release;
    const auto run = C == 1 ? warp_rows<T, 1> : warp_rows<T, 3>;
    tbb::parallel_for(tbb::blocked_range<std::ptrdiff_t>(0, size.height, 16), [&](const auto& r) {
      run(frame.data(), size, M.data(), static_cast<T>(white), held, out.get(), valid.get(), r.begin(),
          r.end());
    });
  }
  return nb::make_tuple(to_numpy(std::move(out), {frame.shape(0), frame.shape(1), C}),
                        to_numpy(std::move(valid), {frame.shape(0), frame.shape(1)}));
}

}  // namespace

void bind_align(nb::module_& m) {
  m.def("warp_u8", &warp<std::uint8_t>, nb::arg("frame"), nb::arg("inverse"), nb::arg("white"),
        nb::arg("held") = true);
  m.def("warp_u16", &warp<std::uint16_t>, nb::arg("frame"), nb::arg("inverse"), nb::arg("white"),
        nb::arg("held") = true);
  m.def("warp_f32", &warp<float>, nb::arg("frame"), nb::arg("inverse"), nb::arg("white"),
        nb::arg("held") = true);
}
