#include "filter.h"

#include <algorithm>
#include <iterator>

namespace chromeball {

// Means over the passes, with an apron of the neighbours.
void Filter::load(const FilmTile* const (&around)[9], bool objects, int passes) {
  for (int y = 0; y < kSide; ++y) {
    const int down = y - kApron + kTile;
    for (int x = 0; x < kSide;) {  // from tile to tile
      const int across = x - kApron + kTile, from = across % kTile;
      const int count = std::min(kTile - from, kSide - x), at = y * kSide + x;
      if (const FilmTile* tile = around[down / kTile * 3 + across / kTile]) {
        load(*tile, objects, down % kTile * kTile + from, count, at, passes);
      } else {
        for (float* to : {v_[0], v_[1], v_[2], n_[0], n_[1], n_[2], variance_, share_, group_}) {
          std::fill_n(to + at, count, 0.0f);
        }
      }
      x += count;
    }
  }
}

// `count` pixels of a tile in a row, from i on.
void Filter::load(const FilmTile& tile, bool objects, int i, int count, int at, int passes) {
  const FilmTile::Layer& layer = objects ? tile.objects : tile.set;
  const float per_pass = 1 / float(passes);
  const float* const shares = layer.share + i;
  float* const share = share_ + at;
  float* const variance = variance_ + at;
#pragma GCC ivdep
  for (int k = 0; k < count; ++k) {
    share[k] = shares[k] * per_pass;
    variance[k] = shares[k] > 0 ? layer.variance[i + k] * per_pass * per_pass : 0.0f;
  }
  std::copy_n(layer.group + i, count, group_ + at);
  const float* const sums[3] = {layer.r, layer.g, layer.b};
  for (int c = 0; c < 3; ++c) {
    const float* const base = (objects ? tile.albedo[c] : layer.share) + i;
    const float* const sum = sums[c] + i;
    float* const v = v_[c] + at;
#pragma GCC ivdep
    for (int k = 0; k < count; ++k) v[k] = base[k] > 0 ? sum[k] / base[k] : 0.0f;
  }
  if (!objects) return;
  const float *const nx = layer.nx + i, *const ny = layer.ny + i, *const nz = layer.nz + i;
#pragma GCC ivdep
  for (int k = 0; k < count; ++k) {
    const float l = std::sqrt(nx[k] * nx[k] + ny[k] * ny[k] + nz[k] * nz[k]);
    const float inverse = l > 0 ? 1 / l : 0.0f;
    n_[0][at + k] = nx[k] * inverse;
    n_[1][at + k] = ny[k] * inverse;
    n_[2][at + k] = nz[k] * inverse;
  }
}

void Filter::run(const FilmTile* const (&around)[9], bool objects, int passes, bool filter) {
  const bool any = std::any_of(std::begin(around), std::end(around), [&](const FilmTile* tile) {
    return tile && (objects ? tile->has_objects : tile->has_change);
  });
  if (!any) {
    std::fill_n(out_[0], 4 * kTile * kTile, 0.0f);
    return;
  }
  load(around, objects, passes);
  if (filter) {
    objects ? smooth<true>(passes) : smooth<false>(passes);
    return;
  }
  for (int y = 0; y < kTile; ++y) {
    for (int x = 0; x < kTile; ++x) {
      const int at = (y + kApron) * kSide + x + kApron;
      for (int c = 0; c < 3; ++c) out_[c][y * kTile + x] = v_[c][at];
      out_[3][y * kTile + x] = variance_[at];
    }
  }
}

template <bool kGuided>
void Filter::smooth(int passes) {
  // how alike two places' surfaces are: 0 across surfaces
  const auto alike = [&](int p, int q) {
    const float same = group_[p] == group_[q] ? share_[q] : 0.0f;
    if constexpr (!kGuided) return same;
    const float cos = std::max(
        0.0f, n_[0][p] * n_[0][q] + n_[1][p] * n_[1][q] + n_[2][p] * n_[2][q]);
    const float c2 = cos * cos, c4 = c2 * c2, c8 = c4 * c4;
    return same * c8 * c8;
  };

  // A window's ends count half, so that it holds each of 4 x 4 kinds of pixels equally often.
  const auto edge = [](int d, int half) { return std::abs(d) == half ? 0.5f : 1.0f; };

  constexpr int kInner = kSide - 2 * kMeans;
  for (int y = kMeans; y < kSide - kMeans; ++y) {
    float sum[kInner] = {}, noise[kInner] = {}, weight[kInner] = {};
    for (int dy = -kMeans; dy <= kMeans; ++dy) {
      for (int dx = -kMeans; dx <= kMeans; ++dx) {
        const int row = y * kSide + kMeans, off = dy * kSide + dx;
        const float part = edge(dx, kMeans) * edge(dy, kMeans);
#pragma GCC ivdep
        for (int x = 0; x < kInner; ++x) {
          const int p = row + x, q = p + off;
          const float w = part * alike(p, q);
          sum[x] += w * (v_[0][q] + v_[1][q] + v_[2][q]);
          noise[x] += w * variance_[q];
          weight[x] += w;
        }
      }
    }
    for (int x = 0; x < kInner; ++x) {
      const float inverse = weight[x] > 0 ? 1 / weight[x] : 0.0f;
      mean_[y * kSide + kMeans + x] = sum[x] * inverse * (1.0f / 3);
      noise_[y * kSide + kMeans + x] = noise[x] * inverse;
    }
  }

  constexpr float kWindow = (2 * kMeans) * (2 * kMeans);
  // Of squared differences of means, over variances. Stratified rays agree ever better than the
  // variance of single ones says.
  const float tolerance = (kGuided ? 8.0f : 3.0f) / (kWindow * float(passes));
  for (int y = 0; y < kTile; ++y) {
    alignas(64) float sum[4][kTile] = {}, weight[kTile] = {};
    const int row = (y + kApron) * kSide + kApron;
    for (int dy = -kReach; dy <= kReach; ++dy) {
      for (int dx = -kReach; dx <= kReach; ++dx) {
        const int off = dy * kSide + dx;
        const float part = edge(dx, kReach) * edge(dy, kReach);
#pragma GCC ivdep
        for (int x = 0; x < kTile; ++x) {
          const int p = row + x, q = p + off;
          const float difference = mean_[p] - mean_[q];
          const float allowed = tolerance * (noise_[p] + noise_[q]) + 1e-12f;
          const float near = std::max(0.0f, 1 - difference * difference / allowed);
          const float w = part * alike(p, q) * near * near;
          sum[0][x] += w * v_[0][q], sum[1][x] += w * v_[1][q], sum[2][x] += w * v_[2][q];
          sum[3][x] += w * w * variance_[q];
          weight[x] += w;
        }
      }
    }
    for (int x = 0; x < kTile; ++x) {
      const float inverse = weight[x] > 0 ? 1 / weight[x] : 0.0f;
      for (int c = 0; c < 3; ++c) out_[c][y * kTile + x] = sum[c][x] * inverse;
      out_[3][y * kTile + x] = sum[3][x] * inverse * inverse;
    }
  }
}

}  // namespace chromeball
