// Parameters of the CPU's stages beyond core/stages.h, and Stages, the table of functions that run them.
#pragma once

#include <cstdint>
#include <memory>
#include <string_view>
#include <vector>

#include "core/bin.h"
#include "core/order.h"
#include "core/rows.h"
#include "core/weight.h"

namespace ar::cpu {

/// Gaussians or rows per work item.
inline constexpr int64_t kChunk = 4096;
AR_HD int64_t chunks_of(int64_t n) { return (n + kChunk - 1) / kChunk; }

inline constexpr int kPairNumbers = sizeof(PairGrad<float>) / sizeof(float);

/// Most channels per call of blend_vjp.
inline constexpr int kWindow = 32;

/// Per thread.
inline constexpr int64_t kReplayNumbers = int64_t(1) << 20;

/// count_candidates marks what may be visible; project writes only that.
template <typename T> struct ProjectParams : ar::ProjectParams<T> {
  CullBounds<T> bounds;
  int threads;
  uint8_t* candidates;     ///< [gaussians].
  int64_t* chunk_offsets;  ///< [chunks + 1] counts, then prefix sums. The last is zero at first.
  int32_t* ids;            ///< [candidates] ascending.
  T* depths;               ///< [candidates].
  Vec2<T>* slopes;         ///< [candidates] of RayDepth, or null.
};

template <typename T> struct ProjectRowsParams : ar::ProjectParams<T> {
  CullBounds<T> bounds;
  int threads;
  RowRules<T> rules;
  RowOutputs<T> rows;    ///< Not of rows that are not drawn.
  PackedRows<T> packed;  ///< Instead of rows.
  int32_t* flags;        ///< [gaussians] instead of both: 1 if it has a row, else 0.
};

template <typename T> struct ShapeRowsParams : ar::ShapeRowsParams<T> {
  int threads;
};

/// 16 bytes: read at random.
struct SplatTiles {
  TileMask mask;        ///< 8x8 tiles from (row, column) on. 0: too many for it.
  int32_t row, column;  ///< Row -1: no tile.
};

template <typename T> struct BinParams {
  const T* splats;
  const T* depths;
  int64_t n;
  int footprint;  ///< Index in the registry.
  TileGrid grid;
  int threads;
  int64_t* tile_offsets;   ///< [tiles + 1] into pairs.
  int64_t* splat_offsets;  ///< [n + 1] into positions, or null.
  int32_t* pairs;          ///< [N] splats, by tile, then depth.
  int64_t* positions;      ///< [N] pairs by splat, or null.
                           // From count_pairs to scatter_pairs. No vectors, which one thread fills with zeros.
  std::unique_ptr<SplatTiles[]> tiles;  ///< [n].
  std::unique_ptr<int32_t[]> order;     ///< [n] splats by depth.
  std::unique_ptr<int64_t[]> cursors;   ///< [parts, tiles] next pair.
  int64_t parts;
};

struct TileLists {
  const int32_t* pairs;
  const int64_t* tile_offsets;
};

template <typename T> struct BlendParams : ar::BlendParams<T> {
  TileLists lists;
  int threads;
  T* scratch;  ///< [threads, channels.count, kTile * kTile].
  RayOrder<T> order;
};

/// A call per window of channels.
template <typename T> struct BlendVjpParams : ar::BlendVjpParams<T> {
  TileLists lists;
  int threads;
  int first, count;  ///< The window.
  T* pair_grads;     ///< [pairs, pair_stride] PairGrad, or null.
  int64_t pair_stride;
  MeanSums mean_sums;
  Vec2<T>* pair_means;  ///< [pairs] with pair_grads, or null.
  T* channel_sums;      ///< [pairs, channel_stride].
  int64_t channel_stride;
  T* scratch;  ///< [threads, channels.count, kTile * kTile].
  T* replay;   ///< [threads, kReplayNumbers] if Stages::moves and the order is that of centres.
  RayOrder<T> order;
};

struct SplatPairs {
  int64_t splats;
  const int32_t* ids;            ///< [splats] Gaussians or rows, ascending.
  const int64_t* splat_offsets;  ///< [splats + 1] into positions.
  const int64_t* positions;      ///< [pairs].
};

template <typename T> struct SumChannelsParams {
  SplatPairs pairs;
  int threads;
  int first, count;       ///< The window.
  const T* channel_sums;  ///< [pairs, channel_stride].
  int64_t channel_stride;
  bool by_gaussian;  ///< Rows of Gaussians, else of splats.
  T* dL_dchannels;   ///< [rows, stride].
  int64_t stride;
};

template <typename T> struct ProjectVjpParams : ar::ProjectVjpParams<T> {
  SplatPairs pairs;
  int threads;
  const T* pair_grads;  ///< [pairs, pair_stride] PairGrad.
  int64_t pair_stride;
  bool pair_colors;             ///< Three colours follow each PairGrad.
  const Vec2<T>* pair_means;    ///< [pairs] or null.
  CameraGrad<T>* camera_grads;  ///< [chunks] sums, or null.
};

template <typename T> struct ProjectRowsVjpParams : ar::ProjectVjpParams<T> {
  ProjectedRowGrads<T> rows;
  bool add;
  int threads;
  CameraGrad<T>* camera_grads;
};

template <typename T> struct RowGradsParams : ar::RowGradsParams<T> {
  SplatPairs pairs;
  int threads;
  const T* pair_grads;
  int64_t pair_stride;
  const Vec2<T>* pair_means;  ///< [pairs] or null.
};

template <typename T> struct InspectParams : ar::InspectParams<T> {
  const int32_t* ids;  ///< Gaussians of splats.
  TileLists lists;
  int threads;
};

template <typename T> struct WeightParams : ar::WeightParams<T> {
  int threads;
};

template <typename T> struct CameraStages {
  void (*count_candidates)(const ProjectParams<T>&);
  void (*project)(const ProjectParams<T>&);
  void (*project_rows)(const ProjectRowsParams<T>&);
  void (*project_vjp)(const ProjectVjpParams<T>&);
  void (*project_rows_vjp)(const ProjectRowsVjpParams<T>&);
};

/// The last seven depend on the footprint.
template <typename T> struct Stages {
  int samples;
  bool moves;
  CameraStages<T> plain, full;
  void (*shape_rows)(const ShapeRowsParams<T>&);
  void (*row_grads)(const RowGradsParams<T>&);
  void (*count_pairs)(BinParams<T>&);
  void (*scatter_pairs)(BinParams<T>&);
  void (*sum_channels)(const SumChannelsParams<T>&);
  void (*blend)(const BlendParams<T>&);
  void (*blend_vjp)(const BlendVjpParams<T>&);
  /// In the order along rays; null if the footprint has none.
  void (*blend_rays)(const BlendParams<T>&);
  void (*blend_rays_vjp)(const BlendVjpParams<T>&);
  void (*inspect)(const InspectParams<T>&);
  void (*weight)(const WeightParams<T>&);
  void (*weight_vjp)(const WeightParams<T>&);

  const CameraStages<T>& of(const CameraView<T>& camera) const { return camera.lens ? full : plain; }
};

/// Of the chosen instruction set; double has the baseline.
template <typename T> const Stages<T>& stages_of(int footprint = 0);

/// Of stages_of<float>.
const char* instruction_set();

struct InstructionSet {
  const char* name;
  bool supported;  ///< By this machine.
  const Stages<float>& (*stages)(int footprint);
};
/// The widest first.
const std::vector<InstructionSet>& instruction_sets();

template <typename T> int64_t count_candidates(const ProjectParams<T>& p);
template <typename T> void project(const ProjectParams<T>& p);
template <typename T> void project_rows(const ProjectRowsParams<T>& p);
template <typename T> void shape_rows(const ShapeRowsParams<T>& p);
template <typename T> int64_t count_pairs(BinParams<T>& p);
template <typename T> void scatter_pairs(BinParams<T>& p);
template <typename T> void blend(int footprint, const BlendParams<T>& p);
template <typename T> void inspect(int footprint, const InspectParams<T>& p);
template <typename T> void weight(int footprint, const WeightParams<T>& p);

template <typename T> void blend_vjp(int footprint, const BlendVjpParams<T>& p);
template <typename T> void sum_channels(const SumChannelsParams<T>& p);
template <typename T> void project_vjp(const ProjectVjpParams<T>& p);
template <typename T> void project_rows_vjp(const ProjectRowsVjpParams<T>& p);
/// In double, in a fixed order.
template <typename T> void sum_camera_grads(const CameraGradSums<T>& sums);
template <typename T> void row_grads(const RowGradsParams<T>& p);
template <typename T> void weight_vjp(int footprint, const WeightParams<T>& p);

}  // namespace ar::cpu
