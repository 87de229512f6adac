// What each stage of the CUDA path reads and writes beyond core/stages.h, and the functions that launch the stages. All
// pointers are views of device memory that the caller owns. Every function enqueues work on a stream and returns; none
// waits for the device.
//
// Sizes that depend on the data stay on the device. The caller guesses how many pairs there will be and gives room for
// `capacity` of them, at least one per splat. If there are more, tiles do not get lists of their own: a square of them,
// a patch, shares one, whose splats blending tests against each tile. The patches are as small as room allows. That is
// slower, but gives the same result without waiting for the host.
#pragma once

#include <cuda_runtime_api.h>

#include "core/bin.h"
#include "core/camera.h"
#include "core/project.h"
#include "core/weight.h"
#include "cuda/chunk_plan.h"

namespace ar::cuda {

/// Floats per row of pair gradients: PairGrad, three channels, MeanSums, a fourth channel.
inline constexpr int kPairGradWidth = 12;
inline constexpr int kPairChannels = 6, kPairMeans = 9, kPairFourthChannel = 11;  ///< columns
/// Channels that lie in the rows of pairs. More are blended in groups, and summed in memory of their own.
inline constexpr int kFewChannels = 4;
/// Channels of a group, and of a last one where no more are left.
inline constexpr int kChannelGroup = 32, kSmallGroup = 8;

/// A sort by depth counts the values of so many digits of so many bits. With keys as depth_key makes them the last of
/// its passes has nothing to do for depths of 1/8 to 8192.
inline constexpr int kDepthBits = 9, kDepthPasses = 4;
inline constexpr int kDepthHistogramWords = kDepthPasses << kDepthBits;

/// Depth keys of splats without pairs: after all others.
inline constexpr uint32_t kCulledKey = 0xffffffff;
/// The depth key of a splat is that of its depth's bits, which have the order of depths >= +0, plus this: so that the
/// bits from the 27th on are the same for all depths from 1/8 to less than 8192, and need not be sorted.
inline constexpr uint32_t kDepthKeyOffset = 0x02000000;

/// How many pairs a splat has, and the first of its slots, where blend_vjp leaves their gradients. The slots of a splat
/// are adjacent, and so are those of 32 splats that are neighbours in memory, whose slots project_vjp reads together.
struct PairRange {
  int32_t first, count;
};

/// The tiles of a splat with more than this are written by a warp together.
inline constexpr int kManyTiles = 16;
/// The tiles that a splat touches. Together, because bin reads them in the order of depth, which is far from that in
/// memory.
struct alignas(16) SplatTiles {
  TileMask mask;  ///< from tile `first` on; 0: some are not among 8x8
  int32_t first, count;
};

/// A splat in the list of a tile, and the slot of this pair. Where tiles share lists it is the splat again, to whose
/// row all of them add.
struct alignas(8) SlotPair {
  int32_t splat, slot;
};

/// Numbers of a SegmentMap (moment/maps.cuh): an affine map of three numbers, two of which do not reach the first.
inline constexpr int kMapNumbers = 10;

/// Pairs between the checkpoints of a footprint whose samples move, and the planes of one of them, a float per pixel of
/// a tile: transmittance and place of each sample.
inline constexpr int kStateChunk = 32;
AR_HD constexpr int state_planes(int samples) { return 3 * samples; }

/// What bin counts.
struct alignas(8) Counts {
  int64_t pairs;
  int64_t splats;  ///< with pairs
  /// Pairs that are written: all, or those of splats and patches if there is no room for these.
  int64_t listed;
  /// A patch is a square of 2^patch_bits x 2^patch_bits tiles, the first of which begins with tile 0.
  int64_t patch_bits;

  /// Whether tiles share the lists of patches, as there is room for `capacity` pairs only.
  AR_HD bool in_patches(int64_t capacity) const { return pairs > capacity; }
};

/// What project and shape_rows write for bin.
struct BinInput {
  uint32_t* keys;     ///< [n] in the order of depth
  PairRange* ranges;  ///< [n] the count alone
  SplatTiles* tiles;  ///< [n] of splats with pairs
  // Set to zero, for count_depths.
  Counts* counts;
  uint32_t* depth_histograms;  ///< [kDepthHistogramWords]
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
  ProjectedRows<float> rows;  ///< [n]; those with radius 0 are not written; or all null
  int32_t* radii;             ///< [n]
  PackedRows<float> packed;   ///< instead of rows and radii
};

struct ShapeRowsParams : ar::ShapeRowsParams<float>, BinInput {};

struct EmitParams {
  const float* splats;
  int64_t n;
  int footprint;  ///< place in the registry
  TileGrid grid;
  int64_t capacity;               ///< >= counts->splats
  Counts* counts;                 ///< `listed` and `patch_bits` are set
  const int32_t* order;           ///< [counts->splats] splats by depth
  const SplatTiles* splat_tiles;  ///< [n]
  const PairRange* ranges;        ///< [n], read with slot_pairs alone
  int32_t* long_splats;           ///< [n] for splats whose tiles are not among 8x8, in no order,
  int32_t* long_places;           ///< [n] and where their pairs begin
  uint32_t* status;               ///< emit_scratch(n) bytes, zero
  uint32_t* tile_counts;  ///< tile_sort_scratch(capacity, grid) bytes, zero; sort_by_tile finds its counts there
  uint32_t* tiles;        ///< [capacity] tile of each pair, or the first one of its patch
  int32_t* splat_pairs;   ///< [capacity] splat of each pair, or null:
  SlotPair* slot_pairs;   ///< [capacity] the same with its slot, for a backward pass
};

/// The lists of splats that blend walks.
struct TileLists {
  const int32_t* pairs;         ///< [capacity, stride] splats by tile, then depth, and their slots
  int stride;                   ///< 1, or 2 with slots
  const int64_t* tile_offsets;  ///< [tiles + 1]; the list of a patch is that of its first tile
  const Counts* counts;
  int64_t n, capacity;  ///< splats; pairs that there is room for
};

struct BlendParams : ar::BlendParams<float> {
  TileLists lists;
  ChunkPlan plan;
  ListCut cut;
  int32_t* tile_open;   ///< [tiles] whether the tile is one of the open ones
  int32_t* open_tiles;  ///< [tiles]
  CheckpointLayout layout;
  float* checkpoints;     ///< [planes, kTile^2], a number of each lane; of samples that move, of each pixel of a tile
  uint32_t* reach_words;  ///< [max_reach_words], or null where no list may be cut
};

struct InspectParams : ar::InspectParams<float> {
  TileLists lists;
};

/// For the three colours in the splats dL_dimage.first is not null.
struct BlendVjpParams : ar::BlendVjpParams<float> {
  TileLists lists;
  const TileChunk* chunk_order;
  const CutList* cut_lists;
  const PlanState* plan;
  ListCut cut;
  int64_t max_chunks;
  int32_t* chunks_taken;  ///< [1] chunks that warps have begun with; blend_vjp sets it to zero
  float* checkpoints;     ///< as in BlendParams; of lists that are cut, blend_vjp leaves most of them
  float* pair_grads;      ///< [max(capacity, n), kPairGradWidth] by slot, or by splat if there are too many pairs
  float* channel_sums;    ///< [max(capacity, n), channel_group] likewise, for more than kFewChannels channels; or null
  MeanSums mean_sums;
  float* adjoint_maps;  ///< [max_adjoint_maps]
  float* group_sums;    ///< [max_group_sums]
};

/// Sums over the pairs of every splat.
struct PairSumsView {
  int64_t n;
  const PairRange* ranges;
  const Counts* counts;
  int64_t capacity;
  const float* pair_grads;

  /// Whether there were too many pairs: then pair_grads has a row per splat.
  AR_HD bool by_splat() const { return counts->in_patches(capacity); }
};

/// From rows of pairs to gradients with respect to channels [first, first + count) of every splat.
struct SumChannelsParams {
  PairSumsView sums;
  const float* channel_sums;  ///< of `width` channels; null: in the rows of pairs
  int width;                  ///< kChannelGroup or kSmallGroup
  int first, count;
  float* dL_dchannels;  ///< [n, stride]
  int64_t stride;
};

struct ProjectVjpParams : ar::ProjectVjpParams<float> {
  PairSumsView sums;
  /// dL_dchannels has no rows: its channels, the colour and a fourth one, are summed in the rows of pairs.
  bool channels_in_pairs;
  float* camera_grads;  ///< [warps_of(n), kCameraGradWidth] CameraGrad of each 32 Gaussians, or null
};

/// What zero_culled_grads writes: gradients of those Gaussians that project_vjp leaves out.
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
  bool add;             ///< to the gradients that are there
  float* camera_grads;  ///< as in ProjectVjpParams
};

struct RowGradsParams : ar::RowGradsParams<float> {
  PairSumsView sums;
};

AR_HD constexpr int64_t warps_of(int64_t n) { return (n + 31) / 32; }

// Projection: kernels for each camera type, whatever the footprint (project.cu).
void project(const ProjectParams& p, cudaStream_t stream);
void project_rows(const ProjectRowsParams& p, cudaStream_t stream);
void shape_rows(const ShapeRowsParams& p, cudaStream_t stream);
/// Leaves out the gradients of each 32 Gaussians in a row none of which has pairs. zero_culled_grads writes them,
/// before it or beside it.
void project_vjp(const ProjectVjpParams& p, cudaStream_t stream);
/// `begun`: as in LaunchShape.
void zero_culled_grads(const ZeroGradsParams& p, cudaStream_t stream, cudaEvent_t begun);
void project_rows_vjp(const ProjectRowsVjpParams& p, cudaStream_t stream);
void row_grads(const RowGradsParams& p, cudaStream_t stream);
void sum_channels(const SumChannelsParams& p, cudaStream_t stream);

// Blending (dispatch.cu). `footprint` is a position in the registry. dispatch.h says what memory it takes.

/// Without p.channels.data it blends the three colours in the splats.
void blend(int footprint, const BlendParams& p, cudaStream_t stream);
/// The group of channels that begins with `first`; 0 where there are no more than kFewChannels.
void blend_vjp(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream);
void inspect(int footprint, const InspectParams& p, cudaStream_t stream);
/// Multiprocessors of the current device, for route_of().
int multiprocessors_of_device();
/// Numbers in BlendVjpParams::group_sums.
int64_t max_group_sums(int footprint, int64_t channels, const ListCut& cut, TileGrid grid);
// The families: still/blend.cu, still/blend_vjp.cu and so on.
void blend_still(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_vjp_still(int footprint, const BlendVjpParams& p, cudaStream_t stream);
void blend_moment(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_vjp_moment(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream);
void blend_channels(int footprint, const BlendParams& p, cudaStream_t stream);
void blend_vjp_channels(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream);

// One weight per element (weight.cu).
void weight(int footprint, const WeightParams<float>& p, cudaStream_t stream);
void weight(int footprint, const WeightParams<double>& p, cudaStream_t stream);
void weight_vjp(int footprint, const WeightParams<float>& p, cudaStream_t stream);
void weight_vjp(int footprint, const WeightParams<double>& p, cudaStream_t stream);

// Binning (bin.cu).

/// Most splats, and most pairs, that can be sorted: 2^30 - 1.
int64_t max_items();

/// Bytes of scratch memory, multiples of 16. That of the sort by depth begins with its histograms, which must be zero
/// before count_depths; this sets the rest, and the other two, to zero.
int64_t depth_sort_scratch(int64_t n);
int64_t tile_sort_scratch(int64_t capacity, TileGrid grid);
/// Threads of a block of emit_pairs, and splats of each: the more splats a block has, the fewer blocks wait in a row
/// for those before them.
inline constexpr int kEmitThreads = 256, kEmitRows = 2, kEmitSplats = kEmitThreads * kEmitRows;
inline int64_t emit_scratch(int64_t n) {
  return ((2 + (n + kEmitSplats - 1) / kEmitSplats) * int64_t(sizeof(uint32_t)) + 15) / 16 * 16;
}

/// Splats by depth, ties in input order. The result is order[0].
struct DepthSort {
  int64_t n;
  uint32_t* keys[2];  ///< [n]; both are overwritten
  int32_t* order[2];  ///< [n]
  PairRange* ranges;  ///< [n]
  bool with_slots;    ///< whether count_depths hands out slots; which splat gets which differs from run to run
  Counts* counts;
};
/// Memory that is set to zero; aligned to 16 bytes, and a multiple of them.
struct ZeroedMemory {
  void* data;
  int64_t bytes;
};
/// First adds to the histograms and the counts, which whatever made the keys has set to zero, hands out slots, and sets
/// the rest of the scratch to zero; then sorts. Once for each time that keys are made.
void count_depths(const DepthSort& p, void* scratch, ZeroedMemory rest, ZeroedMemory of_tiles, cudaStream_t stream);
void sort_by_depth(const DepthSort& p, void* scratch, cudaStream_t stream);

void emit_pairs(const EmitParams& p, cudaStream_t stream);

/// Where the device reports the number of pairs of a frame: memory of the host that it can write (pair_guess.h).
struct PairFeedback {
  uint64_t* word;
  uint32_t frame;
};

/// Pairs by tile, stably; those of emit_pairs. The result is values[tile_sort_result(grid)].
template <class Value> struct TileSort {
  int64_t capacity;
  const Counts* counts;
  uint32_t* tiles[2];  ///< [capacity]; both are overwritten
  Value* values[2];
  int64_t* tile_offsets;
  PairFeedback feedback;
};
int tile_sort_result(TileGrid grid);
/// `scratch`: EmitParams::tile_counts.
void sort_by_tile(const TileSort<int32_t>& p, TileGrid grid, void* scratch, cudaStream_t stream);
void sort_by_tile(const TileSort<SlotPair>& p, TileGrid grid, void* scratch, cudaStream_t stream);

/// `layout`: of checkpoints, which are planned unless cut.whole.
void plan_chunks(const TileLists& lists, TileGrid grid, int samples, const ListCut& cut, CheckpointLayout layout,
                 const ChunkPlan& plan, cudaStream_t stream);

}  // namespace ar::cuda
