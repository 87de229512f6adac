// Parameter structs of the CUDA stages, and functions that launch them. Structs add to their namesakes in
// core/stages.h. Pointers are device memory of the caller. Nothing waits for the device.
//
// Only the device knows the number of pairs. The caller gives room for `capacity` pairs, at least one per splat. If
// there are more, neighbouring tiles (a patch) share a list, and blending tests its splats against each tile: slower,
// with the same result.
#pragma once

#include <cuda_runtime_api.h>

#include "core/bin.h"
#include "core/camera.h"
#include "core/order.h"
#include "core/rows.h"
#include "core/weight.h"
#include "cuda/bin/chunk_plan.h"
#include "cuda/bin/policy.h"

namespace ar::cuda {

/// A row of pair_grads: PairGrad (6), three channels, MeanSums (2), a fourth channel.
inline constexpr int kPairGradWidth = 12;
inline constexpr int kPairChannels = 6, kPairMeans = 9, kPairFourthChannel = 11;  ///< columns
/// More channels are blended in groups, and summed in channel_sums.
inline constexpr int kFewChannels = 4;
/// Channels of a group, and of a last group.
inline constexpr int kChannelGroup = 32, kSmallGroup = 8;

/// Of the sort by depth: bits of a digit, digits.
inline constexpr int kDepthBits = 9, kDepthPasses = 4;
inline constexpr int kDepthHistogramWords = kDepthPasses << kDepthBits;

/// Of splats without pairs.
inline constexpr uint32_t kCulledKey = 0xffffffff;
/// Added to the bits of a depth: then bits 27 to 31 agree for depths from 1/8 to 8192, and the last pass of the sort
/// ends at once.
inline constexpr uint32_t kDepthKeyOffset = 0x02000000;

/// The slots of a splat: rows of pair_grads, one per pair. A warp reads those of 32 neighbouring splats together.
struct PairRange {
  int32_t first, count;
};

/// A whole warp writes the pairs of more tiles.
inline constexpr int kManyTiles = 16;
/// One struct: bin reads it in random order.
struct alignas(16) SplatTiles {
  TileMask mask;  ///< of 8x8 tiles from `first` on; 0: there are tiles beyond
  int32_t first, count;
};

/// In a patch the slot is the splat, to whose row all tiles add.
struct alignas(8) SlotPair {
  int32_t splat, slot;
};

/// Of a SegmentMap (moment/maps.cuh).
inline constexpr int kMapNumbers = 10;

/// moment/: pairs between checkpoints; planes of one: transmittance and position of every sample.
inline constexpr int kStateChunk = 32;
AR_HD constexpr int state_planes(int samples) { return 3 * samples; }

struct alignas(8) Counts {
  int64_t pairs;
  int64_t splats;      ///< with pairs
  int64_t listed;      ///< pairs that are written, of tiles or patches
  int64_t patch_bits;  ///< a patch has 2^patch_bits tiles on a side

  AR_HD bool in_patches(int64_t capacity) const { return pairs > capacity; }
};

struct BinInput {
  uint32_t* keys;              ///< [n] depth keys
  PairRange* ranges;           ///< [n] only the counts
  SplatTiles* tiles;           ///< [n] only of splats with pairs
  Counts* counts;              ///< [1] zeros, as are the histograms
  uint32_t* depth_histograms;  ///< [kDepthPasses, 2^kDepthBits]
};

struct ProjectParams : ar::ProjectParams<float>, BinInput {
  CullBounds<float> bounds;
  TileGrid grid;
};

struct ProjectRowsParams {
  CameraView<float> camera;
  Gaussians<float> gaussians;
  FootprintChoice footprint;
  CullBounds<float> bounds;
  RowRules<float> rules;
  RowOutputs<float> rows;
  PackedRows<float> packed;  ///< instead of rows, or null
  int32_t* flags;            ///< [n] instead of both: 1 if the Gaussian has a row, else 0
};

struct ShapeRowsParams : ar::ShapeRowsParams<float>, BinInput {};

/// For the order along rays.
struct RayDepthsParams {
  CameraView<float> camera;
  Gaussians<float> gaussians;
  const PairRange* ranges;  ///< [n]
  RayDepth<float>* depths;  ///< [n] written where there are pairs
};

struct EmitParams {
  const float* splats;  ///< [n, kSplatWidth]
  int64_t n;
  int footprint;  ///< index in the registry
  TileGrid grid;
  int64_t capacity;               ///< >= counts->splats
  Counts* counts;                 ///< [1] sets listed and patch_bits
  const int32_t* order;           ///< [counts->splats] splats by depth
  const SplatTiles* splat_tiles;  ///< [n]
  const PairRange* ranges;        ///< [n]

  // Scratch. Long splats have tiles beyond 8x8.
  int32_t* long_splats;   ///< [n] in any order
  int32_t* long_places;   ///< [n] first pair of each
  uint32_t* status;       ///< [emit_scratch() bytes] zeros
  uint32_t* tile_counts;  ///< [tile_sort_scratch() bytes] zeros; gets counts of digits

  uint32_t* tiles;       ///< [capacity] of each pair; of a patch the first tile
  int32_t* splat_pairs;  ///< [capacity] or null
  SlotPair* slot_pairs;  ///< [capacity] for a backward pass, or null
};

struct TileLists {
  const int32_t* pairs;         ///< [capacity, stride] splats (and slots) by tile, depth
  int stride;                   ///< 1, or 2 with slots
  const int64_t* tile_offsets;  ///< [tiles + 1] a patch has the list of its first tile
  const Counts* counts;         ///< [1]
  int64_t n, capacity;          ///< splats; room for pairs
};

struct BlendParams : ar::BlendParams<float> {
  TileLists lists;
  ChunkPlan plan;
  ListCut cut;
  int32_t* tile_open;       ///< [tiles] still/: the front has left samples open
  int32_t* open_tiles;      ///< [tiles] still/: these tiles
  CheckpointLayout layout;  ///< still/
  float* checkpoints;       ///< still/: [planes, kTile^2]; moment/: [checkpoints, state_planes(), side^2]
  uint32_t* reach_words;    ///< [max_reach_words()] moment/, or null
  RayOrder<float> order;
};

struct InspectParams : ar::InspectParams<float> {
  TileLists lists;
  // Instead of depths, where splats are Gaussians.
  CameraView<float> camera;
  const Vec3<float>* means;
};

/// rays/: the last `rows` events of each lane (rays/vjp.cuh).
struct RayLog {
  uint32_t* words;   ///< [blocks, rows, words of a row, 32]
  int blocks, rows;  ///< rows: a power of two
};

/// Without channels.data dL_dimage.first is not null.
struct BlendVjpParams : ar::BlendVjpParams<float> {
  TileLists lists;
  const TileChunk* chunk_order;  ///< as in ChunkPlan
  const CutList* cut_lists;
  const PlanState* plan;
  ListCut cut;
  int64_t max_chunks;
  int32_t* chunks_taken;  ///< [1] chunks that warps have claimed
  float* checkpoints;     ///< as in BlendParams; moment/ adds those of cut lists
  float* pair_grads;      ///< [max(capacity, n), kPairGradWidth] by slot; with patches by splat
  float* channel_sums;    ///< [max(capacity, n), channel_group()] or null
  MeanSums mean_sums;
  float* adjoint_maps;  ///< [max_adjoint_maps()] moment/
  float* group_sums;    ///< [max_group_sums()] moment/
  RayOrder<float> order;
  RayLog ray_log;  ///< rays/
};

struct PairSumsView {
  int64_t n;
  const PairRange* ranges;  ///< [n]
  const Counts* counts;     ///< [1]
  int64_t capacity;
  const float* pair_grads;  ///< as in BlendVjpParams

  AR_HD bool by_splat() const { return counts->in_patches(capacity); }
};

/// Of channels [first, first + count).
struct SumChannelsParams {
  PairSumsView sums;
  const float* channel_sums;  ///< as in BlendVjpParams; null: columns of pair_grads
  int width;                  ///< kChannelGroup or kSmallGroup
  int first, count;
  float* dL_dchannels;  ///< [n, stride]
  int64_t stride;
};

struct ProjectVjpParams : ar::ProjectVjpParams<float> {
  PairSumsView sums;
  bool channels_in_pairs;  ///< gradients of dL_dchannels are columns of pair_grads
  float* camera_grads;     ///< [warps_of(n), kCameraGradWidth] of 32 Gaussians, or null
};

struct ZeroGradsParams {
  Gaussians<float> gaussians;
  GaussianGrads<float> grads;
  const PairRange* ranges;  ///< [n]
};

struct ProjectRowsVjpParams {
  CameraView<float> camera;
  Gaussians<float> gaussians;
  GaussianGrads<float> grads;
  ProjectedRowGrads<float> rows;
  bool add;             ///< adds to `grads`
  float* camera_grads;  ///< as in ProjectVjpParams
};

struct RowGradsParams : ar::RowGradsParams<float> {
  PairSumsView sums;
};

AR_HD constexpr int64_t warps_of(int64_t n) { return (n + 31) / 32; }

// The forward pass (forward.cu).

void project(const ProjectParams& p, cudaStream_t stream);
void ray_depths(const RayDepthsParams& p, cudaStream_t stream);
void project_rows(const ProjectRowsParams& p, cudaStream_t stream);
void shape_rows(const ShapeRowsParams& p, cudaStream_t stream);

/// Most items of a sort.
int64_t max_items();

/// Bytes, multiples of 16. The scratch of the sort by depth begins with histograms.
int64_t depth_sort_scratch(int64_t n);
int64_t tile_sort_scratch(int64_t capacity, TileGrid grid);
inline int64_t emit_scratch(int64_t n) {
  return ((2 + (n + BinPolicy::kEmitSplats - 1) / BinPolicy::kEmitSplats) * int64_t(sizeof(uint32_t)) + 15) / 16 * 16;
}

/// Ties stay in input order. The result is order[0].
struct DepthSort {
  int64_t n;
  uint32_t* keys[2];  ///< [n] both are overwritten
  int32_t* order[2];  ///< [n]
  PairRange* ranges;  ///< [n]
  bool with_slots;    ///< hand out slots, in another order in every run
  Counts* counts;     ///< [1]
};
/// To set to zero, in pieces of 16 bytes.
struct ZeroedMemory {
  void* data;
  int64_t bytes;
};
/// Comes first. Sets `rest` of `scratch` and `of_tiles` to zero.
void count_depths(const DepthSort& p, void* scratch, ZeroedMemory rest, ZeroedMemory of_tiles, cudaStream_t stream);
void sort_by_depth(const DepthSort& p, void* scratch, cudaStream_t stream);

void emit_pairs(const EmitParams& p, cudaStream_t stream);

/// The device reports the number of pairs (torch/pair_guess.h).
struct PairFeedback {
  uint64_t* word;  ///< of the host
  uint32_t frame;
};

/// Stable. The result is values[tile_sort_result(grid)].
template <class Value> struct TileSort {
  int64_t capacity;
  const Counts* counts;   ///< [1]
  uint32_t* tiles[2];     ///< [capacity] both are overwritten
  Value* values[2];       ///< [capacity]
  int64_t* tile_offsets;  ///< [tiles + 1]
  PairFeedback feedback;
};
int tile_sort_result(TileGrid grid);
/// `scratch`: EmitParams::tile_counts.
template <class Value> void sort_by_tile(const TileSort<Value>& p, TileGrid grid, void* scratch, cudaStream_t stream);

/// Of the current device, for route_of().
int multiprocessors_of_device();
void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ListCut& cut, CheckpointLayout layout,
                 const ChunkPlan& plan, cudaStream_t stream);
/// Without p.channels.data the colours in the splats are blended, also by blend_vjp.
void blend(int footprint, const BlendParams& p, cudaStream_t stream);

void inspect(int footprint, const InspectParams& p, cudaStream_t stream);

// The backward pass (backward.cu).

/// `begun`: as in LaunchShape.
void zero_culled_grads(const ZeroGradsParams& p, cudaStream_t stream, cudaEvent_t begun);
int64_t max_group_sums(int footprint, const Channels<float>& channels, const ListCut& cut, TileGrid grid);
/// `words`: of all blocks.
RayLog ray_log(int footprint, TileGrid grid, int64_t& words);
/// Of channels from `first` on.
void blend_vjp(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream);
void sum_channels(const SumChannelsParams& p, cudaStream_t stream);
/// Leaves groups of 32 Gaussians without pairs to zero_culled_grads.
void project_vjp(const ProjectVjpParams& p, cudaStream_t stream);
void project_rows_vjp(const ProjectRowsVjpParams& p, cudaStream_t stream);
void sum_camera_grads(const CameraGradSums<float>& p, cudaStream_t stream);
void row_grads(const RowGradsParams& p, cudaStream_t stream);

// The families of blending (blend.cu, blend_vjp.cu).

void blend_still(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_moment(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_channels(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_rays(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_vjp_still(int footprint, const BlendVjpParams& p, cudaStream_t stream);
void blend_vjp_moment(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream);
void blend_vjp_channels(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream);
void blend_vjp_rays(int footprint, const BlendVjpParams& p, cudaStream_t stream);

// weight.cu.

template <typename T> void weight(int footprint, const WeightParams<T>& p, cudaStream_t stream);
template <typename T> void weight_vjp(int footprint, const WeightParams<T>& p, cudaStream_t stream);

}  // namespace ar::cuda
