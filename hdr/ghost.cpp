// How far the frames of a bracket contradict each other, per pixel; numpy reference in tests/hdr.

#include <oneapi/tbb/blocked_range.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "kernel.h"

namespace {

using Picture8 = nb::ndarray<const std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Masks = nb::ndarray<const bool, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// What a code of one frame says: ln radiance, its variance and the variance per squared code.
struct Entry {
  float value, variance, slope2;
};

struct Range {
  int low, high;  // codes between which a frame measures
};

struct Stack3 {
  std::vector<const std::uint8_t*> frames;
  std::vector<const bool*> valid;
  std::vector<Entry> table;   // (P, C, 256)
  std::vector<Range> ranges;  // (P, C)
  std::size_t height, width;
  float edge;  // (pixels / 2)^2: the misalignment to allow for
};

// Largest less smallest code over 3 x 3 pixels; rows outside are the nearest inside.
void spread_row(const std::uint8_t* image, std::size_t y, std::size_t height, std::size_t width,
                std::size_t C, std::uint8_t* low, std::uint8_t* high, std::uint8_t* out) {
  const std::size_t n = width * C;
  const std::uint8_t* rows[3] = {image + (y ? y - 1 : 0) * n, image + y * n,
                                 image + std::min(y + 1, height - 1) * n};
  for (std::size_t k = 0; k < n; ++k) {
    low[k] = std::min({rows[0][k], rows[1][k], rows[2][k]});
    high[k] = std::max({rows[0][k], rows[1][k], rows[2][k]});
  }
  for (std::size_t k = 0; k < n; ++k) {
    const std::size_t before = k >= C ? k - C : k, after = k + C < n ? k + C : k;
    out[k] = std::max({high[before], high[k], high[after]}) -
             std::min({low[before], low[k], low[after]});
  }
}

template <std::size_t C>
void score_rows(const Stack3& s, std::size_t from, std::size_t to, std::uint8_t* out) {
  const std::size_t P = s.frames.size(), n = s.width * C;
  std::vector<std::uint8_t> low(n), high(n), spread(P * n);
  std::vector<float> value(P), weight(P);
  std::vector<std::uint8_t> bent(P);
  for (std::size_t y = from; y < to; ++y) {
    for (std::size_t j = 0; j < P; ++j)
      spread_row(s.frames[j], y, s.height, s.width, C, low.data(), high.data(), &spread[j * n]);
    for (std::size_t x = 0; x < s.width; ++x) {
      const std::size_t at = y * s.width + x;
      // Once a channel clips, the camera bends the colour: the others measure nothing either.
      for (std::size_t j = 0; j < P; ++j) {
        bent[j] = 0;
        for (std::size_t c = 0; c < C; ++c) bent[j] |= s.frames[j][at * C + c] > s.ranges[j * C + c].high;
      }
      float total = 0;
      for (std::size_t c = 0; c < C; ++c) {
        float sum = 0, weights = 0, worst = 0, measured = 0;
        float least = -1e30f, most = 1e30f, least_variance = 0, most_variance = 0;
        for (std::size_t j = 0; j < P; ++j) {
          weight[j] = 0;
          if (s.valid[j] && !s.valid[j][at]) continue;
          const int z = s.frames[j][at * C + c];
          const Range range = s.ranges[j * C + c];
          const Entry& entry = s.table[(j * C + c) * codes + std::clamp(z, range.low, range.high)];
          const float d = spread[j * n + x * C + c];
          const float variance = entry.variance + s.edge * d * d * entry.slope2;
          if (z > range.high) {
            if (entry.value > least) least = entry.value, least_variance = variance;
          } else if (bent[j]) {
            continue;
          } else if (z < range.low) {
            if (entry.value < most) most = entry.value, most_variance = variance;
          } else {
            weight[j] = 1 / variance;
            value[j] = entry.value;
            weights += weight[j];
            measured += 1;
            sum += weight[j] * value[j];
          }
        }
        // Each frame against all others. Errors of the curve and of exposures are common to many
        // frames, so their mean is held to be no better than one of them: (n - 1) / rest.
        for (std::size_t j = 0; j < P; ++j) {
          const float rest = weights - weight[j];
          if (!(weight[j] > 0) || rest < 1e-6f * weights) continue;
          const float d = value[j] - (sum - weight[j] * value[j]) / rest;
          worst = std::max(worst, d * d / (1 / weight[j] + (measured - 1) / rest));
        }
        if (weights > 0) {
          const float mean = sum / weights;
          const float above = std::max(least - mean, 0.0f), below = std::max(mean - most, 0.0f);
          worst = std::max({worst, above * above / (measured / weights + least_variance),
                            below * below / (measured / weights + most_variance)});
        } else if (least > most) {
          worst = (least - most) * (least - most) / (least_variance + most_variance);
        }
        total += std::min(worst, 1000.0f);
      }
      out[at] = static_cast<std::uint8_t>(std::min(8 * std::sqrt(total / C), 255.0f));
    }
  }
}

// table: (P, C, 256, 3) of ln radiance, variance, squared slope; ranges: (P, C, 2), lowest and
// highest code that measures. 8 times the rms over channels of the largest deviation in
// standard deviations, 255 at most.
nb::object ghost_scores(const std::vector<Picture8>& frames,
                        nb::ndarray<const double, nb::ndim<4>, nb::c_contig, nb::device::cpu> table,
                        nb::ndarray<const std::int32_t, nb::ndim<3>, nb::c_contig, nb::device::cpu> ranges,
                        const std::vector<Masks>& valid, double misaligned) {
  if (frames.empty()) throw std::invalid_argument("no frames");
  const std::size_t P = frames.size(), C = frames[0].shape(2);
  Stack3 s{{}, {}, {}, {}, frames[0].shape(0), frames[0].shape(1),
           static_cast<float>(0.25 * misaligned * misaligned)};
  if (C != 1 && C != 3) throw std::invalid_argument("one or three channels");
  for (const auto& frame : frames) {
    if (frame.shape(0) != s.height || frame.shape(1) != s.width || frame.shape(2) != C)
      throw std::invalid_argument("frames of different shapes");
    s.frames.push_back(frame.data());
  }
  if (table.shape(0) != P || table.shape(1) != C || table.shape(2) != codes ||
      table.shape(3) != 3 || ranges.shape(0) != P || ranges.shape(1) != C || ranges.shape(2) != 2)
    throw std::invalid_argument("tables do not match the frames");
  if (!valid.empty() && valid.size() != P) throw std::invalid_argument("one mask a frame");
  s.valid.assign(P, nullptr);
  for (std::size_t j = 0; j < valid.size(); ++j) {
    if (valid[j].shape(0) != s.height || valid[j].shape(1) != s.width)
      throw std::invalid_argument("masks of another size");
    s.valid[j] = valid[j].data();
  }
  for (std::size_t k = 0; k < P * C * codes; ++k)
    s.table.push_back({static_cast<float>(table.data()[3 * k]),
                       static_cast<float>(table.data()[3 * k + 1]),
                       static_cast<float>(table.data()[3 * k + 2])});
  for (std::size_t k = 0; k < P * C; ++k) {
    const Range range{ranges.data()[2 * k], ranges.data()[2 * k + 1]};
    if (range.low < 0 || range.high > 255 || range.low > range.high)
      throw std::invalid_argument("codes outside 0 .. 255");
    s.ranges.push_back(range);
  }
  std::unique_ptr<std::uint8_t[]> out(new std::uint8_t[s.height * s.width]);
  {
    nb::gil_scoped_release release;
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, s.height, 16), [&](const auto& r) {
      (C == 1 ? score_rows<1> : score_rows<3>)(s, r.begin(), r.end(), out.get());
    });
  }
  return to_numpy(std::move(out), {s.height, s.width});
}

}  // namespace

void bind_ghost(nb::module_& m) {
  m.def("ghost_scores", &ghost_scores, nb::arg("frames"), nb::arg("table"), nb::arg("ranges"),
        nb::arg("valid"), nb::arg("misaligned"));
}
