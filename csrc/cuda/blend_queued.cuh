// Blending of pixels that look ahead in their lists (blend_listed.cuh), for footprints whose samples move.
//
// Each pixel of a warp has a queue of the splats that reach it, and takes the next ones when it has composited those
// before, wherever in the tile's list they are: it does not wait for splats that reach only its neighbours. Several
// lanes have the same sample. Where the last pixels of a picture would be waited for, the warps of a block share the
// samples of one.
#pragma once

#include "cuda/blend_moving.cuh"
#include "cuda/cut_lists.cuh"

namespace ar::cuda {

/// A warp of kPixelsOfWarp pixels, or one pixel for the kWarpsOfPixel warps of a block, each with its own samples. Of
/// the lanes of a warp a sample has several, kAhead, which are neighbours. The last lanes may be left over, and have
/// none, and so may the last warp.
template <class F, int kSide, int kPixelsOfWarp, int kWarpsOfPixel = 1>
struct AheadLayout : CellLayout<1, 32 / kPixelsOfWarp, kSide, kWarpsOfPixel, false, kWarpsOfPixel> {
  using Base = CellLayout<1, 32 / kPixelsOfWarp, kSide, kWarpsOfPixel, false, kWarpsOfPixel>;
  /// Samples that a warp has of a pixel, and lanes of a sample.
  static constexpr int kOfWarp = (F::kSamples + kWarpsOfPixel - 1) / kWarpsOfPixel, kAhead = Base::kLanes / kOfWarp;
  static_assert(kAhead > 0 && (Base::kLanes % kOfWarp == 0 || Base::kLanes == 32));
  static_assert(kWarpsOfPixel == 1 || kPixelsOfWarp == 1);
  /// Places for staged splats: 32, and some behind them, which hold none, as the lanes of a sample look at kAhead at
  /// once.
  static constexpr int kPlaces = (32 + kAhead - 1) / kAhead * kAhead;
  __device__ static int first_sample() {
    const int of_warp = lane_id() % Base::kLanes / kAhead;
    return of_warp < kOfWarp ? int(threadIdx.x) / 32 % kWarpsOfPixel * kOfWarp + of_warp : F::kSamples;
  }
  /// This lane's place among those of its sample.
  __device__ static int ahead() { return lane_id() % kAhead; }
  __device__ static bool owns() { return ahead() == 0; }
  /// The lanes of this lane's sample, and the first of them.
  __device__ static uint32_t sharers() { return (kAllLanes >> (32 - kAhead)) << first_sharer(); }
  __device__ static int first_sharer() { return lane_id() / kAhead * kAhead; }
  /// The sum over the lanes of a pixel, in each of them. All threads must call it.
  __device__ static float sum_lanes(float x) {
    x = Base::sum_lanes(x);
    if constexpr (kWarpsOfPixel > 1) {
      __shared__ float of_warp[kWarpsOfPixel];
      __syncthreads();  // all have read the last sum
      if (lane_id() == 0) of_warp[threadIdx.x / 32] = x;
      __syncthreads();
      x = of_warp[0];
#pragma unroll
      for (int warp = 1; warp < kWarpsOfPixel; ++warp) x += of_warp[warp];
    }
    return x;
  }
  /// The largest x of these lanes. All lanes must call it.
  __device__ static int max_of_sharers(int x) {
#pragma unroll
    for (int offset = 1; offset < kAhead; offset *= 2)
      x = max(x, shuffle(x, first_sharer() + (ahead() + offset) % kAhead));
    return x;
  }
};

/// Where the bits of a pixel of a tile of kSide x kSide pixels are: that of pair k is bit k % 32 of word k / 32.
/// `first`: of the segments of the tile's list.
template <class F, int kSide> __device__ int64_t pixel_words(int first, const TileList& list, int pixel_number) {
  constexpr int kPixels = kSide * kSide, kSegment = moving_segment(F::kSamples, kSide);
  const int segments = (list.count + kSegment - 1) / kSegment;
  return (int64_t(first) * kPixels + pixel_number * segments) * (kSegment / 32);
}

/// The checkpoints of a lane's samples that blend has still to leave, of a list that is cut into segments of kSegment
/// pairs: one in front of each segment, and all within the first one. Those within the others are left by
/// segment_maps_kernel, which goes through them side by side, where here every sample would wait for them.
template <int kSegment> struct CheckpointsAhead {
  int pair;   ///< the next one is in front of this pair
  float* to;  ///< and there

  /// Leaves `samples` in those up to pair k.
  template <class Samples> __device__ void store_up_to(int k, const Samples& samples) {
#pragma unroll 1
    while (pair <= k) {
      samples.store(to);
      const int chunks = pair < kSegment ? 1 : kSegment / kStateChunk;
      pair += chunks * kStateChunk;
      to += chunks * Samples::kCheckpoint;
    }
  }
};

/// Places in the queues of a warp.
inline constexpr int kQueued = 1024;

/// For each pixel of a warp, the pairs that reach it, front to back: a queue, which is filled from the bits of
/// filter_kernel.
template <class Layout> struct PairQueues {
  using Bits = uint16_t;                                  ///< what a lane takes at a time
  static constexpr int kBits = 16;                        ///< of pairs that follow each other
  static constexpr int kAtOnce = kBits * Layout::kLanes;  ///< pairs of which a pixel's lanes take the bits at a time
  static constexpr uint32_t kRoom = 2 * kAtOnce;
  using Memory = int32_t[Layout::kPixels][kRoom];
  static_assert(sizeof(Memory) == kQueued * sizeof(int32_t));

  int32_t* pairs;               ///< of this lane's pixel
  const Bits* words;            ///< of this lane, from those that are read next on
  int lane;                     ///< among those of the pixel
  int count;                    ///< pairs of the list; 0 when no more are wanted
  int next = 0;                 ///< the pair whose bit is the first that the pixel's lanes take next
  uint32_t begin = 0, end = 0;  ///< of the pairs in the queue, counted from the first that was ever in it
  uint32_t bits;                ///< that this lane takes next

  /// `reach_words`: of the pixel. All lanes must call it.
  __device__ PairQueues(Memory& memory, const uint32_t* reach_words, int count)
      : pairs(memory[lane_id() / Layout::kLanes]), lane(lane_id() % Layout::kLanes), count(count) {
    words = reinterpret_cast<const Bits*>(reach_words) + lane;
    bits = has_bits() ? words[0] : 0u;
    fill();
  }
  /// Whether any of the pairs from `next` on are this lane's.
  __device__ bool has_bits() const { return next + kBits * lane < count; }
  /// Takes bits until more pairs than kAtOnce are queued, if there are so many. All lanes must call it.
  __device__ void fill() {
    __syncwarp();  // all have read what they took
    const auto wanted = [&] { return next < count && end - begin <= kRoom - kAtOnce; };
    for (bool wants; __any_sync(kAllLanes, wants = wanted());) {
      uint32_t mine = wants ? bits : 0;
      const int before = next + kBits * lane - 1;
      const int found = __popc(mine);
      int behind = found;  // of the pixel's lanes up to this one
#pragma unroll
      for (int offset = 1; offset < Layout::kLanes; offset *= 2) {
        const int of_lanes_before = shuffle_up(behind, offset);
        if (lane >= offset) behind += of_lanes_before;
      }
      uint32_t place = end + uint32_t(behind - found);
      for (; mine != 0; mine &= mine - 1) pairs[place++ % kRoom] = before + __ffs(int(mine));
      end += uint32_t(shuffle(behind, lane_id() | (Layout::kLanes - 1)));
      // The bits behind these are read straight into their place, so that nothing waits for them before they are taken.
      next += wants ? kAtOnce : 0;
      bits = wants ? 0 : bits;
      if (wants && has_bits()) bits = words[next / kBits];
    }
    __syncwarp();
  }
  /// How many there are for the lanes of the pixel, one each, and this lane's.
  __device__ int ready() const { return min(int(end - begin), Layout::kLanes); }
  __device__ int pair() const { return pairs[(begin + uint32_t(lane)) % kRoom]; }
  /// Drops the pairs of the pixel, and all that follow.
  __device__ void close() {
    count = 0;
    begin = end;
  }
};

/// The splats that each pixel of a warp is about to composite, and the queues that they come from.
template <class F, int C, int kPlaces> struct QueuedStage {
  TileSplat<F, C> splats[kPlaces];
  int32_t pairs[kPlaces];
  int32_t queues[kQueued];
};

/// Splats of a list on their way from memory into QueuedStage: the next ones of the pixel of this lane, which has one
/// of them.
template <class F, int C, class Layout> struct QueuedSplats {
  const Splat<F, float>* splats_in;
  const Channels<float>& channels_in;
  const TileList& list;
  int first_channel;
  int n = 0, next_n = 0;  ///< of the pixel: splats that are read, and those behind
  int pair, next_pair;
  int32_t next_id = 0;  ///< of any splat, where there is none behind
  Splat<F, float> splat;
  Values<C> channels;

  __device__ QueuedSplats(const BlendParams& params, const TileList& list, int first_channel)
      : splats_in(reinterpret_cast<const Splat<F, float>*>(params.splats)),
        channels_in(params.channels),
        list(list),
        first_channel(first_channel) {}

  /// Reads the splats that were next, and takes the pairs behind them from the queue.
  template <class Queues> __device__ void advance(Queues& queues) {
    n = next_n;
    pair = next_pair;
    // By all lanes, and so straight into the registers: the compiler would wait to copy what only some lanes read.
    splat = splats_in[next_id];
    channels = channels_of<C>(channels_in, splat, next_id, first_channel);
    take_next(queues);
  }
  template <class Queues> __device__ void take_next(Queues& queues) {
    next_n = queues.ready();
    if (queues.lane < next_n) {
      next_pair = queues.pair();
      next_id = list.splat(next_pair);
    }
    queues.begin += uint32_t(next_n);
  }
  /// Puts the splat that was read into the stage. `light`: what the steps before have left of it.
  ///
  /// Every listed splat has a level above 0, and no `x_given_y` is negative, so that the comparison is never true.
  /// Without it nothing would need these two, which are read together with numbers that are needed: the compiler would
  /// use their registers for something else, and for that wait until the splat has arrived. And without `light` it
  /// would compare, and wait, in front of the steps.
  template <class Stage> __device__ void put(Stage& stage, int lane, float light) const {
    if (lane >= n || splat.level + splat.shape.x_given_y <= min(light, 0.0f)) return;
    stage.splats[lane_id()] = {cell_terms(splat, list), channels};
    stage.pairs[lane_id()] = pair;
  }
};

/// Composites the staged splats of each pixel, `n` of this lane's, from first_staged on. Most splats that reach a pixel
/// do not show in a sample, since they are small: the lanes of a sample look at as many splats at once, and composite
/// the first that shows. Then those behind it are looked at again, since the node has moved. All lanes must call
/// it.
template <class F, class Layout, bool kKeep, class Stage, class Blend, class Checkpoints>
__device__ void blend_ahead(const Stage& stage, int first_staged, int n, Blend& blend, Checkpoints& checkpoints) {
  constexpr int kAhead = Layout::kAhead;
  constexpr bool kOnce = kAhead == Layout::kLanes;  // a sample has a lane for each of the staged splats
  const int own = lane_id(), first_lane = Layout::first_sharer();
  float& transmittance = blend.samples.transmittance[0];
  Vec2<float>& place = blend.samples.place[0];
  int taken = first_staged + Layout::ahead();  // this lane's, whether there is one or not
  int left = n;                                // splats from that of the sample's first lane on
  auto splat = stage.splats[taken];
  int pair = stage.pairs[taken];
  // Lanes of the sample with a splat, none behind which has been composited.
  const auto lanes_with_splats = [&] {
    const int count = min(left, kAhead);
    return transmittance > 0 && count > 0 ? kAllLanes >> (32 - count) << first_lane : 0u;
  };
  uint32_t live = lanes_with_splats();
  // Lanes with a pair in front of which there is a checkpoint to be left.
  const auto lanes_at_checkpoint = [&] { return kKeep ? __ballot_sync(kAllLanes, pair >= checkpoints.pair) : 0u; };
  uint32_t at_checkpoint = lanes_at_checkpoint();
  while (true) {
    const Vec2<float> z = blend.corners.node(splat.terms, 0, place);
    const float raw = exp2(F::log_alpha(splat.terms, z));
    const bool hit = (live >> own & 1) != 0 && raw >= float(kAlphaMin);
    const uint32_t all_hits = __ballot_sync(kAllLanes, hit), hits = all_hits & Layout::sharers();
    if (kOnce && all_hits == 0) break;
    const int first = __ffs(int(hits)) - 1;  // the lane whose splat is composited, if there is one
    float behind = transmittance;
    Vec2<float> moved = place;
    const Blended<float> b = blend_placed_sample<F>(splat.terms, z, raw, UnitCell<F::kSide>(), behind, moved);
    if (first == own) blend.add(b, splat.channels, pair);
    if (kKeep && (hits & -hits & at_checkpoint) != 0)
      checkpoints.store_up_to(stage.pairs[taken - own + first], blend.samples);
    behind = shuffle(behind, first);
    moved = {shuffle(moved.x, first), shuffle(moved.y, first)};
    if (hits != 0) {
      transmittance = behind;
      place = moved;
      live = behind > 0 ? live & (kAllLanes - 1) << first : 0;
    }
    if constexpr (!kOnce) {
      if (hits == 0 || live == 0) {
        taken += kAhead, left -= kAhead;
        live = lanes_with_splats();
        if (live != 0) {
          splat = stage.splats[taken];
          pair = stage.pairs[taken];
        }
      }
      if (!__any_sync(kAllLanes, live != 0)) break;
      at_checkpoint = lanes_at_checkpoint();
    }
  }
}

/// Blends the pixels of a warp by looking ahead, as Layout shares them out; C channels from `first` on.
/// `first_segment`: of the list.
template <class F, int C, class Layout, bool kKeep, int kSegment, class Stage>
__device__ void blend_queued(const BlendParams& params, int first, int tile, const TileList& list, int first_segment,
                             Stage& stage) {
  constexpr int kLanes = Layout::kLanes;
  const StatePlaces places(params.lists, list, params.grid, tile);
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  MovingBlend<F, C, Layout, kKeep, true> blend(p, pixel.inside);
  CheckpointsAhead<kSegment> checkpoints = {kStateChunk, params.checkpoints + places.first * blend.samples.kCheckpoint};
  using Queues = PairQueues<Layout>;
  const int64_t words = pixel_words<F, Layout::kSide>(first_segment, list, Layout::pixel_number());
  Queues queues(reinterpret_cast<typename Queues::Memory&>(stage.queues), params.reach_words + words,
                pixel.inside ? list.count : 0);
  // While splats are composited, those behind them are read, and before that which ones these are.
  QueuedSplats<F, C, Layout> next(params, list, first);
  next.take_next(queues);
  queues.fill();
  if (list.count > 0) next.advance(queues);  // of an empty scene there is no splat that all lanes could read
  const int first_staged = lane_id() / kLanes * kLanes;
  const uint32_t lanes_of_pixel = (kAllLanes >> (32 - kLanes)) << (lane_id() / kLanes * kLanes);
  while (__any_sync(kAllLanes, next.n > 0)) {
    next.put(stage, queues.lane, blend.samples.transmittance[0]);
    const int n = next.n;
    queues.fill();
    next.advance(queues);
    __syncwarp();
    blend_ahead<F, Layout, kKeep>(stage, first_staged, n, blend, checkpoints);
    if (!(__ballot_sync(kAllLanes, blend.samples.open()) & lanes_of_pixel)) {
      queues.close();
      next.n = next.next_n = 0;
    }
    __syncwarp();  // all have read the splats
  }
  if constexpr (kKeep) blend.last[0] = Layout::max_of_sharers(blend.last[0]);
  blend.write(params, first, pixel);
}

}  // namespace ar::cuda
