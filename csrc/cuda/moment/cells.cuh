// What moment/ shares. A pixel has F::kSamples square cells, each with a sample at a node that moves in it with every
// splat composited. CellLayout says which lane has which samples, MovingSamples is their state and checkpoints,
// MovingStage a batch of splats in shared memory, MovingBlend the forward pass of a lane.
//
// Template parameters in moment/: F is the footprint, C the number of channels, kSide the side of the tiles [px],
// Layout a CellLayout, kSegment the pairs of a segment. kKeep: for a backward pass. All lanes of a warp must call
// functions that vote, shuffle or wait.
#pragma once

#include "cuda/moment/cut_lists.h"
#include "cuda/moment/policy.h"
#include "cuda/occupancy.h"
#include "cuda/tile/stage.cuh"

namespace ar::cuda {

/// The group of the calling warp, with kClaimed.
__device__ inline int& claimed_group() {
  __shared__ int groups[32];
  return groups[threadIdx.x / 32];
}

/// A lane has kCellsOfLane neighbouring cells of a row, a pixel kLanesOfPixel neighbouring lanes (a power of two), a
/// warp a rectangle of pixels, a group. kClaimed: warps claim groups. kWarpsOfGroup: warps with different samples of
/// the same pixels.
template <int kCellsOfLane, int kLanesOfPixel, int kSideOfTile = kMovingTile,
          int kWarpsOfBlock = kLanesOfPixel * kSideOfTile * kSideOfTile / 32, bool kClaimed = false,
          int kWarpsOfGroup = 1>
struct CellLayout {
  static constexpr int kCells = kCellsOfLane, kLanes = kLanesOfPixel;
  static constexpr int kSide = kSideOfTile, kTilePixels = kSide * kSide;
  static constexpr int kGroups = kLanes * kTilePixels / 32;
  static constexpr int kWarps = kWarpsOfBlock, kThreads = 32 * kWarps;
  static constexpr int kBlocks = kClaimed ? 1 : kGroups * kWarpsOfGroup / kWarps;
  static_assert((kLanes & (kLanes - 1)) == 0 && kLanes <= 32 && kGroups * kWarpsOfGroup % kWarps == 0 && kWarps <= 32);
  static constexpr int kPixels = 32 / kLanes;  ///< of a group
  static constexpr int kWide = kPixels == 32 ? 8 : kPixels >= 8 ? 4 : kPixels >= 2 ? 2 : 1, kHigh = kPixels / kWide;
  static constexpr int kColumns = kSide / kWide;

  __device__ static int group() {
    if constexpr (kClaimed) return claimed_group();
    return (int(blockIdx.x) % kBlocks * kWarps + int(threadIdx.x) / 32) / kWarpsOfGroup;
  }
  /// Of the group's pixel i in the tile, row by row.
  __device__ static int pixel_number(int i) {
    const int g = group();
    return (g / kColumns * kHigh + i / kWide) * kSide + g % kColumns * kWide + i % kWide;
  }
  __device__ static int pixel_number() { return pixel_number(lane_id() / kLanes); }
  /// Of this lane, relative to the tile's first.
  __device__ static Vec2<float> pixel() {
    const int g = group(), i = lane_id() / kLanes;
    return {float(g % kColumns * kWide + i % kWide), float(g / kColumns * kHigh + i / kWide)};
  }
  __device__ static int first_sample() { return lane_id() % kLanes * kCells; }
  /// False where other lanes have the same samples too (AheadLayout).
  __device__ static bool owns() { return true; }

  /// Bit w: the splat may reach the pixels of warp w of this block (kClaimed: of group w).
  template <class F> __device__ static uint32_t block_reach(const Splat<F, float>& splat, int x0, int y0) {
    constexpr int kOfBlock = kGroups / kBlocks;
    static_assert(kOfBlock % kColumns == 0);
    const int rows = kClaimed ? 0 : int(blockIdx.x) % kBlocks * kOfBlock / kColumns;
    return reached_boxes<kWide, kHigh, kColumns, kOfBlock / kColumns, F>(splat, x0, y0 + rows * kHigh);
  }
  __device__ static int own_bit() { return kClaimed ? group() : int(threadIdx.x) / 32; }

  __device__ static float sum_lanes(float x) {
    AR_UNROLL for (int offset = 1; offset < kLanes; offset *= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
  }
};

/// For lists that are not cut.
template <class F, int kSide>
using EvenLayout =
    std::conditional_t<(kSide < kMovingTile), CellLayout<1, F::kSamples, kSide>, CellLayout<F::kSide, F::kSide, kSide>>;

/// Checkpoint first + i - 1 is before pair i * spacing, i > 0. Tiles of a patch share the room of its list.
struct TileCheckpoints {
  int64_t first;
  int spacing;  ///< a multiple of kStateChunk

  __device__ TileCheckpoints(const TileLists& lists, const TileList& list, TileGrid grid, int tile)
      : first(lists.tile_offsets[tile] / kStateChunk), spacing(kStateChunk) {
    if (!list.of_patch) return;
    const TileInPatch of_patch(lists, grid, tile);
    const int room = list.count / kStateChunk / of_patch.tiles;
    first = lists.tile_offsets[of_patch.first_tile] / kStateChunk + int64_t(of_patch.index) * room;
    spacing = ((list.count - 1) / (room + 1) / kStateChunk + 1) * kStateChunk;
  }
  /// Before pair k, if `spacing` is kStateChunk.
  template <class Samples> __device__ float* at(float* checkpoints, int k) const {
    return checkpoints + (first + k / kStateChunk - 1) * Samples::kCheckpoint;
  }
};

/// The unit of length is the edge of a cell.
template <class F> __device__ auto cell_terms(const Splat<F, float>& splat, const TileList& list) {
  auto terms = tile_terms(splat, list);
  terms.w = 1.0f / F::kSide * terms.w;
  return terms;
}

template <class Layout> inline constexpr bool kSamplesTogether = Layout::kSide < kMovingTile;

/// A checkpoint has the transmittance and position of each sample of the tile. With kTogether it is [3, kTilePixels,
/// samples], which suits warps with few pixels, else [samples, 3, kTilePixels].
template <class F, class Layout, bool kTogether = kSamplesTogether<Layout>> struct MovingSamples {
  static constexpr int kCells = Layout::kCells;
  float transmittance[kCells];
  Vec2<float> position[kCells];  ///< of the node, in [0, 1]^2

  __device__ explicit MovingSamples(bool inside) {
    AR_UNROLL for (int i = 0; i < kCells; ++i) {
      transmittance[i] = inside && exists(i) ? 1.0f : -1.0f;
      position[i] = {0.5f, 0.5f};
    }
  }
  __device__ static bool exists(int i) { return Layout::first_sample() + i < F::kSamples; }
  __device__ bool open() const {
    bool any = false;
    AR_UNROLL for (int i = 0; i < kCells; ++i) any |= transmittance[i] > 0;
    return any;
  }

  static constexpr int kCheckpoint = state_planes(F::kSamples) * Layout::kTilePixels;
  static constexpr int kPlane = kTogether ? F::kSamples * Layout::kTilePixels : Layout::kTilePixels;
  /// Of the transmittance of sample i; its position is in the next two planes.
  __device__ static int in_checkpoint(int i) {
    const int sample = Layout::first_sample() + i, pixel = Layout::pixel_number();
    return kTogether ? pixel * F::kSamples + sample : 3 * sample * Layout::kTilePixels + pixel;
  }
  __device__ void store(float* checkpoint, int k = 0, const int* last = nullptr) const {
    AR_UNROLL for (int i = 0; i < kCells; ++i) {
      if (!exists(i) || !Layout::owns() || (last && k >= last[i])) continue;
      float* to = checkpoint + in_checkpoint(i);
      to[0] = abs(transmittance[i]);
      to[kPlane] = position[i].x;
      to[2 * kPlane] = position[i].y;
    }
  }
  /// Before pair k. A sample with last[i] <= k may have no checkpoint.
  __device__ void load(const float* checkpoint, int k, const int (&last)[kCells]) {
    AR_UNROLL for (int i = 0; i < kCells; ++i) {
      transmittance[i] = 1;
      position[i] = {0.5f, 0.5f};
      if (k == 0 || k >= last[i]) continue;
      const float* from = checkpoint + in_checkpoint(i);
      transmittance[i] = from[0];
      position[i] = {from[kPlane], from[2 * kPlane]};
    }
  }
};

/// A splat at a node. All kernels call see(): alpha has the same bits.
struct Seen {
  Vec2<float> z;
  float raw;
};

/// In edges of cells from the centre of the tile's first pixel. They round alike in every layout.
template <class F, class Layout> struct CellCorners {
  static_assert(F::kSide % Layout::kCells == 0, "the cells of a lane are in one row");
  float left[Layout::kCells], top;

  __device__ explicit CellCorners(Vec2<float> p) {
    const Vec2<float> corner = {F::kSide * (p.x - 0.5f), F::kSide * (p.y - 0.5f)};
    AR_UNROLL for (int i = 0; i < Layout::kCells; ++i) left[i] =
        corner.x + float((Layout::first_sample() + i) % F::kSide);
    top = corner.y + float(Layout::first_sample() / F::kSide);
  }

  /// At `position` in cell i.
  template <class Terms> __device__ Seen see(const Terms& terms, int i, Vec2<float> position) const {
    const Vec2<float> at = {left[i] + position.x, position.y};
    const Vec2<float> z = F::whitened_node(terms, F::whitened_row(terms, top), at);
    return {z, exp2(F::log_alpha(terms, z))};
  }
};

template <class Layout> inline constexpr int kListAhead = MomentPolicy::list_ahead(Layout::kCells);

/// A batch of splats, and for each warp a list of up to kListed that reach its pixels. kOffsets: of offsets in memory,
/// not indices.
template <class F, int C, class Layout, int kBatch, int kListed = 32, bool kOffsets = false> struct MovingStage {
  static_assert(kBatch % 32 == 0);
  using Lists =
      ReachLists<uint32_t, kOffsets ? sizeof(TileSplat<F, C>) : 1, kListAhead<Layout>, Layout::kWarps, kListed>;
  TileSplat<F, C> splats[kBatch];
  uint32_t reach[kBatch];
  Lists lists;

  /// This thread's splat of [k, k + kBatch), or -1 from pair `end` on.
  __device__ static int32_t splat_of(const TileList& list, int k, int end) {
    static_assert(kBatch <= Layout::kThreads);
    const int t = threadIdx.x;
    return t < kBatch && k + t < end ? list.splat(k + t) : -1;
  }
  template <class Params> __device__ void load(const Params& params, int first, const TileList& list, int32_t id) {
    if (threadIdx.x < kBatch) load_one(int(threadIdx.x), params, first, list, id);
  }
  /// Splat `id`, or none if it is -1.
  template <class Params>
  __device__ void load_one(int t, const Params& params, int first, const TileList& list, int32_t id) {
    uint32_t bits = 0;
    if (id >= 0) {
      const Splat<F, float> splat = load_splat<F>(params.splats, id);
      bits = Layout::template block_reach<F>(splat, list.x0, list.y0);
      if (bits) splats[t] = {cell_terms(splat, list), channels_of<C>(params.channels, splat, id, first)};
    }
    reach[t] = bits;
  }
};

/// A lane's share of a pixel.
template <class F, int C, class Layout, bool kKeep, bool kTogether = kSamplesTogether<Layout>> struct MovingBlend {
  static constexpr int kCells = Layout::kCells;
  /// Whether the warp votes if any sample shows the splat: pays with several cells in a lane and few pixels in a warp;
  /// kKeep needs the registers.
  static constexpr bool kVotes = !kKeep && kCells > 1 && Layout::kPixels <= 8;
  Pixel pixel;
  MovingSamples<F, Layout, kTogether> samples;
  CellCorners<F, Layout> corners;
  Values<C> sums = {};
  int last[kCells] = {};  ///< only with kKeep

  __device__ MovingBlend(const TileList& list, TileGrid grid)
      : pixel(list, grid, Layout::pixel()), samples(pixel.inside), corners(Layout::pixel()) {}

  /// With kKeep shown[i] becomes `index` if sample i shows the splat. With kVotes all lanes must call it.
  __device__ void add(TileSplatRef<F, C>& splat, int index, int (&shown)[kCells]) {
    const auto see = [&](int i) { return corners.see(splat.terms, i, samples.position[i]); };
    [[maybe_unused]] Seen seen[kCells] = {};
    if constexpr (kVotes) {
      bool shows = false;
      AR_UNROLL for (int i = 0; i < kCells; ++i) {
        seen[i] = see(i);
        shows |= (seen[i].raw >= float(kAlphaMin)) & (samples.transmittance[i] > 0);
      }
      if (!__any_sync(kAllLanes, shows)) return;
    }
    add_samples<kCells>(sums, splat.channels, [&](int i) {
      const auto [z, raw] = kVotes ? seen[i] : see(i);
      const Blended<float> b = blend_placed_sample<F>(splat.terms, z, raw, UnitCell<F::kSide>(),
                                                      samples.transmittance[i], samples.position[i]);
      if (kKeep) shown[i] = b.mask ? index : shown[i];
      return b;
    });
  }

  __device__ void write(const BlendParams& params, int first) {
    float through = 0;
    AR_UNROLL for (int i = 0; i < kCells; ++i) {
      if (!samples.exists(i) || !Layout::owns()) continue;
      through += abs(samples.transmittance[i]);
      if (!kKeep || !pixel.inside) continue;
      const int64_t index = (Layout::first_sample() + i) * pixel.image + pixel.index;
      params.transmittance[index] = abs(samples.transmittance[i]);
      params.last[index] = last[i];
    }
    through = Layout::sum_lanes(through);
    AR_UNROLL for (int c = 0; c < C; ++c) sums.v[c] = Layout::sum_lanes(sums.v[c]);
    if (!pixel.inside || Layout::first_sample() > 0 || !Layout::owns()) return;
    const float scale = 1.0f / F::kSamples;
    AR_UNROLL for (int c = 0; c < C; ++c) {
      if (first + c >= params.channels.count) break;
      params.image.plane(first + c, pixel.image)[pixel.index] =
          scale * sums.v[c] + scale * through * params.background[first + c];
    }
    if (first == 0 && params.alpha) params.alpha[pixel.index] = 1 - scale * through;
  }
};

}  // namespace ar::cuda
