// Joint statistics of code tuples, for the response solvers; numpy references in tests/hdr.

#include <oneapi/tbb/blocked_range.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "kernel.h"

namespace {

constexpr std::size_t slices = 4;  // fixed, so that sums do not depend on the thread count

// Knots as 8.8 fixed point: codes and patch means fall between two of the 256 knots of a curve.
// No usable value reaches this.
constexpr std::uint16_t unusable = 0xffff;

// Mean knot coordinates of size x size patches, (patches, channels), row by row; `knot` maps a
// code to its coordinate (for 8 bits they are the same). A patch is unusable in a frame where a pixel of it is saturated (the
// mean would be biased) or where it spreads over more than `spread` (an edge: the response is
// not linear across it); one that is black throughout stays, as zero.
template <typename T>
nb::object patches(nb::ndarray<const T, nb::ndim<3>, nb::c_contig, nb::device::cpu> image,
                   nb::ndarray<const std::uint16_t, nb::ndim<1>, nb::c_contig, nb::device::cpu> knot,
                   std::size_t size, int spread) {
  const std::size_t rows = image.shape(0) / size, columns = image.shape(1) / size;
  const std::size_t C = image.shape(2), stride = image.shape(1) * C, n = size * size;
  const std::uint32_t saturated = knot(knot.shape(0) - 1);
  const std::uint32_t wide = static_cast<std::uint32_t>(spread) * 256;
  const std::uint16_t* coordinate = knot.data();
  const std::size_t known = knot.shape(0);
  auto mean = std::make_unique<std::uint16_t[]>(rows * columns * C);
  std::atomic<bool> outside = false;
  {
    nb::gil_scoped_release release;
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, rows, 16), [&](const auto& range) {
      const std::size_t width = columns * size * C;
      std::vector<std::uint32_t> sum(width), low(width), high(width);
      bool beyond = false;
      for (std::size_t row = range.begin(); row < range.end(); ++row) {
        std::fill(sum.begin(), sum.end(), 0u);
        std::fill(low.begin(), low.end(), ~0u);
        std::fill(high.begin(), high.end(), 0u);
        for (std::size_t y = 0; y < size; ++y) {
          const T* line = image.data() + (row * size + y) * stride;
          for (std::size_t x = 0; x < width; ++x) {
            const std::size_t z = line[x];
            std::uint32_t k;
            if constexpr (sizeof(T) == 1) {  // 256 codes: the codes are the knots
              k = static_cast<std::uint32_t>(z) << 8;
            } else {
              beyond = beyond || z >= known;
              k = coordinate[std::min(z, known - 1)];
            }
            sum[x] += k;
            low[x] = std::min(low[x], k);
            high[x] = std::max(high[x], k);
          }
        }
        std::uint16_t* out = mean.get() + row * columns * C;
        for (std::size_t column = 0; column < columns; ++column)
          for (std::size_t c = 0; c < C; ++c) {
            const std::size_t first = column * size * C + c;
            std::uint32_t total = 0, least = ~0u, most = 0;
            for (std::size_t x = 0; x < size; ++x) {
              total += sum[first + x * C];
              least = std::min(least, low[first + x * C]);
              most = std::max(most, high[first + x * C]);
            }
            const bool usable = most < saturated && most - least <= wide;
            out[column * C + c] =
                usable ? static_cast<std::uint16_t>((total + n / 2) / n) : unusable;
          }
      }
      if (beyond) outside = true;
    });
  }
  if (outside) throw std::invalid_argument("a code beyond the table");
  return to_numpy(std::move(mean), {rows * columns, C});
}

// Marks what no light changes: patches whose knots stay within `least` of each other in all
// frames although the brightest of them is `bright` or more (borders, watermarks, captions).
nb::object unchanging(const std::vector<Frame<std::uint16_t>>& frames, double least, double bright) {
  const Stack<std::uint16_t> stack(frames);
  const std::size_t C = stack.channels;
  const int span = static_cast<int>(least * 256), floor = static_cast<int>(bright * 256);
  auto still = std::make_unique<std::uint8_t[]>(stack.pixels);
  {
    nb::gil_scoped_release release;
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, stack.pixels, 4096), [&](const auto& range) {
      for (std::size_t i = range.begin(); i < range.end(); ++i) {
        bool same = true, shown = false;
        for (std::size_t c = 0; c < C && same; ++c) {
          int low = 0xffff, high = 0;
          for (const std::uint16_t* frame : stack.data) {
            const int k = frame[i * C + c];
            low = std::min(low, k);
            high = std::max(high, k);
          }
          same = high - low <= span;
          shown = shown || (high >= floor && high != unusable);
        }
        still[i] = same && shown;
      }
    });
  }
  return to_numpy(std::move(still), {stack.pixels});
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
void each_pixel(const Stack<std::uint16_t>& stack, const double* weights, std::size_t channel, std::size_t slice, Body&& body) {
  std::vector<Observation> seen(stack.frames());
  const std::size_t first = stack.pixels * slice / slices;
  const std::size_t last = stack.pixels * (slice + 1) / slices;
  for (std::size_t i = first; i < last; ++i) {
    std::size_t count = 0;
    double total = 0;
    for (std::size_t j = 0; j < stack.frames(); ++j) {
      const std::uint16_t code = stack.data[j][i * stack.channels + channel];
      if (code >= (codes - 1) * 256) continue;  // unusable, or at the end of the range
      Observation o{j, static_cast<std::size_t>(code >> 8), (code & 255) / 256.0, 0};
      o.weight = along(weights, o);
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

// The quadratic form of sum_ij W_ij (g(z_ij) - ln E_i - tau_j)^2 with every ln E_i eliminated
// (its Schur complement), over the unknowns (g(0) .. g(255), tau_0 .. tau_{P-1}):
//   H = sum_i [ sum_j W_j f_j f_j' - (sum_j W_j f_j)(sum_j W_j f_j)' / sum_j W_j ],
//   f_j = e(z_j) - e(256 + j).
nb::tuple accumulate(const std::vector<Frame<std::uint16_t>>& frames, Table1 weights) {
  const Stack<std::uint16_t> stack(frames);
  check_table(weights.shape(0));
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
      each_pixel(stack, weights.data(), task / slices, task % slices,
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
nb::tuple residuals(const std::vector<Frame<std::uint16_t>>& frames, Table1 weights,
                    Table2 g, Table1 tau) {
  const Stack<std::uint16_t> stack(frames);
  const std::size_t C = stack.channels;
  check_table(weights.shape(0));
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
      each_pixel(stack, weights.data(), task / slices, task % slices,
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

using Pairs = std::vector<std::pair<std::size_t, std::size_t>>;
using Marks = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr double whole = 65536;  // what one patch adds to a joint histogram, all cells together

// Calls body(pair * C + channel, sums) for the joint histogram sums[a * 256 + b] of each pair
// and channel. Codes between two whole ones are split bilinearly over the four cells; patches
// that are marked in `skip` do not count.
template <typename Body>
void each_comparagram(const Stack<std::uint16_t>& stack, const Pairs& pairs, const Marks& skip,
                      Body&& body) {
  if (skip.shape(0) != stack.pixels) throw std::invalid_argument("marks do not match the frames");
  for (const auto& [a, b] : pairs)
    if (a >= stack.frames() || b >= stack.frames()) throw std::invalid_argument("no such frame");
  const std::size_t C = stack.channels;
  const std::uint8_t* skipped = skip.data();
  nb::gil_scoped_release release;
  tbb::parallel_for(std::size_t{0}, pairs.size() * C, [&](std::size_t task) {
    const std::uint16_t* first = stack.data[pairs[task / C].first] + task % C;
    const std::uint16_t* second = stack.data[pairs[task / C].second] + task % C;
    std::vector<std::uint64_t> sum((codes + 1) * codes, 0);
    for (std::size_t i = 0; i < stack.pixels; ++i) {
      const std::uint32_t za = first[i * C], zb = second[i * C];
      if (za == unusable || zb == unusable || skipped[i]) continue;
      const std::uint32_t u = za & 255, v = zb & 255;
      std::uint64_t* cell = sum.data() + (za >> 8) * codes + (zb >> 8);
      cell[0] += (256 - u) * (256 - v);
      if (v) cell[1] += (256 - u) * v;
      if (u) {
        cell[codes] += u * (256 - v);
        if (v) cell[codes + 1] += u * v;
      }
    }
    body(task, sum.data());
  });
}

// Comparagrams C[pair, channel, a, b]: how many patches show a in the first frame of a pair and
// b in the second.
nb::object comparagrams(const std::vector<Frame<std::uint16_t>>& frames, const Pairs& pairs,
                        const Marks& skip) {
  const Stack<std::uint16_t> stack(frames);
  constexpr std::size_t cells = codes * codes;
  auto counts = std::make_unique<float[]>(pairs.size() * stack.channels * cells);
  each_comparagram(stack, pairs, skip, [&](std::size_t task, const std::uint64_t* sum) {
    for (std::size_t j = 0; j < cells; ++j)
      counts[task * cells + j] = static_cast<float>(static_cast<double>(sum[j]) / whole);
  });
  return to_numpy(std::move(counts), {pairs.size(), stack.channels, codes, codes});
}

// Ridges of the comparagrams, (pairs, channels, 4, 256): for each b how many patches show it in
// the second frame of a pair, and the three quartiles of what they show in the first. A cell
// spreads evenly over a - 1/2 .. a + 1/2.
nb::object ridges(const std::vector<Frame<std::uint16_t>>& frames, const Pairs& pairs,
                  const Marks& skip) {
  const Stack<std::uint16_t> stack(frames);
  auto found = std::make_unique<double[]>(pairs.size() * stack.channels * 4 * codes);
  each_comparagram(stack, pairs, skip, [&](std::size_t task, const std::uint64_t* sum) {
    double* row = found.get() + task * 4 * codes;
    std::vector<std::uint64_t> total(codes, 0), below(codes, 0);
    for (std::size_t a = 0; a < codes; ++a)
      for (std::size_t b = 0; b < codes; ++b) total[b] += sum[a * codes + b];
    for (std::size_t b = 0; b < codes; ++b) row[b] = static_cast<double>(total[b]) / whole;
    for (std::size_t a = 0; a < codes; ++a)
      for (std::size_t b = 0; b < codes; ++b) {
        const std::uint64_t here = sum[a * codes + b];
        if (here == 0) continue;
        for (std::size_t q = 1; q <= 3; ++q) {
          const double wanted = 0.25 * static_cast<double>(q * total[b]);
          const double start = static_cast<double>(below[b]);
          if (start < wanted && wanted <= start + static_cast<double>(here))
            row[q * codes + b] =
                static_cast<double>(a) - 0.5 + (wanted - start) / static_cast<double>(here);
        }
        below[b] += here;
      }
  });
  return to_numpy(std::move(found), {pairs.size(), stack.channels, 4, codes});
}

}  // namespace

void bind_response(nb::module_& m) {
  m.def("patches", &patches<std::uint8_t>, nb::arg("image"), nb::arg("knot"), nb::arg("size"),
        nb::arg("spread"));
  m.def("patches", &patches<std::uint16_t>, nb::arg("image"), nb::arg("knot"), nb::arg("size"),
        nb::arg("spread"));
  m.def("unchanging", &unchanging, nb::arg("frames"), nb::arg("least"), nb::arg("bright"));
  m.def("ridges", &ridges, nb::arg("frames"), nb::arg("pairs"), nb::arg("skip"));
  m.def("comparagrams", &comparagrams, nb::arg("frames"), nb::arg("pairs"), nb::arg("skip"));
  m.def("accumulate", &accumulate, nb::arg("frames"), nb::arg("weights"));
  m.def("residuals", &residuals, nb::arg("frames"), nb::arg("weights"), nb::arg("g"), nb::arg("tau"));
}
