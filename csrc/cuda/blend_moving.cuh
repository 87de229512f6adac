// Kernel of blend for footprints whose samples move: a block per tile, a lane per few samples of a pixel.
//
// What a splat does to a sample depends on where the sample is when they meet, so that the chunks of a list cannot be
// blended side by side as in blend.cuh: a block walks its whole list. What fills the device instead is that samples are
// spread over lanes and that tiles are small where there are several. It also wastes less: the fewer pixels a warp has,
// the fewer splats pass through it that touch only some of them. Lists that are cut, which cut_lists.cuh decides, have
// the kernels of blend_listed.cuh in its place.
#pragma once

#include "cuda/composite.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// Channels that are blended at once, where there are more than lie in the rows of pairs.
inline constexpr int kMovingChannels = 8;

/// The group of pixels that the calling warp works on, with a layout in which warps take one group after the other
/// (kTaken of CellLayout, blend_moving_segments.cuh).
__device__ inline int& taken_group() {
  __shared__ int groups[32];
  return groups[threadIdx.x / 32];
}

/// How the samples of a tile of kSide x kSide pixels are shared out: kCells to a lane, those of a pixel to kLanes
/// neighbours, a power of two, of which the last may have fewer, or none. The pixels of a warp, a group, are a
/// rectangle. A tile's groups are spread over kBlocks blocks of kWarps warps, of which kWarpsOfGroup share a group.
template <int kCellsOfLane, int kLanesOfPixel, int kSideOfTile = kMovingTile,
          int kWarpsOfBlock = kLanesOfPixel * kSideOfTile * kSideOfTile / 32, bool kTaken = false,
          int kWarpsOfGroup = 1>
struct CellLayout {
  static constexpr int kCells = kCellsOfLane, kLanes = kLanesOfPixel;
  static constexpr int kSide = kSideOfTile, kTilePixels = kSide * kSide;
  static constexpr int kGroups = kLanes * kTilePixels / 32;
  static constexpr int kWarps = kWarpsOfBlock, kThreads = 32 * kWarps;
  static constexpr int kBlocks = kTaken ? 1 : kGroups * kWarpsOfGroup / kWarps;
  static_assert((kLanes & (kLanes - 1)) == 0 && kLanes <= 32 && kGroups * kWarpsOfGroup % kWarps == 0 && kWarps <= 32);
  static constexpr int kPixels = 32 / kLanes;  ///< of a group
  static constexpr int kWide = kPixels == 32 ? 8 : kPixels >= 8 ? 4 : kPixels >= 2 ? 2 : 1, kHigh = kPixels / kWide;
  static constexpr int kColumns = kSide / kWide;  ///< groups side by side

  /// This warp's group.
  __device__ static int group() {
    if constexpr (kTaken) return taken_group();
    return (int(blockIdx.x) % kBlocks * kWarps + int(threadIdx.x) / 32) / kWarpsOfGroup;
  }
  /// The place of the group's pixel i among the tile's, row by row, whatever the layout.
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
  /// Whether no other lane has the samples too, or this is the one of them that writes.
  __device__ static bool owns() { return true; }

  /// Bit w: the splat reaches the pixels of warp w of this block, or of group w if they are taken, or passes them
  /// closely. The tile begins at (x0, y0).
  template <class F> __device__ static uint32_t block_reach(const Splat<F, float>& splat, int x0, int y0) {
    constexpr int kOfBlock = kGroups / kBlocks;
    static_assert(kOfBlock % kColumns == 0);
    const int rows = kTaken ? 0 : int(blockIdx.x) % kBlocks * kOfBlock / kColumns;  // of the blocks before
    return reached_boxes<kWide, kHigh, kColumns, kOfBlock / kColumns, F>(splat, x0, y0 + rows * kHigh);
  }
  /// The bit of block_reach() of this warp's pixels.
  __device__ static int own_bit() { return kTaken ? group() : int(threadIdx.x) / 32; }

  /// The sum over the lanes of a pixel, in each of them.
  __device__ static float sum_lanes(float x) {
#pragma unroll
    for (int offset = 1; offset < kLanes; offset *= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
  }
};

/// Where the checkpoints of a tile's samples are: the one in front of pair i spacing, i > 0, is number first + i - 1.
/// The tiles of a patch share the room of its list equally.
struct StatePlaces {
  int64_t first;
  int spacing;  ///< a multiple of kStateChunk

  __device__ StatePlaces(const TileLists& lists, const TileList& list, TileGrid grid, int tile)
      : first(lists.tile_offsets[tile] / kStateChunk), spacing(kStateChunk) {
    if (!list.of_patch) return;
    const TileInPatch of_patch(lists, grid, tile);
    const int room = list.count / kStateChunk / of_patch.tiles;
    first = lists.tile_offsets[of_patch.first_tile] / kStateChunk + int64_t(of_patch.index) * room;
    spacing = ((list.count - 1) / (room + 1) / kStateChunk + 1) * kStateChunk;
  }
  /// The number of the checkpoint in front of chunk k / kStateChunk, where every chunk but the first has one.
  __device__ int64_t of_chunk_at(int k) const { return first + k / kStateChunk - 1; }
};

/// What the cells of a tile need of a splat: lengths are in edges of cells.
template <class F> __device__ auto cell_terms(const Splat<F, float>& splat, const TileList& list) {
  auto terms = tile_terms(splat, list);
  terms.w = 1.0f / F::kSide * terms.w;
  return terms;
}

/// Whether the samples of a pixel are neighbours in a checkpoint of a list that is not cut.
template <class Layout> inline constexpr bool kSamplesTogether = Layout::kSide < kMovingTile;

/// A lane's samples on their way through a list. `kTogether`: the samples of a pixel are neighbours in a checkpoint, as
/// they are among the lanes of warps with few pixels; else the pixels of a sample are.
template <class F, class Layout, bool kTogether = kSamplesTogether<Layout>> struct MovingSamples {
  static constexpr int kCells = Layout::kCells;
  float transmittance[kCells];
  Vec2<float> place[kCells];  ///< of the node in its cell

  /// In front of all splats.
  __device__ explicit MovingSamples(bool inside) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      transmittance[i] = inside && exists(i) ? 1.0f : -1.0f;
      place[i] = {0.5f, 0.5f};
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
  /// Where a checkpoint has sample i of this pixel: its transmittance, and its place in the two planes behind.
  __device__ static int in_checkpoint(int i) {
    const int sample = Layout::first_sample() + i, pixel = Layout::pixel_number();
    return kTogether ? pixel * F::kSamples + sample : 3 * sample * Layout::kTilePixels + pixel;
  }
  __device__ void store(float* checkpoint) const {
    store(checkpoint, [](int) { return true; });
  }
  /// Only those samples that load() reads from a checkpoint in front of pair k.
  __device__ void store(float* checkpoint, int k, const int (&last)[kCells]) const {
    store(checkpoint, [&](int i) { return k < last[i]; });
  }
  /// In front of pair k, where `checkpoint` is, unless k is 0. Samples that have composited their last splat, `last`
  /// pairs from the first, may have no checkpoint there, and need none.
  __device__ void load(const float* checkpoint, int k, const int (&last)[kCells]) {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      transmittance[i] = 1;
      place[i] = {0.5f, 0.5f};
      if (k == 0 || k >= last[i]) continue;
      const float* from = checkpoint + in_checkpoint(i);
      transmittance[i] = from[0];
      place[i] = {from[kPlane], from[2 * kPlane]};
    }
  }

 private:
  template <class Wanted> __device__ void store(float* checkpoint, Wanted&& wanted) const {
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      if (!exists(i) || !Layout::owns() || !wanted(i)) continue;
      float* to = checkpoint + in_checkpoint(i);
      to[0] = abs(transmittance[i]);
      to[kPlane] = place[i].x;
      to[2 * kPlane] = place[i].y;
    }
  }
};

/// Where the cells of a lane are, in edges of cells from the centre of the tile's first pixel. How whitened coordinates
/// are rounded does not depend on the layout, so that one kernel finds again what another has composited.
template <class F, class Layout> struct CellCorners {
  /// Cells are numbered row by row, so that cells i and i + kColumns are in one column; all may be in one row.
  static constexpr int kColumns = Layout::kCells < F::kSide ? Layout::kCells : F::kSide;
  static constexpr int kRows = F::kSide % Layout::kCells == 0 ? 1 : Layout::kCells;
  float left[kColumns], top[kRows];

  /// `p`: the pixel, relative to the tile's first.
  __device__ explicit CellCorners(Vec2<float> p) {
    const Vec2<float> corner = {F::kSide * (p.x - 0.5f), F::kSide * (p.y - 0.5f)};
#pragma unroll
    for (int i = 0; i < kColumns; ++i) left[i] = corner.x + float((Layout::first_sample() + i) % F::kSide);
#pragma unroll
    for (int i = 0; i < kRows; ++i) top[i] = corner.y + float((Layout::first_sample() + i) / F::kSide);
  }

  /// Whitened coordinates of the node of cell i, which is at `place` in it.
  template <class Terms> __device__ Vec2<float> node(const Terms& terms, int i, Vec2<float> place) const {
    const Vec2<float> row = F::whitened_row(terms, top[i % kRows]);
    return F::whitened_node(terms, row, Vec2<float>{left[i % kColumns] + place.x, place.y});
  }
};

/// Entries of a list of the splats that reach a warp that are read at a time: several, if a lane has few samples.
template <class Layout> inline constexpr int kListAhead = Layout::kCells <= 2 ? 4 : 1;

/// Up to kBatch splats of a tile that a block works on together, and lists of up to kListed of these that reach each
/// warp's pixels. `kPlaces`: entries of lists are places in memory, else numbers of splats.
template <class F, int C, class Layout, int kBatch, int kListed = 32, bool kPlaces = false> struct MovingStage {
  static_assert(kBatch % 32 == 0);
  using Lists =
      ReachLists<uint32_t, kPlaces ? sizeof(TileSplat<F, C>) : 1, kListAhead<Layout>, Layout::kWarps, kListed>;
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
  __device__ void load(const Splat<F, float>* splats_in, const Channels<float>& channels, int first,
                       const TileList& list, int32_t id) {
    if (threadIdx.x < kBatch) load_one(int(threadIdx.x), splats_in, channels, first, list, id);
  }
  /// Loads splat `id` in place t, or none if it is -1.
  __device__ void load_one(int t, const Splat<F, float>* splats_in, const Channels<float>& channels, int first,
                           const TileList& list, int32_t id) {
    uint32_t bits = 0;
    if (id >= 0) {
      const Splat<F, float> splat = splats_in[id];
      bits = Layout::template block_reach<F>(splat, list.x0, list.y0);
      if (bits) splats[t] = {cell_terms(splat, list), channels_of<C>(channels, splat, id, first)};
    }
    reach[t] = bits;
  }

  /// Of the splats [k, k + 32), those that reach this warp's pixels, in the order of take_first. All must call it.
  __device__ uint32_t reached(int k) const {
    return __ballot_sync(kAllLanes, reach[k + 31 - lane_id()] >> (threadIdx.x / 32) & 1);
  }
};

/// A lane's share of blending a pixel. kKeep: what the backward pass needs is kept.
template <class F, int C, class Layout, bool kKeep, bool kTogether = kSamplesTogether<Layout>> struct MovingBlend {
  static constexpr int kCells = Layout::kCells;
  /// Whether the warp asks if any of its samples shows a splat before it composites it. That pays where a lane has
  /// several cells and a warp so few pixels that often none does, but not with kKeep, which takes more registers.
  static constexpr bool kVotes = !kKeep && kCells > 1 && Layout::kPixels <= 8;
  MovingSamples<F, Layout, kTogether> samples;
  CellCorners<F, Layout> corners;
  Values<C> sums = {};
  int last[kCells] = {};  ///< only with kKeep

  /// `p`: the pixel, relative to the tile's first.
  __device__ MovingBlend(Vec2<float> p, bool inside) : samples(inside), corners(p) {}

  /// Adds what pair k shows in the first sample.
  __device__ void add(const Blended<float>& b, const Values<C>& channels, int k) {
    if (b.mask) sums.add(b.if_shown, channels);
    if (kKeep) last[0] = b.mask ? k + 1 : last[0];
  }
  /// Composites a splat into the samples; shown[i] becomes `place` where it was composited into sample i, if kKeep.
  /// With kVotes all lanes must call it.
  __device__ void add(TileSplatRef<F, C>& splat, int place, int (&shown)[kCells]) {
    struct Look {
      Vec2<float> z;
      float raw;
    };
    const auto look = [&](int i) {
      const Vec2<float> z = corners.node(splat.terms, i, samples.place[i]);
      return Look{z, exp2(F::log_alpha(splat.terms, z))};
    };
    [[maybe_unused]] Look looks[kCells] = {};
    if constexpr (kVotes) {
      bool shows = false;
#pragma unroll
      for (int i = 0; i < kCells; ++i) {
        looks[i] = look(i);
        shows |= (looks[i].raw >= float(kAlphaMin)) & (samples.transmittance[i] > 0);
      }
      if (!__any_sync(kAllLanes, shows)) return;
    }
    add_samples<kCells>(sums, splat.channels, [&](int i) {
      const auto [z, raw] = kVotes ? looks[i] : look(i);
      const Blended<float> b =
          blend_placed_sample<F>(splat.terms, z, raw, UnitCell<F::kSide>(), samples.transmittance[i], samples.place[i]);
      if (kKeep) shown[i] = b.mask ? place : shown[i];
      return b;
    });
  }

  /// Adds the lanes of each pixel up and writes its images. All lanes must call it.
  __device__ void write(const BlendParams& params, int first, const Pixel& pixel) {
    float through = 0;
#pragma unroll
    for (int i = 0; i < kCells; ++i) {
      if (!samples.exists(i) || !Layout::owns()) continue;
      through += abs(samples.transmittance[i]);
      if (!kKeep || !pixel.inside) continue;
      const int64_t place = (Layout::first_sample() + i) * pixel.image + pixel.index;
      params.transmittance[place] = abs(samples.transmittance[i]);
      params.last[place] = last[i];
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

/// Composites those of the staged splats [from, to) that reach the warp's pixels; the first that is staged is pair k0.
template <class F, int C, class Layout, bool kKeep, class Stage>
__device__ void blend_staged(Stage& stage, int from, int to, int k0, MovingBlend<F, C, Layout, kKeep>& blend) {
  constexpr int kBetweenVotes = 16, kCells = Layout::kCells;
  const int listed = stage.lists.list(stage.reach, from, to);
  int shown[kCells];  // the entry of the last that was composited into each sample
#pragma unroll
  for (int i = 0; i < kCells; ++i) shown[i] = -1;
  for (int n = 0; n < listed; n += kBetweenVotes) {
    if (!__any_sync(kAllLanes, blend.samples.open())) break;
    stage.lists.for_each(n, min(listed, n + kBetweenVotes), [&](uint32_t entry) {
      TileSplatRef<F, C> splat = Stage::Lists::splat_of(stage.splats, entry);
      blend.add(splat, int(entry), shown);
    });
  }
#pragma unroll
  for (int i = 0; kKeep && i < kCells; ++i)
    if (shown[i] >= 0) blend.last[i] = k0 + Stage::Lists::number_of(uint32_t(shown[i])) + 1;
  __syncwarp();  // all have read the list
}

/// A block per tile, which returns at once if the tile's list is cut, and one more that only waits
/// (begin_beside_earlier_kernels). Blends the C channels from `first` on; with three, registers are bounded so that an
/// SM holds 1024 threads. `beside`: the kernels for lists that are cut were launched just before, and may still run.
template <class F, int C, class Layout, bool kKeep>
__global__ void __launch_bounds__(Layout::kThreads, C == 3 ? 1024 / Layout::kThreads : 1)
    moving_blend_kernel(const BlendParams params, int first, bool beside) {
  if (begin_beside_earlier_kernels(beside)) return;
  constexpr int kBatch = Layout::kThreads < 256 ? Layout::kThreads : 256;
  constexpr int kListed = kKeep ? kStateChunk : kBatch;
  // Where a lane has many samples whose last splats have to be kept, lists would take too many registers.
  constexpr bool kLists = !kKeep || Layout::kCells <= 2;
  using Stage = MovingStage<F, C, Layout, kBatch, kListed, true>;
  __shared__ Stage stage;
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int tile = params.plan.tile_order[blockIdx.x];
  const bool is_cut = int(blockIdx.x) < params.plan.state->counts.cut_lists;
  const TileList list = list_of(params.lists, params.grid, tile);
  // With too many pairs no list is cut. The compiler needs fewer registers if both are asked here.
  if (is_cut && !list.of_patch) return;
  const StatePlaces places(params.lists, list, params.grid, tile);
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  MovingBlend<F, C, Layout, kKeep> blend(p, pixel.inside);
  int32_t id = stage.splat_of(list, 0, list.count);
  for (int k = 0; k < list.count && __syncthreads_or(blend.samples.open()); k += kBatch) {
    const int count = min(list.count - k, kBatch);
    const int32_t next_id = stage.splat_of(list, k + kBatch, list.count);
    stage.load(splats, params.channels, first, list, id);
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    for (int from = 0; from < count; from += kListed) {
      if (kKeep && !__any_sync(kAllLanes, blend.samples.open())) break;  // no checkpoint is needed
      if (kKeep && k + from > 0 && (k + from) % places.spacing == 0)
        blend.samples.store(params.checkpoints +
                            (places.first + (k + from) / places.spacing - 1) * blend.samples.kCheckpoint);
      if constexpr (kLists) {
        blend_staged(stage, from, min(count, from + kListed), k, blend);
      } else {
        for (uint32_t left = stage.reached(from); left != 0;) {
          const int j = from + take_first(left);
          TileSplatRef<F, C> splat = stage.splats[j];
          blend.add(splat, k + j + 1, blend.last);
        }
      }
    }
  }
  blend.write(params, first, pixel);
}

/// Lanes of a pixel where each sample has one: a power of two.
template <class F> inline constexpr int kLanesForSamples = F::kSamples == 9 ? 16 : F::kSamples;

/// Samples shared out so that there is least to do, forwards and backwards, in tiles of the size of moving_grid(), for
/// lists that are not cut. Where cuts_all_lists(), these are only those of frames with more pairs than room.
template <class F, bool kBackward, int kSide>
using EvenLayout =
    std::conditional_t<F::kSamples == 1 || (kSide < kMovingTile), CellLayout<1, kLanesForSamples<F>, kSide>,
                       std::conditional_t<F::kSamples == 4, CellLayout<2, 2>,
                                          std::conditional_t<F::kSamples == 9 && !kBackward, CellLayout<5, 2>,
                                                             CellLayout<(F::kSamples + 3) / 4, 4>>>>;

}  // namespace ar::cuda
