// The merge of a bracket in one fused pass; numpy references in tests/hdr.
//
// Frames come sorted, the shortest first, so that saturation can be decided jointly: once a
// sample is saturated, no longer exposure of it counts.

#include <oneapi/tbb/blocked_range.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <type_traits>
#include <utility>

#include <nanobind/stl/optional.h>

#include "kernel.h"

namespace {

constexpr std::size_t block = 512;  // pixels: the accumulators of a block stay in the L1 cache
constexpr float infinity = std::numeric_limits<float>::infinity();
enum Count { high, low, negative, kinds };

template <typename T, int N>
using Array = nb::ndarray<const T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

template <typename T, int N>
using Output = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

// Where the results go: the caller's arrays (numpy asks for huge pages, which halves the time
// of a merge whose output is fresh memory).
struct Merged {
  float *radiance, *sigma;  // sigma may be null
  std::int8_t* clipped;
  std::vector<std::array<std::int64_t, kinds>> counts;  // per channel

  Merged(const Output<float, 2>& radiance, const std::optional<Output<float, 2>>& sigma,
         const Output<std::int8_t, 1>& clipped, std::size_t pixels, std::size_t channels)
      : radiance(radiance.data()),
        sigma(sigma ? sigma->data() : nullptr),
        clipped(clipped.data()),
        counts(channels, {0, 0, 0}) {
    if (radiance.shape(0) != pixels || radiance.shape(1) != channels || clipped.shape(0) != pixels ||
        (sigma && (sigma->shape(0) != pixels || sigma->shape(1) != channels)))
      throw std::invalid_argument("outputs do not match the frames");
  }

  nb::object to_numpy_counts() const {
    const std::size_t channels = counts.size();
    auto table = std::make_unique<std::int64_t[]>(channels * kinds);
    for (std::size_t c = 0; c < channels; ++c)
      for (std::size_t k = 0; k < kinds; ++k) table[c * kinds + k] = counts[c][k];
    return to_numpy(std::move(table), {channels, std::size_t{kinds}});
  }
};

// Runs body(block number, counts) over `blocks` and sums the counts.
template <std::size_t C, typename Body>
void over_blocks(std::size_t blocks, Merged& merged, Body&& body) {
  using Counts = std::array<std::array<std::int64_t, kinds>, C>;
  std::vector<Counts> counts(blocks);
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, blocks, 16), [&](const auto& range) {
    for (std::size_t b = range.begin(); b < range.end(); ++b) body(b, counts[b]);
  });
  for (const Counts& part : counts)
    for (std::size_t c = 0; c < C; ++c)
      for (std::size_t k = 0; k < kinds; ++k) merged.counts[c][k] += part[c][k];
}

// One mark for a pixel: a channel that is too bright outweighs one that is too dark.
inline std::int8_t worse(std::int8_t a, std::int8_t b) { return a == 1 || b == 1 ? 1 : (a ? a : b); }

// What the codes of a channel mean; tables of N = 256 or 65536 codes.
struct Codes {
  const double *weight, *exposure, *taper;  // (C, N)
  const float* expected;  // (C, 2^15) weight at an exposure, by the top bits of its float
  const std::int64_t* saturated;  // (C,) from this code on
  const double* times;
  std::size_t size;
  float weak;  // samples whose weights sum to less are weighed by what is expected
};

typedef float Pair __attribute__((vector_size(8)));  // w X / t, w

// The sample `at` of channel c in every frame, by the book: saturation decided over the frames,
// weights at the exposure that an estimate predicts, not at the noisy code. Two rounds.
template <typename T>
Pair careful(const Stack<T>& stack, const Codes& k, std::size_t at, std::size_t c) {
  const double *weight = k.weight + c * k.size, *exposure = k.exposure + c * k.size;
  const double* taper = k.taper + c * k.size;
  const float* expected = k.expected + (c << 15);
  double sum = 0, total = 0, value = 0;
  for (int round = 0; round < 3; ++round) {
    sum = total = 0;
    for (std::size_t j = 0; j < stack.frames(); ++j) {
      const auto z = stack.data[j][at];
      if (z >= k.saturated[c]) break;
      double w = weight[z];
      if (round > 0 && w > 0)
        w = taper[z] * expected[std::bit_cast<std::uint32_t>(static_cast<float>(value * k.times[j])) >> 16];
      sum += w * exposure[z] / k.times[j];
      total += w;
    }
    if (!(total > 0) || total >= k.weak) break;
    value = sum / total;
  }
  return Pair{static_cast<float>(sum), static_cast<float>(total)};
}

// The loops over a block stand alone: inlined, GCC jams the frames' loop into them and vectorises
// neither.

// Marks samples that are measured after a shorter exposure saturated.
template <typename T>
[[gnu::noinline]] void watch(const T* __restrict z, const T* __restrict limit, std::size_t n, T* __restrict seen,
           T* __restrict odd) {
  for (std::size_t i = 0; i < n; ++i) {
    const T over = z[i] > limit[i] ? T(-1) : T(0);
    odd[i] = odd[i] | (seen[i] & T(~over));
    seen[i] = seen[i] | over;
  }
}

// Adds F frames: for 8 bits each has its own table of (w X / t, w), for 16 bits all have one.
template <std::size_t C, std::size_t F, typename T>
[[gnu::noinline]] void look_up(const T* const* frames, std::size_t n, const Pair* __restrict table,
                               std::size_t N, const double* times, Pair* __restrict total) {
  constexpr bool small = sizeof(T) == 1;
  const T* __restrict z[F];
  Pair scale[F];
  for (std::size_t f = 0; f < F; ++f) {
    z[f] = frames[f];
    scale[f] = Pair{static_cast<float>(1 / times[f]), 1.0f};
  }
  for (std::size_t i = 0; i < n; i += C)
    for (std::size_t c = 0; c < C; ++c) {
      Pair sum = total[i + c];
      for (std::size_t f = 0; f < F; ++f) {
        const Pair entry = table[((small ? f * C : 0) + c) * N + z[f][i + c]];
        sum += small ? entry : entry * scale[f];
      }
      total[i + c] = sum;
    }
}

template <std::size_t C, typename T>
void merge_codes_n(const Stack<T>& stack, const Codes& k, Merged& merged) {
  const std::size_t P = stack.frames(), N = k.size;
  // 8 bits: a table a frame stays in the cache; 16 bits: one table, and 1 / t
  constexpr bool small = std::is_same_v<T, std::uint8_t>;
  std::vector<Pair> table((small ? P : 1) * C * N);
  for (std::size_t j = 0; j < (small ? P : 1); ++j)
    for (std::size_t i = 0; i < C * N; ++i)
      table[j * C * N + i] =
          Pair{static_cast<float>(k.weight[i] * k.exposure[i] / (small ? k.times[j] : 1)),
               static_cast<float>(k.weight[i])};
  alignas(64) T limit[block * C];  // the last code that counts
  for (std::size_t i = 0; i < block * C; ++i)
    limit[i] = static_cast<T>(std::min<std::int64_t>(k.saturated[i % C], N) - 1);
  const std::size_t blocks = (stack.pixels + block - 1) / block;
  over_blocks<C>(blocks, merged, [&](std::size_t number, auto& counts) {
    const std::size_t first = number * block, count = std::min(block, stack.pixels - first);
    const std::size_t n = count * C;
    alignas(64) Pair total[block * C];
    alignas(64) T seen[block * C], odd[block * C];  // saturated before; measured after that
    std::fill_n(total, n, Pair{0, 0});
    std::fill_n(seen, n, T{0});
    std::fill_n(odd, n, T{0});
    for (std::size_t j = 0; j < P;) {
      const T* z[4];
      const std::size_t together = P - j >= 4 ? 4 : P - j >= 2 ? 2 : 1;
      for (std::size_t f = 0; f < together; ++f) z[f] = stack.data[j + f] + first * C;
      const Pair* lookup = table.data() + (small ? j * C * N : 0);
      const double* t = k.times + j;
      if (together == 4) look_up<C, 4>(z, n, lookup, N, t, total);
      if (together == 2) look_up<C, 2>(z, n, lookup, N, t, total);
      if (together == 1) look_up<C, 1>(z, n, lookup, N, t, total);
      j += together;
    }
    for (std::size_t j = 0; j < P; ++j) watch(stack.data[j] + first * C, limit, n, seen, odd);
    float* radiance = merged.radiance + first * C;
    for (std::size_t i = 0; i < n; ++i) {
      radiance[i] = total[i][0] / total[i][1];
      odd[i] |= total[i][1] >= k.weak ? 0 : 1;
    }
    if (merged.sigma)
      for (std::size_t i = 0; i < n; ++i)
        merged.sigma[first * C + i] = radiance[i] / std::sqrt(total[i][1]);
    std::int8_t* clipped = merged.clipped + first;
    std::fill_n(clipped, count, std::int8_t{0});
    for (std::size_t i = 0; i < n; ++i) {
      if (!odd[i]) continue;
      const std::size_t at = first * C + i, c = i % C;
      const Pair found = careful(stack, k, at, c);
      if (found[1] > 0) {
        radiance[i] = found[0] / found[1];
        if (merged.sigma) merged.sigma[at] = radiance[i] / std::sqrt(found[1]);
        continue;
      }
      // No frame measures it. A saturated frame says "at least": the shortest says most;
      // else the longest frame says "at most".
      bool bright = false;
      std::size_t f = 0;
      for (; f < P && !bright; ++f) bright = stack.data[f][at] >= k.saturated[c] / 2;
      f = bright ? f - 1 : P - 1;
      radiance[i] = static_cast<float>(k.exposure[c * N + stack.data[f][at]] / k.times[f]);
      if (merged.sigma) merged.sigma[at] = infinity;
      ++counts[c][bright ? high : low];
      clipped[i / C] = worse(clipped[i / C], bright ? 1 : -1);
    }
  });
}

// weight, exposure, taper: (C, N); expected: (C, 2^15); saturated (C,). The estimate is
// sum_j w(z_j) X(z_j) / t_j / sum_j w(z_j), its standard error value / sqrt(sum w) (weights are
// inverse variances of ln X). Returns counts (C, 3): high, low, negative.
template <typename T>
nb::object merge_codes(const std::vector<Frame<T>>& frames, Table2 weight, Table2 exposure,
                      Table2 taper, Array<float, 2> expected, Array<std::int64_t, 1> saturated,
                      Table1 times, float weak, Output<float, 2> radiance,
                     std::optional<Output<float, 2>> sigma, Output<std::int8_t, 1> clipped) {
  const Stack<T> stack(frames);
  const std::size_t C = stack.channels, N = std::size_t{1} << (8 * sizeof(T));
  for (const Table2& t : {weight, exposure, taper})
    if (t.shape(0) != C || t.shape(1) != N) throw std::invalid_argument("tables do not match");
  if (expected.shape(0) != C || expected.shape(1) != 1u << 15 || saturated.shape(0) != C)
    throw std::invalid_argument("expected weights or saturated codes do not match");
  if (times.shape(0) != stack.frames()) throw std::invalid_argument("times do not match");
  if (C != 1 && C != 3) throw std::invalid_argument("one or three channels");
  for (std::size_t c = 0; c < C; ++c)
    if (saturated.data()[c] < 1) throw std::invalid_argument("saturated from a code of 1 or more");
  Merged merged(radiance, sigma, clipped, stack.pixels, C);
  {
    nb::gil_scoped_release release;
    const Codes k{weight.data(),    exposure.data(), taper.data(), expected.data(),
                  saturated.data(), times.data(),    N,            weak};
    (C == 1 ? merge_codes_n<1, T> : merge_codes_n<3, T>)(stack, k, merged);
  }
  return merged.to_numpy_counts();
}

// Adds a frame to sum t x / sum t^2. A sample that saturates once does so in longer frames.
template <typename T>
[[gnu::noinline]] void pilot(const T* __restrict y, std::size_t n, float t, const float* __restrict black,
           float* __restrict limit, float* __restrict sum, float* __restrict total,
           float* __restrict largest) {
  for (std::size_t i = 0; i < n; ++i) {
    const float raw = static_cast<float>(y[i]);
    const bool keep = raw < limit[i];
    limit[i] = keep ? limit[i] : -infinity;
    sum[i] += keep ? t * (raw - black[i]) : 0.0f;
    total[i] += keep ? t * t : 0.0f;
    const float size = raw < 0 ? -raw : raw;
    largest[i] = size > largest[i] ? size : largest[i];
  }
}

// Adds a frame with w = t^2 / (value t + read); value is a E.
template <typename T>
[[gnu::noinline]] void weigh(const T* __restrict y, std::size_t n, float t, const float* __restrict black,
           const float* __restrict read, const float* __restrict value, float* __restrict limit,
           float* __restrict sum, float* __restrict total) {
  for (std::size_t i = 0; i < n; ++i) {
    const float raw = static_cast<float>(y[i]);
    const float w = t / (value[i] * t + read[i]);
    const bool keep = raw < limit[i];
    limit[i] = keep ? limit[i] : -infinity;
    sum[i] += keep ? w * (raw - black[i]) : 0.0f;
    total[i] += keep ? w * t : 0.0f;
  }
}

template <std::size_t C, typename T>
void merge_linear_n(const Stack<T>& stack, const double* times, const float* levels,
                    std::size_t columns, Merged& merged) {
  const std::size_t P = stack.frames();
  // a block is a piece of one row: the levels of its samples depend on the row's parity alone
  const std::size_t pieces = (columns + block - 1) / block, rows = stack.pixels / columns;
  constexpr std::size_t width = block * C;
  struct Levels {
    alignas(64) float black[width], white[width], gain[width], read[width], scale[width];
  };
  std::vector<Levels> parity(2);
  for (std::size_t r = 0; r < 2; ++r)
    for (std::size_t i = 0; i < width; ++i) {
      const float* level = levels + ((r * 2 + (i / C) % 2) * C + i % C) * 5;
      parity[r].black[i] = level[0];
      parity[r].white[i] = level[1];
      parity[r].gain[i] = level[2];
      parity[r].read[i] = level[3];
      parity[r].scale[i] = level[4];
    }
  std::vector<float> time(times, times + P);
  over_blocks<C>(rows * pieces, merged, [&](std::size_t number, auto& counts) {
    const std::size_t row = number / pieces, column = number % pieces * block;
    const std::size_t first = row * columns + column, count = std::min(block, columns - column);
    const std::size_t n = count * C;
    const Levels& level = parity[row % 2];
    alignas(64) float sum[width], total[width], value[width], limit[width], largest[width];
    std::fill_n(sum, n, 0.0f);
    std::fill_n(total, n, 0.0f);
    std::fill_n(largest, n, 0.0f);
    std::copy_n(level.white, n, limit);
    for (std::size_t j = 0; j < P; ++j)
      pilot(stack.data[j] + first * C, n, time[j], level.black, limit, sum, total, largest);
    // sum t x / sum t^2 is the pilot; one step with w = t^2 / (a E t + b) on it
    for (std::size_t i = 0; i < n; ++i)
      value[i] = std::max(sum[i] / total[i], 0.0f) * level.gain[i];
    std::fill_n(sum, n, 0.0f);
    std::fill_n(total, n, 0.0f);
    std::copy_n(level.white, n, limit);
    for (std::size_t j = 0; j < P; ++j)
      weigh(stack.data[j] + first * C, n, time[j], level.black, level.read, value, limit, sum, total);
    float* radiance = merged.radiance + first * C;
    for (std::size_t i = 0; i < n; ++i) radiance[i] = sum[i] / total[i];
    if (merged.sigma)
      for (std::size_t i = 0; i < n; ++i)
        merged.sigma[first * C + i] = level.scale[i] / std::sqrt(total[i]);
    std::int8_t* clipped = merged.clipped + first;
    std::fill_n(clipped, count, std::int8_t{0});
    alignas(64) std::uint8_t odd[width];
    std::uint8_t any = 0;
    for (std::size_t i = 0; i < n; ++i) {
      odd[i] = (total[i] > 0 && largest[i] > 0 && sum[i] >= 0) ? 0 : 1;
      any |= odd[i];
    }
    if (!any) return;
    for (std::size_t i = 0; i < n; ++i) {
      if (!odd[i]) continue;
      const bool bright = !(total[i] > 0), black = !(largest[i] > 0);
      if (!bright && !black) {
        ++counts[i % C][negative];
        continue;
      }
      if (bright)
        radiance[i] = (static_cast<float>(stack.data[0][first * C + i]) - level.black[i]) / time[0];
      if (merged.sigma) merged.sigma[first * C + i] = infinity;
      ++counts[i % C][bright ? high : low];
      clipped[i / C] = worse(clipped[i / C], bright ? 1 : -1);
    }
  });
}

// Linear frames: y - black is proportional to exposure, with variance
// scale^2 (gain (y - black) + read); values from white on are saturated. levels: (2, 2, C, 5),
// black, white, gain, read and scale by the parity of row and column; columns: pixels a row.
template <typename T>
nb::object merge_linear(const std::vector<Frame<T>>& frames, Table1 times, Array<float, 4> levels,
                       std::size_t columns, Output<float, 2> radiance,
                     std::optional<Output<float, 2>> sigma, Output<std::int8_t, 1> clipped) {
  const Stack<T> stack(frames);
  const std::size_t C = stack.channels;
  if (times.shape(0) != stack.frames()) throw std::invalid_argument("times do not match");
  if (C != 1 && C != 3) throw std::invalid_argument("one or three channels");
  if (levels.shape(0) != 2 || levels.shape(1) != 2 || levels.shape(2) != C || levels.shape(3) != 5)
    throw std::invalid_argument("levels do not match");
  if (columns == 0 || stack.pixels % columns) throw std::invalid_argument("rows of one length");
  for (std::size_t i = 0; i < 4 * C; ++i)
    if (!(levels.data()[i * 5 + 3] > 0)) throw std::invalid_argument("read noise must be positive");
  Merged merged(radiance, sigma, clipped, stack.pixels, C);
  {
    nb::gil_scoped_release release;
    (C == 1 ? merge_linear_n<1, T> : merge_linear_n<3, T>)(stack, times.data(), levels.data(),
                                                           columns, merged);
  }
  return merged.to_numpy_counts();
}

template <typename T>
void bind_codes(nb::module_& m, const char* name) {
  m.def(name, &merge_codes<T>, nb::arg("frames"), nb::arg("weight"), nb::arg("exposure"),
        nb::arg("taper"), nb::arg("expected"), nb::arg("saturated"), nb::arg("times"),
        nb::arg("weak"), nb::arg("radiance"),
        nb::arg("sigma").none(), nb::arg("clipped"));
}

template <typename T>
void bind_linear(nb::module_& m, const char* name) {
  m.def(name, &merge_linear<T>, nb::arg("frames"), nb::arg("times"), nb::arg("levels"),
        nb::arg("columns"), nb::arg("radiance"),
        nb::arg("sigma").none(), nb::arg("clipped"));
}

}  // namespace

void bind_merge(nb::module_& m) {
  bind_codes<std::uint8_t>(m, "merge_codes_u8");
  bind_codes<std::uint16_t>(m, "merge_codes_u16");
  bind_linear<std::uint16_t>(m, "merge_linear_u16");
  bind_linear<float>(m, "merge_linear_f32");
}
