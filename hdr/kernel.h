// What the hdr room's kernels share: arrays in, arrays out.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <cstddef>
#include <initializer_list>
#include <memory>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;

constexpr std::size_t codes = 256;

template <typename T>
using Frame = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Table1 = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table2 = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

template <typename T>
nb::object to_numpy(std::unique_ptr<T[]> data, std::initializer_list<std::size_t> shape) {
  T* raw = data.release();
  nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, T>(raw, shape, owner));
}

template <typename T>
struct Stack {
  std::vector<const T*> data;
  std::size_t pixels = 0, channels = 0;

  explicit Stack(const std::vector<Frame<T>>& frames) {
    if (frames.empty()) throw std::invalid_argument("no frames");
    pixels = frames[0].shape(0);
    channels = frames[0].shape(1);
    for (const auto& frame : frames) {
      if (frame.shape(0) != pixels || frame.shape(1) != channels)
        throw std::invalid_argument("frames of different shapes");
      data.push_back(frame.data());
    }
  }
  std::size_t frames() const { return data.size(); }
};

inline void check_table(std::size_t size) {
  if (size != codes) throw std::invalid_argument("tables have 256 entries");
}

void bind_response(nb::module_& m);
void bind_merge(nb::module_& m);
void bind_align(nb::module_& m);
void bind_ghost(nb::module_& m);
