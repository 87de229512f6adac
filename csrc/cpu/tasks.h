// What each stage of the CPU path reads and writes, and the table of stages of one footprint compiled
// for one instruction set. All pointers are views of memory that the caller owns.
#pragma once

#include <memory>
#include <string_view>
#include <vector>

#include "core/camera.h"
#include "core/weight.h"

namespace ar::cpu {

/// Gaussians per work item of the projection.
inline constexpr int64_t kChunk = 4096;
AR_HD int64_t chunks_of(int64_t n) { return (n + kChunk - 1) / kChunk; }

template <typename T> struct ProjectTask {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintOptions options;
  int threads;
  uint8_t* candidates;     ///< [n] whether each Gaussian may be visible, written by count_candidates
  int64_t* chunk_offsets;  ///< [chunks + 1]: counts from count_candidates, then their prefix sums
  T* splats;               ///< [candidates] Splat<F, T>
  int32_t* ids;            ///< [candidates] Gaussian of each splat, ascending
  T* depths;               ///< [candidates] camera-space z
  int32_t* radii;          ///< [n]
};

template <typename T> struct BinTask {
  const T* splats;
  const T* depths;
  int64_t n;
  TileGrid grid;
  int threads;
  int64_t* tile_offsets;   ///< [tiles + 1] into pairs
  int64_t* splat_offsets;  ///< [n + 1] into positions, or null
  int32_t* pairs;          ///< [tile_offsets[tiles]] splat of each pair, by tile, then depth
  int64_t* positions;      ///< [same] places of a splat's pairs, by splat, or null
  // Kept from count_pairs to scatter_pairs:
  std::vector<int32_t> order;    ///< splats by depth, ties in input order
  std::vector<int64_t> cursors;  ///< [parts, tiles] next place in pairs
  int64_t parts;
};

template <typename T> struct ChooseTask {
  const T* splats;
  const int32_t* pairs;
  const int64_t* tile_offsets;
  TileGrid grid;
  int threads;
  const T* background;
  FootprintOptions options;
  int32_t* tile_samples;  ///< [tiles]
};

template <typename T> struct BlendTask {
  const T* splats;
  const int32_t* pairs;
  const int64_t* tile_offsets;
  TileGrid grid;
  int threads;
  const int32_t* tile_samples;  ///< [tiles] samples in use, or null: all
  const T* background;          ///< [3]
  T* image;                     ///< [3, height, width]
  T* transmittance;             ///< [samples, height, width], or null
  int32_t* last;                ///< [samples, height, width] pairs of the tile up to the last one composited, or null
  T* alpha;                     ///< [height, width] 1 - mean transmittance, or null
};

template <typename T> struct InspectTask {
  const T* splats;
  const int32_t* ids;  ///< Gaussian of each splat
  const int32_t* pairs;
  const int64_t* tile_offsets;
  TileGrid grid;
  int threads;
  const int32_t* tile_samples;
  int32_t* median;    ///< [height, width] Gaussians, or -1; see PixelLook
  int32_t* dominant;  ///< [height, width]
  int32_t* touched;   ///< [n] pixels, to add to
  int32_t* largest;   ///< [n] largest weight, as the bits of a float; to raise
  int64_t* units;     ///< [n] sum of weights in units of kWeightUnit, to add to
};

template <typename T> struct BlendVjpTask {
  const T* splats;
  const int32_t* pairs;
  const int64_t* tile_offsets;
  TileGrid grid;
  int threads;
  const int32_t* tile_samples;
  const T* background;
  const T* transmittance;
  const int32_t* last;
  const T* dL_dimage;       ///< [3, height, width]
  const T* dL_dalpha;       ///< [height, width], or null
  PairGrad<T>* pair_grads;  ///< [pairs]
  Vec2<T>* pair_abs;        ///< [pairs] sums over pixels of |dL/dmean| per coordinate, or null
};

template <typename T> struct ProjectVjpTask {
  CameraView<T> camera;
  Gaussians<T> gaussians;
  FootprintOptions options;
  int threads;
  const int32_t* ids;
  int64_t n_splats;
  const int64_t* splat_offsets;
  const int64_t* positions;
  const PairGrad<T>* pair_grads;
  const Vec2<T>* pair_abs;
  GaussianGrads<T> grads;
  CameraGrad<T>* camera_grads;  ///< [chunks] to add to, of a full camera, or null
};

template <typename T> struct WeightTask : ar::WeightTask<T> {
  int threads;
};

/// What depends on the camera.
template <typename T> struct CameraStages {
  void (*count_candidates)(const ProjectTask<T>&);
  void (*project)(const ProjectTask<T>&);
  void (*project_vjp)(const ProjectVjpTask<T>&);
};

/// The stages of one footprint.
template <typename T> struct Stages {
  int samples;
  CameraStages<T> plain, full;
  void (*count_pairs)(BinTask<T>&);
  void (*scatter_pairs)(BinTask<T>&);
  void (*choose)(const ChooseTask<T>&);  ///< null where all tiles have the same samples
  void (*blend)(const BlendTask<T>&);
  void (*blend_vjp)(const BlendVjpTask<T>&);
  void (*weight)(const WeightTask<T>&);
  void (*weight_vjp)(const WeightTask<T>&);
  void (*inspect)(const InspectTask<T>&);

  const CameraStages<T>& of(const CameraView<T>& camera) const { return camera.lens ? full : plain; }
};

/// Stages of the footprint whose kName is `footprint`, for the best instruction set that this
/// machine and the environment variable ANALYTIC_RASTERIZER_ISA (baseline, avx2, avx512) allow.
/// Null if there is no such footprint. double always runs the baseline.
template <typename T> const Stages<T>* find_stages(std::string_view footprint);

/// Name of the instruction set that find_stages<float> uses.
const char* instruction_set();

}  // namespace ar::cpu
