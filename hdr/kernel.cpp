// Fused loops of the hdr room: joint statistics of code tuples, and the merge of a bracket.
// Arrays in, arrays out; numpy references stand in tests/hdr.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>
#include <oneapi/tbb/blocked_range.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

namespace nb = nanobind;

namespace {

constexpr std::size_t codes = 256;
constexpr std::size_t slices = 4;  // fixed, so that sums do not depend on the thread count

template <typename T>
using Frame = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Shares = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
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

// Codes as 8.8 fixed point: patch means fall between two codes. No 8-bit mean reaches this.
constexpr std::uint16_t unusable = 0xffff;

// Mean codes of size x size patches, (pixels, channels) of the picture row by row; a patch is
// unusable in a frame where a pixel of it is clipped (the mean would be biased) or where its
// codes spread over more than `spread` (an edge: the response is not linear across it).
nb::object patches(nb::ndarray<const std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu> image,
                   std::size_t size, int spread) {
  const std::size_t rows = image.shape(0) / size, columns = image.shape(1) / size;
  const std::size_t C = image.shape(2), stride = image.shape(1) * C;
  auto mean = std::make_unique<std::uint16_t[]>(rows * columns * C);
  {
    nb::gil_scoped_release release;
    tbb::parallel_for(std::size_t{0}, rows, [&](std::size_t row) {
      for (std::size_t column = 0; column < columns; ++column)
        for (std::size_t c = 0; c < C; ++c) {
          const std::uint8_t* corner = image.data() + row * size * stride + column * size * C + c;
          std::uint32_t sum = 0;
          int low = 255, high = 0;
          for (std::size_t y = 0; y < size; ++y)
            for (std::size_t x = 0; x < size; ++x) {
              const int z = corner[y * stride + x * C];
              sum += static_cast<std::uint32_t>(z);
              low = std::min(low, z);
              high = std::max(high, z);
            }
          const std::uint32_t n = static_cast<std::uint32_t>(size * size);
          const bool usable = low > 0 && high < 255 && high - low <= spread;
          mean[(row * columns + column) * C + c] =
              usable ? static_cast<std::uint16_t>((std::uint64_t{sum} * 256 + n / 2) / n) : unusable;
        }
    });
  }
  return to_numpy(std::move(mean), {rows * columns, C});
}

// One usable observation of a pixel: code z + u, so g = (1 - u) g(z) + u g(z + 1).
struct Observation {
  std::size_t frame, z;
  double u, weight;
};

double along(const double* table, const Observation& o) {
  return (1 - o.u) * table[o.z] + o.u * table[o.z + 1];
}

// Calls body(observations, count, sum of weights) for each pixel of one slice of one channel
// that at least two frames measure.
template <typename Body>
void each_pixel(const Stack<std::uint16_t>& stack, const double* weights, const float* share,
                std::size_t channel, std::size_t slice, Body&& body) {
  std::vector<Observation> seen(stack.frames());
  const std::size_t first = stack.pixels * slice / slices;
  const std::size_t last = stack.pixels * (slice + 1) / slices;
  for (std::size_t i = first; i < last; ++i) {
    std::size_t count = 0;
    double total = 0;
    for (std::size_t j = 0; j < stack.frames(); ++j) {
      const std::uint16_t code = stack.data[j][i * stack.channels + channel];
      if (code >= 255 * 256) continue;  // unusable, or at the end of the range
      Observation o{j, static_cast<std::size_t>(code >> 8), (code & 255) / 256.0, 0};
      o.weight = along(weights, o) * static_cast<double>(share[i * stack.channels + channel]);
      if (!(o.weight > 0)) continue;
      total += o.weight;
      seen[count++] = o;
    }
    if (count >= 2) body(seen.data(), count, total);
  }
}

// matrix += v f_a f_b', f = (1 - u) e(z) + u e(z + 1)
void add_outer(double* matrix, const Observation& a, const Observation& b, double v) {
  double* row = matrix + a.z * codes + b.z;
  const double low = v * (1 - a.u), high = v * a.u;
  row[0] += low * (1 - b.u);
  row[1] += low * b.u;
  row[codes] += high * (1 - b.u);
  row[codes + 1] += high * b.u;
}

void check_table(std::size_t size) {
  if (size != codes) throw std::invalid_argument("tables have 256 entries");
}

// What each pixel counts for: 1 / (its mean code density), mean over its frames weighted by W.
// Every brightness then counts alike; with plain counts, noise pulls each code's estimate down
// the slope of the histogram, and no number of pixels mends that.
nb::object shares(const std::vector<Frame<std::uint16_t>>& frames, Table1 weights) {
  const Stack<std::uint16_t> stack(frames);
  check_table(weights.shape(0));
  const std::size_t P = stack.frames(), C = stack.channels;
  auto share = std::make_unique<float[]>(stack.pixels * C);
  {
    nb::gil_scoped_release release;
    tbb::parallel_for(std::size_t{0}, C, [&](std::size_t c) {
      constexpr std::size_t reach = 2;  // the density is a mean over 5 codes
      std::vector<float> density(P * codes, 0);
      for (std::size_t j = 0; j < P; ++j) {
        std::vector<float> histogram(codes, 0);
        for (std::size_t i = 0; i < stack.pixels; ++i) {
          const std::uint16_t code = stack.data[j][i * C + c];
          if (code < 255 * 256) ++histogram[code >> 8];
        }
        for (std::size_t z = 0; z < codes; ++z) {
          const std::size_t first = z < reach ? 0 : z - reach;
          const std::size_t last = std::min(codes - 1, z + reach);
          for (std::size_t y = first; y <= last; ++y) density[j * codes + z] += histogram[y];
          density[j * codes + z] /= static_cast<float>(last - first + 1);
        }
      }
      for (std::size_t i = 0; i < stack.pixels; ++i) {
        float sum = 0, total = 0;
        for (std::size_t j = 0; j < P; ++j) {
          const std::uint16_t code = stack.data[j][i * C + c];
          if (code >= 255 * 256) continue;
          const float w = static_cast<float>(weights(code >> 8));
          sum += w * density[j * codes + (code >> 8)];
          total += w;
        }
        share[i * C + c] = sum > 0 ? total / sum : 0;
      }
    });
  }
  return to_numpy(std::move(share), {stack.pixels, C});
}

// The quadratic form of sum_ij W_ij (g(z_ij) - ln E_i - tau_j)^2 with every ln E_i eliminated
// (its Schur complement), over the unknowns (g(0) .. g(255), tau_0 .. tau_{P-1}):
//   H = sum_i [ sum_j W_j f_j f_j' - (sum_j W_j f_j)(sum_j W_j f_j)' / sum_j W_j ],
//   f_j = e(z_j) - e(256 + j).
nb::tuple accumulate(const std::vector<Frame<std::uint16_t>>& frames, Table1 weights, Shares share) {
  const Stack<std::uint16_t> stack(frames);
  check_table(weights.shape(0));
  if (share.shape(0) != stack.pixels || share.shape(1) != stack.channels)
    throw std::invalid_argument("shares do not match the frames");
  const std::size_t P = stack.frames(), C = stack.channels, n = codes + P;
  auto H = std::make_unique<double[]>(C * n * n);
  auto seen = std::make_unique<double[]>(C * codes);
  auto used = std::make_unique<std::int64_t[]>(C);
  {
    nb::gil_scoped_release release;
    struct Part {
      std::vector<double> gg, gt, tt, seen;  // gg and tt: half of a symmetric matrix, any half
      std::int64_t used = 0;
    };
    std::vector<Part> parts(C * slices);
    tbb::parallel_for(std::size_t{0}, parts.size(), [&](std::size_t task) {
      Part& part = parts[task];
      part.gg.assign(codes * codes, 0);
      part.gt.assign(codes * P, 0);
      part.tt.assign(P * P, 0);
      part.seen.assign(codes, 0);
      std::vector<double> row(P);
      each_pixel(stack, weights.data(), share.data(), task / slices, task % slices,
                 [&](const Observation* o, std::size_t count, double total) {
        ++part.used;
        for (std::size_t a = 0; a < count; ++a) {
          const std::size_t j = o[a].frame;
          const double wa = o[a].weight, scaled = -wa / total;
          const double own = 0.5 * wa * (1 + scaled);
          part.seen[o[a].z] += 1 - o[a].u;
          part.seen[o[a].z + 1] += o[a].u;
          add_outer(part.gg.data(), o[a], o[a], own);
          part.tt[j * P + j] += own;
          for (std::size_t b = 0; b < a; ++b) {
            const double v = scaled * o[b].weight;
            add_outer(part.gg.data(), o[a], o[b], v);
            part.tt[j * P + o[b].frame] += v;
          }
          std::fill(row.begin(), row.end(), 0.0);
          for (std::size_t b = 0; b < count; ++b) row[o[b].frame] = -scaled * o[b].weight;
          row[j] -= wa;
          double* gt = part.gt.data() + o[a].z * P;
          for (std::size_t k = 0; k < P; ++k) {
            gt[k] += (1 - o[a].u) * row[k];
            gt[P + k] += o[a].u * row[k];
          }
        }
      });
    });
    for (std::size_t task = 0; task < parts.size(); ++task) {
      const std::size_t c = task / slices;
      const Part& part = parts[task];
      double* h = H.get() + c * n * n;
      used[c] += part.used;
      for (std::size_t a = 0; a < codes; ++a) {
        seen[c * codes + a] += part.seen[a];
        for (std::size_t b = 0; b < codes; ++b)
          h[a * n + b] += part.gg[a * codes + b] + part.gg[b * codes + a];
        for (std::size_t j = 0; j < P; ++j) {
          h[a * n + codes + j] += part.gt[a * P + j];
          h[(codes + j) * n + a] += part.gt[a * P + j];
        }
      }
      for (std::size_t j = 0; j < P; ++j)
        for (std::size_t k = 0; k < P; ++k)
          h[(codes + j) * n + codes + k] += part.tt[j * P + k] + part.tt[k * P + j];
    }
  }
  return nb::make_tuple(to_numpy(std::move(H), {C, n, n}), to_numpy(std::move(seen), {C, codes}),
                        to_numpy(std::move(used), {C}));
}

// Residuals of a solved curve. With e_j = g(z_j) - tau_j - mean_W, per channel:
// score  = sum_i s_i s_i', s_i = sum_j W_j e_j f_j     (the middle of a sandwich covariance),
// within = sum over the observations of code z of W_j e_j^2,
// freedom = the same sum of W_j - W_j^2 / sum W        (its expectation at unit variance).
nb::tuple residuals(const std::vector<Frame<std::uint16_t>>& frames, Table1 weights, Shares share,
                    Table2 g, Table1 tau) {
  const Stack<std::uint16_t> stack(frames);
  const std::size_t C = stack.channels;
  check_table(weights.shape(0));
  if (share.shape(0) != stack.pixels || share.shape(1) != stack.channels)
    throw std::invalid_argument("shares do not match the frames");
  check_table(g.shape(1));
  if (g.shape(0) != C || tau.shape(0) != stack.frames())
    throw std::invalid_argument("curves or times do not match the frames");
  auto score = std::make_unique<double[]>(C * codes * codes);
  auto within = std::make_unique<double[]>(C * codes);
  auto freedom = std::make_unique<double[]>(C * codes);
  {
    nb::gil_scoped_release release;
    struct Part {
      std::vector<double> score, within, freedom;
    };
    std::vector<Part> parts(C * slices);
    tbb::parallel_for(std::size_t{0}, parts.size(), [&](std::size_t task) {
      Part& part = parts[task];
      part.score.assign(codes * codes, 0);
      part.within.assign(codes, 0);
      part.freedom.assign(codes, 0);
      std::vector<double> s(stack.frames());
      const double* curve = g.data() + task / slices * codes;
      each_pixel(stack, weights.data(), share.data(), task / slices, task % slices,
                 [&](const Observation* o, std::size_t count, double total) {
        double mean = 0;
        for (std::size_t a = 0; a < count; ++a)
          mean += o[a].weight * (along(curve, o[a]) - tau(o[a].frame));
        mean /= total;
        for (std::size_t a = 0; a < count; ++a) {
          const double e = along(curve, o[a]) - tau(o[a].frame) - mean;
          s[a] = o[a].weight * e;
          part.within[o[a].z] += s[a] * e;
          part.freedom[o[a].z] += o[a].weight - o[a].weight * o[a].weight / total;
          add_outer(part.score.data(), o[a], o[a], 0.5 * s[a] * s[a]);
          for (std::size_t b = 0; b < a; ++b)
            add_outer(part.score.data(), o[a], o[b], s[a] * s[b]);
        }
      });
    });
    for (std::size_t task = 0; task < parts.size(); ++task) {
      const std::size_t c = task / slices;
      const Part& part = parts[task];
      for (std::size_t a = 0; a < codes; ++a) {
        within[c * codes + a] += part.within[a];
        freedom[c * codes + a] += part.freedom[a];
        for (std::size_t b = 0; b < codes; ++b)
          score[(c * codes + a) * codes + b] +=
              part.score[a * codes + b] + part.score[b * codes + a];
      }
    }
  }
  return nb::make_tuple(to_numpy(std::move(score), {C, codes, codes}),
                        to_numpy(std::move(within), {C, codes}),
                        to_numpy(std::move(freedom), {C, codes}));
}

// ---- merge ---------------------------------------------------------------------------------

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

NB_MODULE(kernel, m) {
  m.def("patches", &patches, nb::arg("image"), nb::arg("size"), nb::arg("spread"));
  m.def("shares", &shares, nb::arg("frames"), nb::arg("weights"));
  m.def("accumulate", &accumulate, nb::arg("frames"), nb::arg("weights"), nb::arg("share"));
  m.def("residuals", &residuals, nb::arg("frames"), nb::arg("weights"), nb::arg("share"), nb::arg("g"),
        nb::arg("tau"));
  m.def("merge_codes", &merge_codes, nb::arg("frames"), nb::arg("weight"), nb::arg("exposure"),
        nb::arg("times"), nb::arg("with_sigma"));
  m.def("merge_linear_u16", &merge_linear<std::uint16_t>, nb::arg("frames"), nb::arg("times"),
        nb::arg("white"), nb::arg("gain"), nb::arg("read"), nb::arg("with_sigma"));
  m.def("merge_linear_f32", &merge_linear<float>, nb::arg("frames"), nb::arg("times"),
        nb::arg("white"), nb::arg("gain"), nb::arg("read"), nb::arg("with_sigma"));
}
