// The parameters of the CPU's stages, and the table of the functions that run them. What the stages of both devices
// share is in core/stages.h. All pointers are views of memory that the caller owns.
#pragma once

#include <cstdint>
#include <memory>
#include <string_view>
#include <vector>

#include "core/bin.h"
#include "core/project.h"
#include "core/weight.h"

namespace ar::cpu {

/// Gaussians, or rows, per work item of the loops over them.
inline constexpr int64_t kChunk = 4096;
AR_HD int64_t chunks_of(int64_t n) { return (n + kChunk - 1) / kChunk; }

/// Numbers of a PairGrad.
inline constexpr int kPairNumbers = sizeof(PairGrad<float>) / sizeof(float);

/// Channels that one call of blend_vjp sums at most: what bounds the memory of the sums.
inline constexpr int kWindow = 32;

/// Numbers of memory that blend_vjp takes per thread for a footprint whose samples move (cpu/replay.h).
inline constexpr int64_t kReplayNumbers = int64_t(1) << 20;

/// count_candidates marks the Gaussians that may be visible, so that project can write their splats densely and in the
/// order of the Gaussians.
template <typename T> struct ProjectParams : ar::ProjectParams<T> {
  CullBounds<T> bounds;  ///< of the footprint
  int threads;
  uint8_t* candidates;     ///< [gaussians] whether each may be visible
  int64_t* chunk_offsets;  ///< [chunks + 1] counts from count_candidates, of which the caller makes prefix sums
  int32_t* ids;            ///< [candidates] Gaussian of each splat, ascending
  T* depths;               ///< [candidates] camera-space z
};

/// Uses of ar::ProjectParams the camera, the Gaussians, the footprint and `radii`.
template <typename T> struct ProjectRowsParams : ar::ProjectParams<T> {
  CullBounds<T> bounds;
  int threads;
  ProjectedRows<T> rows;  ///< [gaussians] each; what belongs to a radius of 0 is not written; or all null
  PackedRows<T> packed;   ///< instead of rows and radii
};

template <typename T> struct ShapeRowsParams : ar::ShapeRowsParams<T> {
  int threads;
};

/// The tiles of a splat, in 16 bytes: splats are visited in depth order, which is random in memory.
struct SplatTiles {
  TileMask mask;        ///< from tile (row, column) on; 0: they are worked out again, since they are not among 8x8
  int32_t row, column;  ///< row -1: none
};

/// count_pairs fills the offsets and scatter_pairs, once the caller has made room, `pairs` and `positions`.
template <typename T> struct BinParams {
  const T* splats;
  const T* depths;
  int64_t n;
  int footprint;  ///< place in the registry
  TileGrid grid;
  int threads;
  int64_t* tile_offsets;   ///< [tiles + 1] into pairs
  int64_t* splat_offsets;  ///< [n + 1] into positions, or null
  int32_t* pairs;          ///< [tile_offsets[tiles]] splat of each pair, by tile, then depth
  int64_t* positions;      ///< [same] places of a splat's pairs, by splat, or null
  // Kept from count_pairs to scatter_pairs. No vectors, which one thread would fill with zeros:
  std::unique_ptr<SplatTiles[]> tiles;  ///< [n]
  std::unique_ptr<int32_t[]> order;     ///< [n] splats by depth, ties in input order
  std::unique_ptr<int64_t[]> cursors;   ///< [parts, tiles] next place in pairs
  int64_t parts;
};

/// The splats of every tile, front to back.
struct TileLists {
  const int32_t* pairs;
  const int64_t* tile_offsets;
};

template <typename T> struct BlendParams : ar::BlendParams<T> {
  TileLists lists;
  int threads;
  T* scratch;  ///< [threads, channels.count, kTile * kTile] the colours of a tile
};

/// The sums of a window of channels. The first window makes the sums that do not belong to a channel as well.
template <typename T> struct BlendVjpParams : ar::BlendVjpParams<T> {
  TileLists lists;
  int threads;
  int first, count;  ///< the window: channels [first, first + count), count <= kWindow
  T* pair_grads;     ///< [pairs] a PairGrad at the start of every row, or null: not wanted again
  int64_t pair_stride;
  MeanSums mean_sums;
  Vec2<T>* pair_means;  ///< [pairs] mean_sums, with pair_grads; or null
  T* channel_sums;      ///< [pairs] `count` numbers at the start of every row
  int64_t channel_stride;
  T* scratch;  ///< [threads, channels.count, kTile * kTile] the gradient of a tile
  T* replay;   ///< [threads, kReplayNumbers] where Stages::moves, or null
};

/// Where the pairs of every splat are.
struct SplatPairs {
  int64_t splats;
  const int32_t* ids;            ///< [splats] Gaussian, or row, of each; ascending
  const int64_t* splat_offsets;  ///< [splats + 1] into positions
  const int64_t* positions;      ///< [pairs]
};

/// Sums of pairs to sums of splats, for a window of channels.
template <typename T> struct SumChannelsParams {
  SplatPairs pairs;
  int threads;
  int first, count;       ///< the window
  const T* channel_sums;  ///< [pairs] `count` numbers at the start of every row
  int64_t channel_stride;
  bool by_gaussian;  ///< row of a splat: its id; else its number
  T* dL_dchannels;   ///< rows of `stride` numbers, of which those of splats are written
  int64_t stride;
};

template <typename T> struct ProjectVjpParams : ar::ProjectVjpParams<T> {
  SplatPairs pairs;
  int threads;
  const T* pair_grads;  ///< [pairs] a PairGrad at the start of every row
  int64_t pair_stride;
  bool pair_colors;             ///< behind every PairGrad are the sums of the three colours in the splats
  const Vec2<T>* pair_means;    ///< [pairs] or null
  CameraGrad<T>* camera_grads;  ///< [chunks] to add to, of a full camera, or null
};

template <typename T> struct ProjectRowsVjpParams : ar::ProjectVjpParams<T> {
  ProjectedRowGrads<T> rows;
  bool add;  ///< to the gradients that are there
  int threads;
  CameraGrad<T>* camera_grads;
};

template <typename T> struct RowGradsParams : ar::RowGradsParams<T> {
  SplatPairs pairs;
  int threads;
  const T* pair_grads;
  int64_t pair_stride;
  const Vec2<T>* pair_means;  ///< [pairs] or null, as `absolute`
};

template <typename T> struct InspectParams : ar::InspectParams<T> {
  const int32_t* ids;  ///< Gaussian of each splat, in [0, n)
  TileLists lists;
  int threads;
};

template <typename T> struct WeightParams : ar::WeightParams<T> {
  int threads;
};

/// What depends on the camera's type.
template <typename T> struct CameraStages {
  void (*count_candidates)(const ProjectParams<T>&);
  void (*project)(const ProjectParams<T>&);
  void (*project_rows)(const ProjectRowsParams<T>&);
  void (*project_vjp)(const ProjectVjpParams<T>&);
  void (*project_rows_vjp)(const ProjectRowsVjpParams<T>&);
};

/// The stages of a footprint. Only the last five depend on it.
template <typename T> struct Stages {
  int samples;
  bool moves;  ///< samples carry a state besides their transmittance
  CameraStages<T> plain, full;
  void (*shape_rows)(const ShapeRowsParams<T>&);
  void (*row_grads)(const RowGradsParams<T>&);
  void (*count_pairs)(BinParams<T>&);
  void (*scatter_pairs)(BinParams<T>&);
  void (*sum_channels)(const SumChannelsParams<T>&);
  void (*blend)(const BlendParams<T>&);
  void (*blend_vjp)(const BlendVjpParams<T>&);
  void (*inspect)(const InspectParams<T>&);
  void (*weight)(const WeightParams<T>&);
  void (*weight_vjp)(const WeightParams<T>&);

  const CameraStages<T>& of(const CameraView<T>& camera) const { return camera.lens ? full : plain; }
};

/// Stages of the footprint at place `footprint` of the registry, for the best instruction set that this machine and the
/// environment variable ANALYTIC_RASTERIZER_ISA (baseline, avx2, avx512) allow. double always runs the baseline.
template <typename T> const Stages<T>& stages_of(int footprint);

/// Name of the instruction set that stages_of<float> uses.
const char* instruction_set();

/// An instruction set that floats are compiled for, the widest first.
struct InstructionSet {
  const char* name;
  bool supported;  ///< by this machine
  const Stages<float>& (*stages)(int footprint);
};
const std::vector<InstructionSet>& instruction_sets();

}  // namespace ar::cpu
