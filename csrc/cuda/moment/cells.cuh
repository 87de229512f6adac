// A library for the kernels of footprints whose samples move (moment/): how the samples, or cells, of a tile are shared
// out among lanes, the state of a lane's samples and its checkpoints, the splats that a block stages, and compositing a
// splat into a pixel. It launches nothing.
#pragma once

#include "cuda/moment/cut_lists.h"
#include "cuda/tile.cuh"
#include "cuda/tuning.h"

namespace ar::cuda {

/// The group of pixels that the calling warp works on, with a layout whose groups are claimed (kClaimed of CellLayout,
/// vjp_segments.cuh).
__device__ inline int& claimed_group() {
  __shared__ int groups[32];
  return groups[threadIdx.x / 32];
}

/// How the samples of a tile of kSide x kSide pixels are shared out. Each lane has kCells cells. The cells of one pixel
/// are in kLanes neighbouring lanes (a power of two). The pixels of a warp, a group, are a rectangle. The groups of a
/// tile are spread over kBlocks blocks of kWarps warps; kWarpsOfGroup warps share a group. kClaimed: a warp claims one
/// group after the other, instead of having one.
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
  static constexpr int kColumns = kSide / kWide;  ///< groups side by side

  /// This warp's group.
  __device__ static int group() {
    if constexpr (kClaimed) return claimed_group();
    return (int(blockIdx.x) % kBlocks * kWarps + int(threadIdx.x) / 32) / kWarpsOfGroup;
  }
  /// The number of the group's pixel i in the tile, row by row, whatever the layout.
  __device__ static int pixel_number(int i) {
    const int g = group();
    return (g / kColumns * kHigh + i / kWide) * kSide + g % kColumns * kWide + i % kWide;
  }
  __device__ static int pixel_number() { return pixel_number(lane_id() / kLanes); }  ///< of this thread's pixel
  /// This thread's pixel, relative to the tile's first.
  __device__ static Vec2<float> pixel() {
    const int g = group(), i = lane_id() / kLanes;
    return {float(g % kColumns * kWide + i % kWide), float(g / kColumns * kHigh + i / kWide)};
  }
  /// The first of this thread's samples of its pixel.
  __device__ static int first_sample() { return lane_id() % kLanes * kCells; }
  /// Whether this lane writes its samples: AheadLayout has the same sample in several lanes.
  __device__ static bool owns() { return true; }

  /// Bit w: the splat reaches the pixels of warp w of this block (of group w with kClaimed), or passes them closely.
  /// The tile begins at (x0, y0).
  template <class F> __device__ static uint32_t block_reach(const Splat<F, float>& splat, int x0, int y0) {
    constexpr int kOfBlock = kGroups / kBlocks;
    static_assert(kOfBlock % kColumns == 0);
    const int rows = kClaimed ? 0 : int(blockIdx.x) % kBlocks * kOfBlock / kColumns;  // of the blocks before
    return reached_boxes<kWide, kHigh, kColumns, kOfBlock / kColumns, F>(splat, x0, y0 + rows * kHigh);
  }
  /// The bit of block_reach() of this warp's pixels.
  __device__ static int own_bit() { return kClaimed ? group() : int(threadIdx.x) / 32; }

  /// The sum over the lanes of a pixel, in each of them.
  __device__ static float sum_lanes(float x) {
#pragma unroll
    for (int offset = 1; offset < kLanes; offset *= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
  }
};

/// How samples are shared out in tiles of kSide x kSide pixels for lists that are not cut, so that there is least to
/// do, forward and backward. Where cuts_all_lists(), such lists are only those of frames with more pairs than room.
template <class F, int kSide>
using EvenLayout =
    std::conditional_t<(kSide < kMovingTile), CellLayout<1, F::kSamples, kSide>, CellLayout<F::kSide, F::kSide, kSide>>;

/// Where the checkpoints of a tile's samples are: the checkpoint before pair i spacing, i > 0, has number first + i
/// - 1. The tiles of a patch share the room of its list equally.
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
  /// The checkpoint before pair k, where each chunk of kStateChunk pairs but the first has one.
  template <class Samples> __device__ float* at(float* checkpoints, int k) const {
    return checkpoints + (first + k / kStateChunk - 1) * Samples::kCheckpoint;
  }
};

/// The terms of a splat for the cells of a tile: lengths are in edges of cells.
template <class F> __device__ auto cell_terms(const Splat<F, float>& splat, const TileList& list) {
  auto terms = tile_terms(splat, list);
  terms.w = 1.0f / F::kSide * terms.w;
  return terms;
}

/// Whether the samples of a pixel are neighbours in a checkpoint of a list that is not cut.
template <class Layout> inline constexpr bool kSamplesTogether = Layout::kSide < kMovingTile;

/// The state of a lane's samples on their way through a list. `kTogether`: in a checkpoint the samples of a pixel are
/// neighbours, as among the lanes of warps with few pixels; else the pixels of a sample are.
template <class F, class Layout, bool kTogether = kSamplesTogether<Layout>> struct MovingSamples {
  static constexpr int kCells = Layout::kCells;
  float transmittance[kCells];
  Vec2<float> position[kCells];  ///< position of the node in its cell

  /// Before all splats.
  __device__ explicit MovingSamples(bool inside) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      transmittance[i] = inside && exists(i) ? 1.0f : -1.0f;
      position[i] = {0.5f, 0.5f};
    }
  }
  __device__ static bool exists(int i) { return Layout::first_sample() + i < F::kSamples; }
  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int i = 0; i < kCells; ++i) any |= transmittance[i] > 0;
    return any;
  }

  static constexpr int kCheckpoint = state_planes(F::kSamples) * Layout::kTilePixels;  ///< numbers of a checkpoint
  static constexpr int kPlane =
      kTogether ? F::kSamples * Layout::kTilePixels : Layout::kTilePixels;  ///< from a plane to the next
  /// The index in a checkpoint of the transmittance of sample i of this pixel; its position is in the next two planes.
  __device__ static int in_checkpoint(int i) {
    const int sample = Layout::first_sample() + i, pixel = Layout::pixel_number();
    return kTogether ? pixel * F::kSamples + sample : 3 * sample * Layout::kTilePixels + pixel;
  }
  /// With `last` only the samples that load() reads from a checkpoint before pair k.
  __device__ void store(float* checkpoint, int k = 0, const int* last = nullptr) const {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      if (!exists(i) || !Layout::owns() || (last && k >= last[i])) continue;
      float* to = checkpoint + in_checkpoint(i);
      to[0] = abs(transmittance[i]);
      to[kPlane] = position[i].x;
      to[2 * kPlane] = position[i].y;
    }
  }
  /// The state before pair k, which `checkpoint` has unless k is 0. Samples that have composited their last splat
  /// before (last[i] <= k) may have no checkpoint there, and need none.
  __device__ void load(const float* checkpoint, int k, const int (&last)[kCells]) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      transmittance[i] = 1;
      position[i] = {0.5f, 0.5f};
      if (k == 0 || k >= last[i]) continue;
      const float* from = checkpoint + in_checkpoint(i);
      transmittance[i] = from[0];
      position[i] = {from[kPlane], from[2 * kPlane]};
    }
  }
};

/// A splat at a node: whitened coordinates, and opacity * weight there.
struct Seen {
  Vec2<float> z;
  float raw;
};

/// Where the cells of a lane are, in edges of cells from the centre of the tile's first pixel. The rounding of whitened
/// coordinates does not depend on the layout, so that a backward kernel finds what a forward kernel has composited.
template <class F, class Layout> struct CellCorners {
  static_assert(F::kSide % Layout::kCells == 0, "the cells of a lane are in one row");
  float left[Layout::kCells], top;

  /// `p`: the pixel, relative to the tile's first.
  __device__ explicit CellCorners(Vec2<float> p) {
    const Vec2<float> corner = {F::kSide * (p.x - 0.5f), F::kSide * (p.y - 0.5f)};
#pragma unroll
    for (int i = 0; i < Layout::kCells; ++i) left[i] = corner.x + float((Layout::first_sample() + i) % F::kSide);
    top = corner.y + float(Layout::first_sample() / F::kSide);
  }

  /// The splat at the node of cell i, at `position` in the cell.
  template <class Terms> __device__ Seen see(const Terms& terms, int i, Vec2<float> position) const {
    const Vec2<float> at = {left[i] + position.x, position.y};
    const Vec2<float> z = F::whitened_node(terms, F::whitened_row(terms, top), at);
    return {z, exp2(F::log_alpha(terms, z))};
  }
};

template <class Layout> inline constexpr int kListAhead = list_ahead(Layout::kCells);

/// Up to kBatch splats of a tile, with C channels, that a block works on together, and for each warp a list of up to
/// kListed of them that reach its pixels. `kOffsets`: entries of lists are offsets in memory, else numbers of splats.
template <class F, int C, class Layout, int kBatch, int kListed = 32, bool kOffsets = false> struct MovingStage {
  static_assert(kBatch % 32 == 0);
  using Lists =
      ReachLists<uint32_t, kOffsets ? sizeof(TileSplat<F, C>) : 1, kListAhead<Layout>, Layout::kWarps, kListed>;
  TileSplat<F, C> splats[kBatch];
  uint32_t reach[kBatch];
  Lists lists;

  /// This thread's splat of those in [k, k + kBatch) and before `end` of the list, or -1.
  __device__ static int32_t splat_of(const TileList& list, int k, int end) {
    static_assert(kBatch <= Layout::kThreads);
    const int t = threadIdx.x;
    return t < kBatch && k + t < end ? list.splat(k + t) : -1;
  }
  /// Loads the splats, `id` = splat_of(), with channels from `first` on.
  template <class Params> __device__ void load(const Params& params, int first, const TileList& list, int32_t id) {
    if (threadIdx.x < kBatch) load_one(int(threadIdx.x), params, first, list, id);
  }
  /// Loads splat `id` at index t, or none if it is -1.
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

/// A lane's share of blending a pixel with C channels. kKeep: for a backward pass it also finds `last`.
template <class F, int C, class Layout, bool kKeep, bool kTogether = kSamplesTogether<Layout>> struct MovingBlend {
  static constexpr int kCells = Layout::kCells;
  /// Whether the warp votes on whether any of its samples shows a splat before it composites the splat. That pays where
  /// a lane has several cells and a warp so few pixels that often none shows it, but not with kKeep, which takes more
  /// registers.
  static constexpr bool kVotes = !kKeep && kCells > 1 && Layout::kPixels <= 8;
  Pixel pixel;
  MovingSamples<F, Layout, kTogether> samples;
  CellCorners<F, Layout> corners;
  Values<C> sums = {};
  int last[kCells] = {};  ///< only with kKeep

  __device__ MovingBlend(const TileList& list, TileGrid grid)
      : pixel(list, grid, Layout::pixel()), samples(pixel.inside), corners(Layout::pixel()) {}

  /// Composites a splat into the samples; with kKeep shown[i] becomes `index` where it was composited into sample i.
  /// With kVotes all lanes must call it.
  __device__ void add(TileSplatRef<F, C>& splat, int index, int (&shown)[kCells]) {
    const auto see = [&](int i) { return corners.see(splat.terms, i, samples.position[i]); };
    [[maybe_unused]] Seen seen[kCells] = {};
    if constexpr (kVotes) {
      bool shows = false;
#pragma unroll
      for (int i = 0; i < kCells; ++i) {
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

  /// Adds the lanes of each pixel up and writes its images. All lanes must call it.
  __device__ void write(const BlendParams& params, int first) {
    float through = 0;
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      if (!samples.exists(i) || !Layout::owns()) continue;
      through += abs(samples.transmittance[i]);
      if (!kKeep || !pixel.inside) continue;
      const int64_t index = (Layout::first_sample() + i) * pixel.image + pixel.index;
      params.transmittance[index] = abs(samples.transmittance[i]);
      params.last[index] = last[i];
    }
    through = Layout::sum_lanes(through);
#pragma unroll
    for (int c = 0; c < C; ++c) sums.v[c] = Layout::sum_lanes(sums.v[c]);
    if (!pixel.inside || Layout::first_sample() > 0 || !Layout::owns()) return;
    const float scale = 1.0f / F::kSamples;
#pragma unroll
    for (int c = 0; c < C; ++c) {
      if (first + c >= params.channels.count) break;
      params.image.plane(first + c, pixel.image)[pixel.index] =
          scale * sums.v[c] + scale * through * params.background[first + c];
    }
    if (first == 0 && params.alpha) params.alpha[pixel.index] = 1 - scale * through;
  }
};

}  // namespace ar::cuda
