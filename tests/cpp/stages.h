// Runs the stages of the CPU path one after the other, project -> bin -> blend and back, without torch.
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "cpu/stages.h"

namespace ar::test {

/// What a pass reads. Without `count` channels of 3 it blends the colours in the splats.
template <typename T> struct Pass {
  CameraView<T> camera = {};
  Gaussians<T> gaussians = {};
  FootprintChoice footprint = {};
  const T* background = nullptr;  ///< [count]
  const T* dL_dimage = nullptr;   ///< [count, height, width], or null: zero
  const T* dL_dalpha = nullptr;   ///< [height, width], or null
  int threads = 1;
  int count = 3;
  const T* given = nullptr;  ///< [gaussians, given_count] channels that come before those of the projection
  int given_count = 0;
  int color = -1, depth = -1, inverse_depth = -1;  ///< columns of the channels that the projection writes
  bool absolute = true;

  bool has_channels() const { return given_count > 0 || color >= 0 || depth >= 0 || inverse_depth >= 0; }
};

/// What the stages write. Gradients lie in one array: means, scales, rotations, opacities, colours, means2d; then
/// cov3ds and coefficients, where these are given.
template <typename T> struct Rendered {
  std::vector<T> image, alpha, grads;
  std::vector<int32_t> radii;
  int64_t pairs = 0;
  std::vector<T> dL_dchannels;  ///< [gaussians, count], if there are channels
  std::vector<T> camera_grad;   ///< of a full camera: the numbers of CameraGrad
};

template <typename T> struct GradArrays {
  std::vector<T> all;
  GaussianGrads<T> views = {};
  /// -7 where something is to be written.
  explicit GradArrays(const Gaussians<T>& g)
      : GradArrays(g.n, g.cov3ds ? g.n : 0, g.shs ? g.n * g.sh_stride : 0, g.colors != nullptr) {}

 private:
  GradArrays(int64_t n, int64_t cov3ds, int64_t shs, bool colors) : all(18 * n + 6 * cov3ds + 3 * shs, T(-7)) {
    T* p = all.data();
    views.means = reinterpret_cast<Vec3<T>*>(p);
    views.scales = reinterpret_cast<Vec3<T>*>(p + 3 * n);
    views.rotations = reinterpret_cast<Vec4<T>*>(p + 6 * n);
    views.opacities = p + 10 * n;
    if (colors) views.colors = reinterpret_cast<Vec3<T>*>(p + 11 * n);
    if (!colors) std::fill_n(p + 11 * n, 3 * n, T(0));
    views.means2d = p + 14 * n;
    views.means2d_stride = 4;
    if (cov3ds) views.cov3ds = reinterpret_cast<Sym3<T>*>(p + 18 * n);
    if (shs) views.shs = reinterpret_cast<Vec3<T>*>(p + 18 * n + 6 * cov3ds);
  }
};

/// Splats by tile, as `bin` leaves them.
template <typename T> struct Lists {
  std::vector<T> splats, depths;
  std::vector<int32_t> ids, pairs;
  std::vector<int64_t> tile_offsets, splat_offsets, positions;

  /// Fills the lists from splats, ids and depths.
  void bin(const cpu::Stages<T>& stages, FootprintChoice footprint, TileGrid grid, int threads) {
    tile_offsets.resize(grid.tiles() + 1);
    splat_offsets.assign(ids.size() + 1, 0);
    cpu::BinParams<T> p = {};
    p.splats = splats.data();
    p.depths = depths.data();
    p.n = int64_t(ids.size());
    p.footprint = footprint.index;
    p.grid = grid;
    p.threads = threads;
    p.tile_offsets = tile_offsets.data();
    p.splat_offsets = splat_offsets.data();
    stages.count_pairs(p);
    pairs.resize(tile_offsets.back());
    positions.resize(tile_offsets.back());
    p.pairs = pairs.data();
    p.positions = positions.data();
    stages.scatter_pairs(p);
  }

  cpu::TileLists view() const { return {pairs.data(), tile_offsets.data()}; }
  cpu::SplatPairs splat_pairs() const {
    return {int64_t(ids.size()), ids.data(), splat_offsets.data(), positions.data()};
  }
};

/// Sums of pairs and, where there are channels, of splats.
template <typename T> struct Sums {
  std::vector<T> pairs, channel_sums, dL_dchannels;
  std::vector<Vec2<T>> absolute;
  int64_t stride = 0;
};

template <typename T> struct Image {
  std::vector<T> image, alpha, transmittance;
  std::vector<int32_t> last;
};

/// What is blended: the splats' own colours, or rows of channels.
template <typename T>
Channels<T> channels_of(const Lists<T>& lists, bool own, const T* rows, int count, bool by_gaussian) {
  Channels<T> channels = {};
  channels.data = own ? lists.splats.data() + kSplatColor : rows;
  channels.stride = own ? kSplatWidth : count;
  channels.ids = !own && by_gaussian ? lists.ids.data() : nullptr;
  channels.count = count;
  return channels;
}

template <typename T>
Image<T> blend(const cpu::Stages<T>& stages, const Lists<T>& lists, TileGrid grid, Channels<T> channels,
               const T* background, int threads) {
  const int64_t plane = int64_t(grid.width) * grid.height;
  Image<T> out;
  out.image.resize(channels.count * plane);
  out.alpha.resize(plane);
  out.transmittance.resize(stages.samples * plane);
  out.last.resize(stages.samples * plane);
  std::vector<T> scratch(threads * channels.count * kTile * kTile);
  cpu::BlendParams<T> p = {};
  p.grid = grid;
  p.splats = lists.splats.data();
  p.channels = channels;
  p.background = background;
  p.image.first = out.image.data();
  p.image.split = channels.count;
  p.alpha = out.alpha.data();
  p.transmittance = out.transmittance.data();
  p.last = out.last.data();
  p.lists = lists.view();
  p.threads = threads;
  p.scratch = scratch.data();
  stages.blend(p);
  return out;
}

/// `own`: the channels are the colours in the splats, whose sums follow each PairGrad. Else dL_dchannels has a row for
/// each of `rows` Gaussians or splats.
template <typename T>
Sums<T> blend_vjp(const cpu::Stages<T>& stages, const Lists<T>& lists, TileGrid grid, Channels<T> channels, bool own,
                  int64_t rows, const Image<T>& image, const T* background, const T* dL_dimage, const T* dL_dalpha,
                  bool absolute, int threads) {
  const int64_t n = int64_t(lists.pairs.size());
  Sums<T> out;
  out.stride = cpu::kPairNumbers + (own ? 3 : 0);
  out.pairs.resize(n * out.stride);
  if (absolute) out.absolute.resize(n);
  std::vector<T> scratch(threads * channels.count * kTile * kTile);
  cpu::BlendVjpParams<T> p = {};
  p.grid = grid;
  p.splats = lists.splats.data();
  p.channels = channels;
  p.background = background;
  p.transmittance = image.transmittance.data();
  p.last = image.last.data();
  p.dL_dimage.first = dL_dimage;
  p.dL_dimage.split = channels.count;
  p.dL_dalpha = dL_dalpha;
  p.lists = lists.view();
  p.threads = threads;
  p.scratch = scratch.data();
  std::vector<T> replay(stages.moves ? threads * cpu::kReplayNumbers : 0);
  p.replay = replay.empty() ? nullptr : replay.data();
  p.pair_grads = out.pairs.data();
  p.pair_stride = out.stride;
  p.mean_sums = absolute ? MeanSums::kAbsolute : MeanSums::kNone;
  p.pair_means = absolute ? out.absolute.data() : nullptr;
  if (own) {
    p.count = 3;
    p.channel_sums = out.pairs.data() + cpu::kPairNumbers;
    p.channel_stride = out.stride;
    stages.blend_vjp(p);
    return out;
  }
  p.channel_stride = std::min(channels.count, cpu::kWindow);
  out.channel_sums.resize(n * p.channel_stride);
  out.dL_dchannels.assign(rows * channels.count, T(0));
  p.channel_sums = out.channel_sums.data();
  cpu::SumChannelsParams<T> sum = {};
  sum.pairs = lists.splat_pairs();
  sum.threads = threads;
  sum.channel_sums = p.channel_sums;
  sum.channel_stride = p.channel_stride;
  sum.by_gaussian = channels.ids != nullptr;
  sum.dL_dchannels = out.dL_dchannels.data();
  sum.stride = channels.count;
  for (p.first = 0; p.first < channels.count; p.first += cpu::kWindow) {
    sum.first = p.first;
    sum.count = p.count = std::min(channels.count - p.first, cpu::kWindow);
    stages.blend_vjp(p);
    stages.sum_channels(sum);
    p.pair_grads = nullptr;
  }
  return out;
}

template <typename T> Rendered<T> run_stages(const cpu::Stages<T>& stages, const Pass<T>& pass) {
  const Gaussians<T>& g = pass.gaussians;
  const TileGrid grid = {pass.camera.width, pass.camera.height};
  const cpu::CameraStages<T>& of_camera = stages.of(pass.camera);
  Rendered<T> out;
  out.radii.resize(g.n);
  std::vector<T> rows(pass.has_channels() ? g.n * pass.count : 0);
  for (int64_t i = 0; pass.given && i < g.n; ++i)
    std::copy_n(pass.given + i * pass.given_count, pass.given_count, rows.data() + i * pass.count);
  std::vector<uint8_t> candidates(g.n);
  std::vector<int64_t> chunk_offsets(cpu::chunks_of(g.n) + 1);
  Lists<T> lists;

  cpu::ProjectParams<T> project = {};
  project.camera = pass.camera;
  project.gaussians = g;
  project.footprint = pass.footprint;
  project.radii = out.radii.data();
  if (pass.color >= 0 || pass.depth >= 0 || pass.inverse_depth >= 0)
    project.channels = {rows.data(), pass.count, pass.color, pass.depth, pass.inverse_depth};
  if (pass.given) project.given = {pass.given, pass.given_count, nullptr, pass.given_count};
  project.bounds = cull_bounds<T>(pass.footprint);
  project.threads = pass.threads;
  project.candidates = candidates.data();
  project.chunk_offsets = chunk_offsets.data();
  of_camera.count_candidates(project);
  int64_t n = 0;
  for (int64_t& offset : chunk_offsets) n += std::exchange(offset, n);
  lists.splats.resize(n * kSplatWidth);
  lists.depths.resize(n);
  lists.ids.resize(n);
  project.splats = lists.splats.data();
  project.depths = lists.depths.data();
  project.ids = lists.ids.data();
  of_camera.project(project);

  lists.bin(stages, pass.footprint, grid, pass.threads);
  out.pairs = int64_t(lists.pairs.size());
  const bool own = !pass.has_channels();
  const Channels<T> channels = channels_of(lists, own, rows.data(), pass.count, true);
  const Image<T> image = blend(stages, lists, grid, channels, pass.background, pass.threads);
  const Sums<T> sums = blend_vjp(stages, lists, grid, channels, own, g.n, image, pass.background, pass.dL_dimage,
                                 pass.dL_dalpha, pass.absolute, pass.threads);

  GradArrays<T> grads(g);
  std::vector<CameraGrad<T>> camera_grads(pass.camera.lens ? cpu::chunks_of(g.n) : 0, CameraGrad<T>{});
  cpu::ProjectVjpParams<T> vjp = {};
  vjp.camera = pass.camera;
  vjp.gaussians = g;
  vjp.footprint = pass.footprint;
  vjp.grads = grads.views;
  if (project.channels.data)
    vjp.dL_dchannels = {sums.dL_dchannels.data(), pass.count, pass.color, pass.depth, pass.inverse_depth};
  vjp.pairs = lists.splat_pairs();
  vjp.threads = pass.threads;
  vjp.pair_grads = sums.pairs.data();
  vjp.pair_stride = sums.stride;
  vjp.pair_colors = own;
  vjp.grads.mean_sums = pass.absolute ? MeanSums::kAbsolute : MeanSums::kNone;
  vjp.pair_means = pass.absolute ? sums.absolute.data() : nullptr;
  vjp.camera_grads = pass.camera.lens ? camera_grads.data() : nullptr;
  of_camera.project_vjp(vjp);

  out.camera_grad.resize(pass.camera.lens ? kCameraGradWidth : 0);
  for (const CameraGrad<T>& chunk : camera_grads) {
    for (int k = 0; k < kCameraGradWidth; ++k) out.camera_grad[k] += reinterpret_cast<const T*>(&chunk)[k];
  }
  out.image = image.image;
  out.alpha = image.alpha;
  out.dL_dchannels = sums.dL_dchannels;
  out.grads = std::move(grads.all);
  return out;
}

}  // namespace ar::test
