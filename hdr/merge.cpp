// The merge of a bracket in one fused pass; numpy references in tests/hdr.

#include <oneapi/tbb/blocked_range.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>

#include "kernel.h"

namespace {

constexpr std::size_t block = 1024;  // pixels: the accumulators of a block stay in the L1 cache

struct Merged {
  std::unique_ptr<float[]> radiance, sigma;
  std::unique_ptr<std::int8_t[]> clipped;
  std::vector<std::array<std::int64_t, 2>> counts;  // per channel: high, low

  Merged(std::size_t pixels, std::size_t channels, bool with_sigma)
      : radiance(new float[pixels * channels]),
        sigma(with_sigma ? new float[pixels * channels] : nullptr),
        clipped(new std::int8_t[pixels]),
        counts(channels, {0, 0}) {}
};

nb::tuple to_tuple(Merged merged, std::size_t pixels, std::size_t channels) {
  auto counts = std::make_unique<std::int64_t[]>(channels * 2);
  for (std::size_t c = 0; c < channels; ++c)
    for (std::size_t k = 0; k < 2; ++k) counts[c * 2 + k] = merged.counts[c][k];
  nb::object sigma = merged.sigma ? to_numpy(std::move(merged.sigma), {pixels, channels}) : nb::none();
  return nb::make_tuple(to_numpy(std::move(merged.radiance), {pixels, channels}), sigma,
                        to_numpy(std::move(merged.clipped), {pixels}),
                        to_numpy(std::move(counts), {channels, std::size_t{2}}));
}

// Runs body(first pixel, pixels, counts) over blocks and sums the counts.
template <std::size_t C, typename Body>
void over_blocks(std::size_t pixels, Merged& merged, Body&& body) {
  using Counts = std::array<std::array<std::int64_t, 2>, C>;
  const std::size_t blocks = (pixels + block - 1) / block;
  std::vector<Counts> counts(blocks);
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, blocks, 16), [&](const auto& range) {
    for (std::size_t b = range.begin(); b < range.end(); ++b)
      body(b * block, std::min(block, pixels - b * block), counts[b]);
  });
  for (const Counts& part : counts)
    for (std::size_t c = 0; c < C; ++c)
      for (std::size_t k = 0; k < 2; ++k) merged.counts[c][k] += part[c][k];
}

// One mark for a pixel: a channel that is too bright outweighs one that is too dark.
inline std::int8_t worse(std::int8_t a, std::int8_t b) { return a == 1 || b == 1 ? 1 : (a ? a : b); }

template <std::size_t C>
void merge_codes_n(const Stack<std::uint8_t>& stack, const double* weight, const double* exposure,
                   const double* times, Merged& merged) {
  struct Entry {
    float sum, weight;
  };
  const std::size_t P = stack.frames();
  std::vector<Entry> table(P * C * codes);
  for (std::size_t j = 0; j < P; ++j)
    for (std::size_t k = 0; k < C * codes; ++k)
      table[j * C * codes + k] = {static_cast<float>(weight[k] * exposure[k] / times[j]),
                                  static_cast<float>(weight[k])};
  over_blocks<C>(stack.pixels, merged, [&](std::size_t first, std::size_t count, auto& counts) {
    alignas(64) Entry total[block * C];
    std::fill_n(total, count * C, Entry{0, 0});
    for (std::size_t j = 0; j < P; ++j) {
      const std::uint8_t* z = stack.data[j] + first * C;
      const Entry* lookup = table.data() + j * C * codes;
      for (std::size_t i = 0; i < count; ++i)
        for (std::size_t c = 0; c < C; ++c) {
          const Entry entry = lookup[c * codes + z[i * C + c]];
          total[i * C + c].sum += entry.sum;
          total[i * C + c].weight += entry.weight;
        }
    }
    for (std::size_t i = 0; i < count; ++i) {
      std::int8_t mark = 0;
      for (std::size_t c = 0; c < C; ++c) {
        const std::size_t at = (first + i) * C + c;
        const Entry entry = total[i * C + c];
        if (entry.weight > 0) {
          const float value = entry.sum / entry.weight;
          merged.radiance[at] = value;
          if (merged.sigma) merged.sigma[at] = value / std::sqrt(entry.weight);
          continue;
        }
        // No frame measures it. A saturated frame says "at least": the shortest says most;
        // else the longest frame says "at most". Frames come sorted, the shortest first.
        bool high = false;
        std::size_t j = 0;
        for (; j < P && !high; ++j) high = stack.data[j][at] >= codes / 2;
        j = high ? j - 1 : P - 1;
        merged.radiance[at] =
            static_cast<float>(exposure[c * codes + stack.data[j][at]] / times[j]);
        if (merged.sigma) merged.sigma[at] = std::numeric_limits<float>::infinity();
        ++counts[c][high ? 0 : 1];
        mark = worse(mark, high ? 1 : -1);
      }
      merged.clipped[first + i] = mark;
    }
  });
}

// weight, exposure: (C, 256). The estimate is sum_j w(z_j) X(z_j) / t_j / sum_j w(z_j), its
// standard error value / sqrt(sum w) (weights are inverse variances of ln X).
nb::tuple merge_codes(const std::vector<Frame<std::uint8_t>>& frames, Table2 weight,
                      Table2 exposure, Table1 times, bool with_sigma) {
  const Stack<std::uint8_t> stack(frames);
  const std::size_t C = stack.channels;
  check_table(weight.shape(1));
  check_table(exposure.shape(1));
  if (weight.shape(0) != C || exposure.shape(0) != C || times.shape(0) != stack.frames())
    throw std::invalid_argument("tables or times do not match the frames");
  if (C != 1 && C != 3) throw std::invalid_argument("one or three channels");
  Merged merged(stack.pixels, C, with_sigma);
  {
    nb::gil_scoped_release release;
    (C == 1 ? merge_codes_n<1> : merge_codes_n<3>)(stack, weight.data(), exposure.data(),
                                                   times.data(), merged);
  }
  return to_tuple(std::move(merged), stack.pixels, C);
}

template <std::size_t C, typename T>
void merge_linear_n(const Stack<T>& stack, const double* times, double white, double gain,
                    double read, Merged& merged) {
  const std::size_t P = stack.frames();
  const T saturated = static_cast<T>(white);
  const float a = static_cast<float>(gain), b = static_cast<float>(read);
  std::vector<float> time(times, times + P);
  over_blocks<C>(stack.pixels, merged, [&](std::size_t first, std::size_t count, auto& counts) {
    constexpr std::size_t width = block * C;
    const std::size_t n = count * C;
    alignas(64) float sum[width], total[width], value[width];
    std::fill_n(sum, n, 0.0f);
    std::fill_n(total, n, 0.0f);
    for (std::size_t j = 0; j < P; ++j) {
      const T* x = stack.data[j] + first * C;
      for (std::size_t i = 0; i < n; ++i) {
        const bool keep = x[i] < saturated;
        sum[i] += keep ? static_cast<float>(x[i]) : 0.0f;
        total[i] += keep ? time[j] : 0.0f;
      }
    }
    // sum x / sum t is the Poisson estimate; one step with w = t^2 / (a E t + b) on it
    for (std::size_t i = 0; i < n; ++i) value[i] = sum[i] / total[i];
    std::fill_n(sum, n, 0.0f);
    std::fill_n(total, n, 0.0f);
    for (std::size_t j = 0; j < P; ++j) {
      const T* x = stack.data[j] + first * C;
      const float t = time[j];
      for (std::size_t i = 0; i < n; ++i) {
        const float w = t / (a * value[i] * t + b);
        const bool keep = x[i] < saturated;
        sum[i] += keep ? w * static_cast<float>(x[i]) : 0.0f;
        total[i] += keep ? w * t : 0.0f;
      }
    }
    for (std::size_t i = 0; i < count; ++i) {
      std::int8_t mark = 0;
      for (std::size_t c = 0; c < C; ++c) {
        const std::size_t k = i * C + c, at = first * C + k;
        const bool high = !(total[k] > 0);
        const bool low = !high && sum[k] <= 0;
        const float estimate = sum[k] / total[k];
        merged.radiance[at] = high ? static_cast<float>(stack.data[0][at]) / time[0] : estimate;
        if (merged.sigma)
          merged.sigma[at] =
              high ? std::numeric_limits<float>::infinity() : 1 / std::sqrt(total[k]);
        if (high || low) {
          ++counts[c][high ? 0 : 1];
          mark = worse(mark, high ? 1 : -1);
        }
      }
      merged.clipped[first + i] = mark;
    }
  });
}

// Linear frames: x is proportional to exposure, var x = gain x + read (units of x); values from
// `white` on are saturated. Frames come sorted, the shortest first.
template <typename T>
nb::tuple merge_linear(const std::vector<Frame<T>>& frames, Table1 times, double white,
                       double gain, double read, bool with_sigma) {
  const Stack<T> stack(frames);
  const std::size_t C = stack.channels;
  if (times.shape(0) != stack.frames()) throw std::invalid_argument("times do not match");
  if (C != 1 && C != 3) throw std::invalid_argument("one or three channels");
  if (!(read > 0)) throw std::invalid_argument("read noise must be positive");
  Merged merged(stack.pixels, C, with_sigma);
  {
    nb::gil_scoped_release release;
    (C == 1 ? merge_linear_n<1, T> : merge_linear_n<3, T>)(stack, times.data(), white, gain, read,
                                                           merged);
  }
  return to_tuple(std::move(merged), stack.pixels, C);
}

}  // namespace

void bind_merge(nb::module_& m) {
  m.def("merge_codes", &merge_codes, nb::arg("frames"), nb::arg("weight"), nb::arg("exposure"),
        nb::arg("times"), nb::arg("with_sigma"));
  m.def("merge_linear_u16", &merge_linear<std::uint16_t>, nb::arg("frames"), nb::arg("times"),
        nb::arg("white"), nb::arg("gain"), nb::arg("read"), nb::arg("with_sigma"));
  m.def("merge_linear_f32", &merge_linear<float>, nb::arg("frames"), nb::arg("times"),
        nb::arg("white"), nb::arg("gain"), nb::arg("read"), nb::arg("with_sigma"));
}
