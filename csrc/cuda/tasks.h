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

#include "core/camera.h"
#include "core/weight.h"

namespace ar::cuda {

/// Floats per row of pair gradients: PairGrad, sums of |dL/dmean| per coordinate, one to align.
inline constexpr int kPairGradWidth = 12;

/// Pairs of a tile that blend_vjp takes as one piece of work, and between which blend leaves
/// checkpoints. Checkpoints hold a sample each, so many samples get longer chunks.
inline constexpr int chunk_length(int samples) { return samples <= 4 ? 256 : 64 * samples; }

/// Chunks of a tile that blend goes through one after the other, which reads no pair behind the point
/// where all pixels have stopped. The rest is blended side by side. With many tiles there is enough to
/// do side by side; with few, a long list must not keep a single block busy.
AR_HD int front_chunks(TileGrid grid, int samples) {
  const int pairs = grid.tiles() >= 2048 ? 2048 : 256;
  return pairs > chunk_length(samples) ? pairs / chunk_length(samples) : 1;
}

/// Depth keys of splats without pairs: after all others.
inline constexpr uint32_t kCulledKey = 0x7fffffff;

/// Where the pairs of a splat are, in the order in which they are emitted.
struct PairRange {
  int32_t first, count;
};

/// A pair, and its place in that order: where blend_vjp leaves its gradient.
struct alignas(8) SlotPair {
  int32_t splat, slot;
};

/// 1, 2, 4, 8 or 16 samples.
inline constexpr int kSampleClasses = 5;
AR_HD constexpr int sample_class(int samples) {
  int c = 0;
  for (; samples > 1; samples /= 2) ++c;
  return c;
}

/// Where the work of a plan is by sample_class: [first[c], first[c + 1]).
struct SampleParts {
  int32_t first[kSampleClasses + 1];
};

/// What the device finds out.
struct alignas(8) Counts {
  int64_t pairs, splats;      ///< splats: with pairs
  int32_t planes, rest;       ///< of the plan
  SampleParts tiles, chunks;  ///< of the plan's orders
  /// Tiles that the front chunks left with an open sample and pairs, by sample_class: those of different
  /// samples are blended side by side.
  int32_t open_tiles[kSampleClasses];
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
  float* splats;      ///< [n] Splat<F, float>; nothing of those with radius 0
  uint32_t* keys;     ///< [n] in the order of depth
  PairRange* ranges;  ///< [n] count
  int32_t* radii;     ///< [n]
};

struct EmitTask {
  const float* splats;
  int64_t n;
  TileGrid grid;
  int64_t capacity;
  const Counts* counts;
  const int32_t* order;  ///< [counts->splats] splats by depth
  PairRange* ranges;     ///< [n] first
  uint32_t* status;      ///< emit_scratch(n) bytes, zero
  uint32_t* tiles;       ///< [capacity] tile of each pair
  int32_t* splat_pairs;  ///< [capacity] splat of each pair, or null:
  SlotPair* slot_pairs;  ///< [capacity] the same with its slot, for a backward pass
};

/// The lists of splats that blend walks.
struct TileLists {
  const float* splats;
  const int32_t* pairs;         ///< [capacity, stride] splats by tile, then depth, and their slots
  int stride;                   ///< 1, or 2 with slots
  const int64_t* tile_offsets;  ///< [tiles + 1]
  const int32_t* order;         ///< [counts->splats] all splats with pairs by depth
  Counts* counts;
  int64_t n, capacity;
  int32_t* tile_samples;  ///< [tiles] samples in use, or null: all
};

inline constexpr int kPlanCounters = 4 * 33 * kSampleClasses;

struct TileChunk {
  int32_t tile, chunk;
  int32_t plane;  ///< place of its first checkpoint plane, if the tile has several chunks
};

struct ChooseTask {
  TileLists lists;
  TileGrid grid;
  const float* background;
  FootprintOptions options;
};

/// How the lists are cut into chunks, and in which order work is begun; made by plan_chunks.
struct ChunkPlan {
  TileChunk* chunk_order;  ///< [chunks] by samples
  int32_t* tile_order;     ///< [tiles] by samples
  int32_t* tile_planes;    ///< [tiles] place of a tile's first checkpoint plane, if it has several chunks
  TileChunk* rest;         ///< [counts->rest] chunks behind the front ones
  int32_t* counters;       ///< [kPlanCounters] scratch, zero
};

struct BlendTask {
  TileLists lists;
  ChunkPlan plan;
  TileGrid grid;
  const float* background;  ///< [3]
  int32_t* tile_open;       ///< [tiles] whether the tile is one of the open ones
  int32_t* open_tiles;      ///< [kSampleClasses, tiles]
  Checkpoint* checkpoints;  ///< [planes, 256]: a plane per chunk and sample
  float* image;             ///< [3, height, width]
  float* transmittance;     ///< [samples, height, width], or null without backward pass
  int32_t* last;            ///< [samples, height, width], or null; the splats up to which a sample composited
  float* alpha;             ///< [height, width] 1 - mean transmittance, or null
};

struct InspectTask {
  TileLists lists;
  TileGrid grid;
  int32_t* median;    ///< [height, width] Gaussians, or -1; see PixelLook
  int32_t* dominant;  ///< [height, width]
  int32_t* touched;   ///< [n] pixels, to add to
  int32_t* largest;   ///< [n] largest weight, as the bits of a float; to raise
  int64_t* units;     ///< [n] sum of weights in units of kWeightUnit, to add to
};

struct BlendVjpTask {
  TileLists lists;
  const TileChunk* chunk_order;
  TileGrid grid;
  int64_t max_chunks;
  const float* background;
  const Checkpoint* checkpoints;
  const float* transmittance;
  const int32_t* last;
  const float* dL_dimage;
  const float* dL_dalpha;  ///< [height, width], or null
  float* pair_grads;       ///< [max(capacity, n), kPairGradWidth] by slot, or by splat if there are too many pairs
  bool absolute;           ///< sum |dL/dmean| too
};

struct ProjectVjpTask {
  CameraView<float> camera;
  Gaussians<float> gaussians;
  FootprintOptions options;
  const PairRange* ranges;
  const Counts* counts;
  int64_t capacity;
  const float* pair_grads;
  GaussianGrads<float> grads;
  float* camera_grads;  ///< [warps_of(n), kCameraGradWidth] CameraGrad of each 32 Gaussians, or null
};

AR_HD constexpr int64_t warps_of(int64_t n) { return (n + 31) / 32; }

struct ForwardStages {
  int samples;
  void (*project)(const ProjectTask&, cudaStream_t);  ///< for any camera
  void (*emit_pairs)(const EmitTask&, cudaStream_t);
  void (*choose)(const ChooseTask&, cudaStream_t);  ///< null where all tiles have the same samples
  void (*blend)(const BlendTask&, cudaStream_t);
  void (*weight_float)(const WeightTask<float>&, cudaStream_t);
  void (*weight_double)(const WeightTask<double>&, cudaStream_t);
  void (*inspect)(const InspectTask&, cudaStream_t);
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

/// Most pairs that can be sorted.
int64_t max_pairs();

/// Bytes of scratch memory, all of which must be zero.
int64_t depth_sort_scratch(int64_t n);
int64_t tile_sort_scratch(int64_t capacity, TileGrid grid);
inline constexpr int kEmitThreads = 256;
inline int64_t emit_scratch(int64_t n) {
  return (1 + (n + kEmitThreads - 1) / kEmitThreads) * int64_t(sizeof(uint32_t));
}

/// Splats by depth, ties in input order. The result is order[0].
struct DepthSort {
  int64_t n;
  uint32_t* keys[2];  ///< [n]; both are overwritten
  int32_t* order[2];  ///< [n]
  const PairRange* ranges;
  Counts* counts;
};
/// First adds to the counts, then sorts.
void count_depths(const DepthSort& task, void* scratch, cudaStream_t stream);
void sort_by_depth(const DepthSort& task, void* scratch, cudaStream_t stream);

/// Pairs by tile, stably. The result is values[tile_sort_result(grid)].
template <class Value> struct TileSort {
  int64_t capacity;
  const Counts* counts;
  uint32_t* tiles[2];  ///< [capacity]; both are overwritten
  Value* values[2];
  int64_t* tile_offsets;
};
int tile_sort_result(TileGrid grid);
void sort_by_tile(const TileSort<int32_t>& task, TileGrid grid, void* scratch, cudaStream_t stream);
void sort_by_tile(const TileSort<SlotPair>& task, TileGrid grid, void* scratch, cudaStream_t stream);

/// `feedback` receives the number of pairs: host memory that the device can write.
void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ChunkPlan& plan, int64_t* feedback,
                 cudaStream_t stream);

}  // namespace ar::cuda
