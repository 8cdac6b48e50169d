// Demosaic of a Bayer mosaic of any range; a plain numpy reference in tests/scene.
//
// Green between its samples follows the ratio of local means, one estimate a side, weighted
// against the gradients (the idea of ratio-corrected demosaicing, Sanz Rodriguez 2017): a side's
// correction is a share of its own sample, so no estimate rings around a lamp. Red and blue
// follow the colour differences to green, diagonals first.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <oneapi/tbb/blocked_range2d.h>
#include <oneapi/tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;

namespace {

using Mosaic = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

constexpr int tile = 128, margin = 12, side = tile + 2 * margin;
static_assert(margin % 2 == 0 && tile % 2 == 0, "a tile keeps the phase of the mosaic");

// -1 -> 1, n -> n - 2: keeps the colour of a Bayer pixel.
inline std::ptrdiff_t reflect(std::ptrdiff_t i, std::ptrdiff_t n) {
  const std::ptrdiff_t period = 2 * (n - 1);
  i = ((i % period) + period) % period;
  return i < n ? i : period - i;
}

struct Tile {
  std::vector<float> cfa, mean, plane[3], energy[2], steer;

  Tile() {
    for (auto* p : {&cfa, &mean, &plane[0], &plane[1], &plane[2], &energy[0], &energy[1], &steer})
      p->resize(side * side);
  }
};

// Square of a high pass along `step` that a constant colour difference does not pass.
inline float roughness(const float* c, int step) {
  const float d = c[-3 * step] - c[-step] - c[step] + c[3 * step] -
                  3 * (c[-2 * step] + c[2 * step]) + 6 * c[0];
  return d * d;
}

// Share of direction 1, from the roughness along both, each summed over three pixels.
inline float share(const Tile& t, int i, int along0, int along1) {
  const float a = t.energy[0][i - along0] + t.energy[0][i] + t.energy[0][i + along0];
  const float b = t.energy[1][i - along1] + t.energy[1][i] + t.energy[1][i + along1];
  return a + b > 0 ? a / (a + b) : 0.5f;
}

// The more decided of a pixel's own share and its neighbours' mean.
inline float decided(const float* s) {
  const float around = 0.25f * (s[-side - 1] + s[-side + 1] + s[side - 1] + s[side + 1]);
  return std::abs(0.5f - around) > std::abs(0.5f - s[0]) ? around : s[0];
}

inline float against(float grad0, float value0, float grad1, float value1) {
  return (grad1 * value0 + grad0 * value1) / (grad0 + grad1);
}

// Colour differences overshoot beside a lamp; where no sample around is negative, nothing is.
inline float not_below(const float* plane, int i, const int (&steps)[4], float value) {
  float least = 0;
  for (int s : steps) least = std::min(least, plane[i + s]);
  return std::max(value, least);
}

template <typename Body>
void each(int reach, Body&& body) {
  for (int y = reach; y < side - reach; ++y)
    for (int x = reach; x < side - reach; ++x) body(y, x, y * side + x);
}

// The pixels (y, x) of one parity of y + x.
template <typename Body>
void chequer(int reach, int parity, Body&& body) {
  for (int y = reach; y < side - reach; ++y)
    for (int x = reach + ((reach + y + parity) & 1); x < side - reach; x += 2)
      body(y, y * side + x);
}

void steer(Tile& t, int reach, int step0, int step1) {
  const float* c = t.cfa.data();
  each(reach, [&](int, int, int i) {
    t.energy[0][i] = roughness(c + i, step0);
    t.energy[1][i] = roughness(c + i, step1);
  });
  each(reach + 1, [&](int, int, int i) { t.steer[i] = share(t, i, step0, step1); });
}

// `red` is the parity of y + x of red and blue; rows of parity `row` hold red.
void demosaic(Tile& t, int red, int row) {
  const float* c = t.cfa.data();
  float* green = t.plane[1].data();
  const float tiny = 1e-30f;
  each(1, [&](int, int, int i) {
    t.mean[i] = 0.25f * c[i] +
                0.125f * (c[i - 1] + c[i + 1] + c[i - side] + c[i + side]) +
                0.0625f * (c[i - side - 1] + c[i - side + 1] + c[i + side - 1] + c[i + side + 1]);
  });
  std::copy(t.cfa.begin(), t.cfa.end(), green);

  steer(t, 3, side, 1);  // 0 vertical, 1 horizontal
  chequer(5, red, [&](int, int i) {
    const float eps = 1e-6f * std::abs(t.mean[i]) + tiny;
    float grad[4], value[4];
    const int steps[4] = {-side, side, -1, 1};
    for (int k = 0; k < 4; ++k) {
      const int s = steps[k];
      grad[k] = eps + std::abs(c[i + s] - c[i - s]) + std::abs(c[i] - c[i + 2 * s]) +
                std::abs(c[i + s] - c[i + 3 * s]) + std::abs(c[i + 2 * s] - c[i + 4 * s]);
      // green over the sum of means is at most 1 where colours are not negative
      const float here = t.mean[i], there = t.mean[i + 2 * s], sum = here + there;
      const float ratio = sum > 0 ? std::clamp(c[i + s] / sum, 0.0f, 1.0f) : 0.5f;
      value[k] = c[i + s] + ratio * (here - there);
    }
    const float vertical = against(grad[0], value[0], grad[1], value[1]);
    const float horizontal = against(grad[2], value[2], grad[3], value[3]);
    const float h = decided(&t.steer[i]);
    green[i] = vertical + h * (horizontal - vertical);
  });

  steer(t, 3, side + 1, side - 1);
  for (int colour : {0, 2}) {
    float* plane = t.plane[colour].data();
    const int rows = colour == 0 ? row : 1 - row;  // rows that hold this colour
    chequer(5, red, [&](int y, int i) {
      if ((y & 1) == rows) plane[i] = c[i];
    });
    chequer(8, red, [&](int y, int i) {
      if ((y & 1) == rows) return;
      const float eps = 1e-6f * std::abs(t.mean[i]) + tiny;
      float grad[4], value[4];
      const int steps[4] = {-side - 1, side + 1, -side + 1, side - 1};
      for (int k = 0; k < 4; ++k) {
        const int s = steps[k];
        grad[k] = eps + std::abs(c[i + s] - c[i - s]) + std::abs(c[i + s] - c[i + 3 * s]) +
                  std::abs(green[i] - green[i + 2 * s]);
        value[k] = c[i + s] - green[i + s];
      }
      const float falling = against(grad[0], value[0], grad[1], value[1]);
      const float rising = against(grad[2], value[2], grad[3], value[3]);
      const float r = decided(&t.steer[i]);
      plane[i] = not_below(plane, i, steps, green[i] + falling + r * (rising - falling));
    });
  }

  steer(t, 3, side, 1);
  for (int colour : {0, 2}) {
    float* plane = t.plane[colour].data();
    chequer(margin, 1 - red, [&](int, int i) {
      const float eps = 1e-6f * std::abs(t.mean[i]) + tiny;
      float grad[4], value[4];
      const int steps[4] = {-side, side, -1, 1};
      for (int k = 0; k < 4; ++k) {
        const int s = steps[k];
        grad[k] = eps + std::abs(green[i] - green[i + 2 * s]) +
                  std::abs(plane[i + s] - plane[i - s]) +
                  std::abs(plane[i + s] - plane[i + 3 * s]);
        value[k] = plane[i + s] - green[i + s];
      }
      const float vertical = against(grad[0], value[0], grad[1], value[1]);
      const float horizontal = against(grad[2], value[2], grad[3], value[3]);
      const float h = decided(&t.steer[i]);
      plane[i] = not_below(plane, i, steps, green[i] + vertical + h * (horizontal - vertical));
    });
  }
}

// (H, W) mosaic with red at (row, column) of its 2 x 2 pattern -> (H, W, 3).
nb::object demosaic_bayer(Mosaic mosaic, int row, int column) {
  const std::ptrdiff_t height = mosaic.shape(0), width = mosaic.shape(1);
  if (height < 2 || width < 2) throw std::invalid_argument("a mosaic has two rows and columns");
  if ((row | column) & ~1) throw std::invalid_argument("red is in the first two rows, columns");
  std::unique_ptr<float[]> out(new float[height * width * 3]);
  {
    nb::gil_scoped_release release;
    const float* in = mosaic.data();
    const auto count = [](std::ptrdiff_t n) { return (n + tile - 1) / tile; };
    tbb::parallel_for(
        tbb::blocked_range2d<std::ptrdiff_t>(0, count(height), 0, count(width)),
        [&](const auto& range) {
          Tile t;
          std::ptrdiff_t columns[side];
          for (auto j = range.rows().begin(); j < range.rows().end(); ++j)
            for (auto k = range.cols().begin(); k < range.cols().end(); ++k) {
              const std::ptrdiff_t y0 = j * tile, x0 = k * tile;
              for (int x = 0; x < side; ++x) columns[x] = reflect(x0 + x - margin, width);
              for (int y = 0; y < side; ++y) {
                const float* line = in + reflect(y0 + y - margin, height) * width;
                for (int x = 0; x < side; ++x) t.cfa[y * side + x] = line[columns[x]];
              }
              demosaic(t, (row + column) & 1, row);
              const int h = static_cast<int>(std::min<std::ptrdiff_t>(tile, height - y0));
              const int w = static_cast<int>(std::min<std::ptrdiff_t>(tile, width - x0));
              for (int y = 0; y < h; ++y)
                for (int x = 0; x < w; ++x)
                  for (int p = 0; p < 3; ++p)
                    out[((y0 + y) * width + x0 + x) * 3 + p] =
                        t.plane[p][(y + margin) * side + x + margin];
            }
        });
  }
  float* raw = out.release();
  nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<float*>(p); });
  const std::size_t shape[3] = {std::size_t(height), std::size_t(width), 3};
  return nb::cast(nb::ndarray<nb::numpy, float>(raw, 3, shape, owner));
}

}  // namespace

NB_MODULE(kernel, m) {
  m.def("demosaic", &demosaic_bayer, nb::arg("mosaic"), nb::arg("row"), nb::arg("column"));
}
