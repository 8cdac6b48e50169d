// Joint statistics of code tuples, for the response solvers; numpy references in tests/hdr.

#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>

#include "kernel.h"

namespace {

constexpr std::size_t slices = 4;  // fixed, so that sums do not depend on the thread count

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

}  // namespace

void bind_response(nb::module_& m) {
  m.def("patches", &patches, nb::arg("image"), nb::arg("size"), nb::arg("spread"));
  m.def("shares", &shares, nb::arg("frames"), nb::arg("weights"));
  m.def("accumulate", &accumulate, nb::arg("frames"), nb::arg("weights"), nb::arg("share"));
  m.def("residuals", &residuals, nb::arg("frames"), nb::arg("weights"), nb::arg("share"), nb::arg("g"),
        nb::arg("tau"));
}
