// What each stage of the CUDA path reads and writes, and the table of stages of one footprint. All
// pointers are views of device memory that the caller owns. Every function enqueues work on a stream
// and returns; none waits for the device.
//
// Sizes that depend on the data stay on the device. The caller guesses how many pairs there will be
// and gives room for `capacity` of them. If there are more, no pair is written, and blending goes
// through all splats in depth order for every tile: slow, with the same result, and without a host.
#pragma once

#include <cuda_runtime_api.h>

#include <string_view>

#include "core/params.h"

namespace ar::cuda {

/// Floats per row of pair gradients: PairGrad, sums of |dL/dmean| per coordinate, one to align.
inline constexpr int kPairGradWidth = 12;

/// Pairs of a tile that blend_vjp takes as one piece of work, and between which blend leaves
/// checkpoints. Checkpoints hold a sample each, so many samples get longer chunks.
inline constexpr int chunk_length(int samples) { return samples <= 4 ? 256 : 64 * samples; }

/// Chunks of a tile that blend goes through one after the other, knowing which pixels have stopped.
/// The rest is blended side by side and merged.
inline constexpr int kFrontChunks = 2;

/// Depth keys of splats without pairs: after all others.
inline constexpr uint32_t kCulledKey = 0x7fffffff;

/// Where the pairs of a splat are, in order of emission.
struct PairRange {
  int32_t first, count;
};

/// Color and transmittance of a pixel's sample at the end of a chunk.
struct alignas(16) Checkpoint {
  Vec3<float> color;
  float transmittance;  ///< negated where the sample has stopped
};

struct ProjectTask {
  CameraView<float> camera;
  Gaussians<float> gaussians;
  FootprintOptions options;
  float* splats;      ///< [n] Splat<F, float>; only the level of those with radius 0
  uint32_t* keys;     ///< [n] in the order of depth
  int32_t* ids;       ///< [n] 0, 1, 2, ...
  PairRange* ranges;  ///< [n] count
  int32_t* radii;     ///< [n]
};

struct BinTask {
  const float* splats;
  int64_t n;
  TileGrid grid;
  int64_t capacity;
  const int32_t* order;    ///< [n] splats by depth
  const int64_t* offsets;  ///< [n + 1] first pair of each, in that order
  PairRange* ranges;       ///< [n] first, by splat, written with `owners`
  uint32_t* tiles;         ///< [capacity] tile of each pair
  int32_t* values;         ///< [capacity] splat of each pair; with `owners` the pair itself
  int32_t* owners;         ///< [capacity] splat of each pair, or null
};

/// The lists of splats that blend walks.
struct TileLists {
  const float* splats;
  const int32_t* pairs;         ///< [capacity] splats by tile, then depth
  const int64_t* tile_offsets;  ///< [tiles + 1]
  const int32_t* order;         ///< [n] all splats by depth
  const int64_t* pair_count;
  int64_t n, capacity;
};

/// How the lists are cut into chunks; made by plan_chunks.
struct ChunkPlan {
  int32_t* chunk_offsets;       ///< [tiles + 1] first chunk of each tile
  int32_t* chunk_tiles;         ///< [chunks] tile of each chunk
  int32_t* checkpoint_offsets;  ///< [tiles] place of a tile's first checkpoint, if it has several chunks
  int32_t* rest;                ///< [rest_count] chunks behind the front ones
  int32_t* rest_count;
};

struct BlendTask {
  TileLists lists;
  ChunkPlan plan;
  TileGrid grid;
  const float* background;  ///< [3]
  int32_t* tile_open;       ///< [tiles] whether the front chunks left an open sample and pairs
  Checkpoint* checkpoints;  ///< [checkpoints, samples, 256]
  float* image;             ///< [3, height, width]
  float* transmittance;     ///< [samples, height, width], or null without backward pass
  int32_t* last;            ///< [samples, height, width], or null; the splats up to which a sample composited
};

struct BlendVjpTask {
  TileLists lists;
  ChunkPlan plan;
  TileGrid grid;
  int64_t max_chunks;
  const float* background;
  const Checkpoint* checkpoints;
  const float* transmittance;
  const int32_t* last;
  const float* dL_dimage;
  float* pair_grads;  ///< [max(capacity, n), kPairGradWidth] by pair, or by splat if there are too many pairs
  bool absolute;      ///< sum |dL/dmean| too
};

struct ProjectVjpTask {
  CameraView<float> camera;
  Gaussians<float> gaussians;
  FootprintOptions options;
  const PairRange* ranges;
  const int32_t* positions;  ///< [capacity] place in pairs of each pair, in order of emission
  const int64_t* pair_count;
  int64_t capacity;
  const float* pair_grads;
  GaussianGrads<float> grads;
};

template <typename T> struct WeightTask {
  int64_t n;
  FootprintOptions options;
  const Vec2<T>* offsets;
  const Sym2<T>* covs;
  const T* dL_dweights;  ///< vjp only
  T* weights;            ///< forward only
  Vec2<T>* dL_doffsets;  ///< vjp only
  Sym2<T>* dL_dcovs;     ///< vjp only
};

struct ForwardStages {
  int samples;
  void (*project)(const ProjectTask&, cudaStream_t);
  void (*emit_pairs)(const BinTask&, cudaStream_t);
  void (*blend)(const BlendTask&, cudaStream_t);
  void (*weight_float)(const WeightTask<float>&, cudaStream_t);
  void (*weight_double)(const WeightTask<double>&, cudaStream_t);
};
struct BackwardStages {
  void (*blend_vjp)(const BlendVjpTask&, cudaStream_t);
  void (*project_vjp)(const ProjectVjpTask&, cudaStream_t);
  void (*weight_vjp_float)(const WeightTask<float>&, cudaStream_t);
  void (*weight_vjp_double)(const WeightTask<double>&, cudaStream_t);
};

/// Stages of the footprint whose kName is `footprint`; null if there is none.
const ForwardStages* find_forward(std::string_view footprint);
const BackwardStages* find_backward(std::string_view footprint);

// The parts of binning that no footprint changes (bin.cu).

/// Bytes of workspace for the sorts and the scan.
size_t workspace_size(int64_t n, int64_t capacity, TileGrid grid);

/// Sorts `ids` by `keys`, stably; sorted_keys is scratch. Then offsets[r + 1] = pairs of the first r + 1 splats.
void sort_by_depth(const uint32_t* keys, const int32_t* ids, const PairRange* ranges, int64_t n, uint32_t* sorted_keys,
                   int32_t* order, int64_t* offsets, void* workspace, size_t bytes, cudaStream_t stream);

/// Sorts pairs by tile, stably, and finds each tile's. With `owners`, writes pairs and positions.
struct SortTask {
  TileGrid grid;
  int64_t capacity;
  const int64_t* pair_count;
  uint32_t *tiles, *sorted_tiles;
  const int32_t *values, *owners;
  int32_t *sorted_values, *pairs, *positions;
  int64_t* tile_offsets;
};
void sort_by_tile(const SortTask& task, void* workspace, size_t bytes, cudaStream_t stream);

/// `feedback` receives the number of pairs: host memory that the device can write, or null.
void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ChunkPlan& plan, int64_t* feedback,
                 cudaStream_t stream);

}  // namespace ar::cuda
