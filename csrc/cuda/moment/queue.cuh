// listed_blend composites a pixel from a queue of the splats that reach it, by the bits of filter, without waiting for
// those of neighbours. Lanes that share a sample test several queued splats at once. For the longest lists a block has
// one pixel.
#pragma once

#include "cuda/moment/cells.cuh"

namespace ar::cuda {

/// kWarpsOfPixel warps have different samples of one pixel. kAhead neighbouring lanes have the same sample.
template <class F, int kSide, int kPixelsOfWarp, int kWarpsOfPixel = 1>
struct AheadLayout : CellLayout<1, 32 / kPixelsOfWarp, kSide, kWarpsOfPixel, false, kWarpsOfPixel> {
  using Base = CellLayout<1, 32 / kPixelsOfWarp, kSide, kWarpsOfPixel, false, kWarpsOfPixel>;
  /// Samples of a pixel in a warp.
  static constexpr int kOfWarp = F::kSamples / kWarpsOfPixel, kAhead = Base::kLanes / kOfWarp;
  static_assert(kOfWarp * kWarpsOfPixel == F::kSamples && kOfWarp * kAhead == Base::kLanes);
  static_assert(kWarpsOfPixel == 1 || kPixelsOfWarp == 1);
  __device__ static int first_sample() {
    return int(threadIdx.x) / 32 % kWarpsOfPixel * kOfWarp + lane_id() % Base::kLanes / kAhead;
  }
  __device__ static int ahead() { return lane_id() % kAhead; }
  __device__ static bool owns() { return ahead() == 0; }
  __device__ static uint32_t sharers() { return (kAllLanes >> (32 - kAhead)) << first_sharer(); }
  __device__ static int first_sharer() { return lane_id() / kAhead * kAhead; }
  /// All threads must call it.
  __device__ static float sum_lanes(float x) {
    x = Base::sum_lanes(x);
    if constexpr (kWarpsOfPixel > 1) {
      __shared__ float of_warp[kWarpsOfPixel];
      __syncthreads();
      if (lane_id() == 0) of_warp[threadIdx.x / 32] = x;
      __syncthreads();
      x = of_warp[0];
      AR_UNROLL for (int warp = 1; warp < kWarpsOfPixel; ++warp) x += of_warp[warp];
    }
    return x;
  }
  /// Over sharers().
  __device__ static int max_of_sharers(int x) {
    AR_UNROLL for (int offset = 1; offset < kAhead; offset *= 2) x =
        max(x, shuffle(x, first_sharer() + (ahead() + offset) % kAhead));
    return x;
  }
};

/// Index in reach_words of the words of a pixel: bit k % 32 of word k / 32 is of pair k. `first`: the list's first
/// segment.
template <class F, int kSide> __device__ int64_t pixel_words(int first, const TileList& list, int pixel_number) {
  constexpr int kPixels = kSide * kSide, kSegment = moving_segment(F::kSamples, kSide);
  const int segments = (list.count + kSegment - 1) / kSegment;
  return (int64_t(first) * kPixels + pixel_number * segments) * (kSegment / 32);
}

/// Checkpoints that listed_blend stores: all in the first segment, and one before each other.
template <int kSegment> struct CheckpointsAhead {
  int pair;  ///< after the next checkpoint
  float* to;

  template <class Samples> __device__ void store_up_to(int k, const Samples& samples) {
    AR_NO_UNROLL while (pair <= k) {
      samples.store(to);
      const int chunks = pair < kSegment ? 1 : kSegment / kStateChunk;
      pair += chunks * kStateChunk;
      to += chunks * Samples::kCheckpoint;
    }
  }
};

/// For each pixel of a warp the pairs that reach it.
template <class Layout> struct PairQueues {
  using Bits = uint16_t;
  static constexpr int kBits = 16;                        ///< that a lane reads at once
  static constexpr int kAtOnce = kBits * Layout::kLanes;  ///< by the lanes of a pixel
  static constexpr uint32_t kRoom = 2 * kAtOnce;
  using Memory = int32_t[Layout::kPixels][kRoom];
  static_assert(sizeof(Memory) == MomentPolicy::kQueued * sizeof(int32_t));

  int32_t* pairs;  ///< [kRoom] of the pixel
  const Bits* words;
  int lane;                     ///< of the pixel
  int count;                    ///< of the list
  int next = 0;                 ///< pair whose bit is read next
  uint32_t begin = 0, end = 0;  ///< of the queue, modulo kRoom
  uint32_t bits;                ///< read, not queued

  /// `reach_words`: of this lane's pixel.
  __device__ PairQueues(Memory& memory, const uint32_t* reach_words, int count)
      : pairs(memory[lane_id() / Layout::kLanes]), lane(lane_id() % Layout::kLanes), count(count) {
    words = reinterpret_cast<const Bits*>(reach_words) + lane;
    bits = has_bits() ? words[0] : 0u;
    fill();
  }
  __device__ bool has_bits() const { return next + kBits * lane < count; }
  /// Until more than kAtOnce pairs are queued, or the list ends.
  __device__ void fill() {
    __syncwarp();
    const auto wanted = [&] { return next < count && end - begin <= kRoom - kAtOnce; };
    for (bool wants; __any_sync(kAllLanes, wants = wanted());) {
      uint32_t mine = wants ? bits : 0;
      const int before = next + kBits * lane - 1;
      const int found = __popc(mine);
      int up_to = found;
      AR_UNROLL for (int offset = 1; offset < Layout::kLanes; offset *= 2) {
        const int of_lanes_before = shuffle_up(up_to, offset);
        if (lane >= offset) up_to += of_lanes_before;
      }
      uint32_t to = end + uint32_t(up_to - found);
      for (; mine != 0; mine &= mine - 1) pairs[to++ % kRoom] = before + __ffs(int(mine));
      end += uint32_t(shuffle(up_to, lane_id() | (Layout::kLanes - 1)));
      // Into their register: nothing waits for them yet.
      next += wants ? kAtOnce : 0;
      bits = wants ? 0 : bits;
      if (wants && has_bits()) bits = words[next / kBits];
    }
    __syncwarp();
  }
};

template <class F, int C> struct QueuedStage {
  TileSplat<F, C> splats[32];
  int32_t pairs[32];
  int32_t queues[MomentPolicy::kQueued];
};

/// The next splats of a pixel, one in each lane, on their way to QueuedStage.
template <class F, int C, class Layout> struct QueuedSplats {
  const float* splats_in;
  const Channels<float>& channels_in;
  const TileList& list;
  int first_channel;
  int n = 0, next_n = 0;  ///< splats of the pixel: read, claimed
  int pair, next_pair;
  int32_t next_id = 0;  ///< of any splat, if none is next
  Splat<F, float> splat;
  Values<C> channels;

  __device__ QueuedSplats(const BlendParams& params, const TileList& list, int first_channel)
      : splats_in(params.splats), channels_in(params.channels), list(list), first_channel(first_channel) {}

  template <class Queues> __device__ void advance(Queues& queues) {
    n = next_n;
    pair = next_pair;
    // By all lanes: the compiler would wait to copy what only some read.
    splat = load_splat<F>(splats_in, next_id);
    channels = channels_of<C>(channels_in, splat, next_id, first_channel);
    take_next(queues);
  }
  template <class Queues> __device__ void take_next(Queues& queues) {
    next_n = min(int(queues.end - queues.begin), Layout::kLanes);
    if (queues.lane < next_n) {
      next_pair = queues.pairs[(queues.begin + uint32_t(queues.lane)) % Queues::kRoom];
      next_id = list.splat(next_pair);
    }
    queues.begin += uint32_t(next_n);
  }
  ///
  /// The comparison is never true: level > 0, and x_given_y >= 0. It keeps these registers in use until the splat
  /// arrives; by `light` it comes after the steps.
  template <class Stage> __device__ void put(Stage& stage, int lane, float light) const {
    if (lane >= n || splat.level + splat.shape.x_given_y <= min(light, 0.0f)) return;
    stage.splats[lane_id()] = {cell_terms(splat, list), channels};
    stage.pairs[lane_id()] = pair;
  }
};

/// Composites n staged splats of this lane's pixel, from first_staged on. The lanes of a sample test kAhead at once and
/// composite the first that shows; as this moves the node, they test later ones again.
template <class F, class Layout, bool kKeep, class Stage, class Blend, class Checkpoints>
__device__ void blend_ahead(const Stage& stage, int first_staged, int n, Blend& blend, Checkpoints& checkpoints) {
  constexpr int kAhead = Layout::kAhead;
  constexpr bool kOnce = kAhead == Layout::kLanes;  // a lane for each staged splat
  const int own = lane_id(), first_lane = Layout::first_sharer();
  float& transmittance = blend.samples.transmittance[0];
  Vec2<float>& position = blend.samples.position[0];
  int own_splat = first_staged + Layout::ahead();  // the splat of this lane
  int left = n;                                    // splats from that of first_lane on
  auto splat = stage.splats[own_splat];
  int pair = stage.pairs[own_splat];
  // Lanes of the sample with a splat that may show.
  const auto lanes_with_splats = [&] {
    const int count = min(left, kAhead);
    return transmittance > 0 && count > 0 ? kAllLanes >> (32 - count) << first_lane : 0u;
  };
  uint32_t live = lanes_with_splats();
  // Lanes whose pair has an earlier checkpoint to store.
  const auto lanes_at_checkpoint = [&] { return kKeep ? __ballot_sync(kAllLanes, pair >= checkpoints.pair) : 0u; };
  uint32_t at_checkpoint = lanes_at_checkpoint();
  while (true) {
    const auto [z, raw] = blend.corners.see(splat.terms, 0, position);
    const bool hit = (live >> own & 1) != 0 && raw >= float(kAlphaMin);
    const uint32_t all_hits = __ballot_sync(kAllLanes, hit), hits = all_hits & Layout::sharers();
    if (kOnce && all_hits == 0) break;
    const int first = __ffs(int(hits)) - 1;  // the lane whose splat is composited, or -1
    float left_over = transmittance;
    Vec2<float> moved = position;
    const Blended<float> b = blend_placed_sample<F>(splat.terms, z, raw, UnitCell<F::kSide>(), left_over, moved);
    if (first == own) {
      if (b.mask) blend.sums.add(b.if_shown, splat.channels);
      if (kKeep) blend.last[0] = b.mask ? pair + 1 : blend.last[0];
    }
    if (kKeep && (hits & -hits & at_checkpoint) != 0)
      checkpoints.store_up_to(stage.pairs[own_splat - own + first], blend.samples);
    left_over = shuffle(left_over, first);
    moved = {shuffle(moved.x, first), shuffle(moved.y, first)};
    if (hits != 0) {
      transmittance = left_over;
      position = moved;
      live = left_over > 0 ? live & (kAllLanes - 1) << first : 0;
    }
    if constexpr (!kOnce) {
      if (hits == 0 || live == 0) {
        own_splat += kAhead, left -= kAhead;
        live = lanes_with_splats();
        if (live != 0) {
          splat = stage.splats[own_splat];
          pair = stage.pairs[own_splat];
        }
      }
      if (!__any_sync(kAllLanes, live != 0)) break;
      at_checkpoint = lanes_at_checkpoint();
    }
  }
}

/// Writes the channels [first, first + C).
template <class F, int C, class Layout, bool kKeep, int kSegment, class Stage>
__device__ void blend_queued(const BlendParams& params, int first, const CutList& cut, const TileList& list,
                             Stage& stage) {
  constexpr int kLanes = Layout::kLanes;
  const TileCheckpoints stored(params.lists, list, params.grid, cut.tile);
  MovingBlend<F, C, Layout, kKeep, true> blend(list, params.grid);
  CheckpointsAhead<kSegment> checkpoints = {kStateChunk, params.checkpoints + stored.first * blend.samples.kCheckpoint};
  using Queues = PairQueues<Layout>;
  const int64_t words = pixel_words<F, Layout::kSide>(cut.first, list, Layout::pixel_number());
  Queues queues(reinterpret_cast<typename Queues::Memory&>(stage.queues), params.reach_words + words,
                blend.pixel.inside ? list.count : 0);
  // While splats are composited, the next are read.
  QueuedSplats<F, C, Layout> next(params, list, first);
  next.take_next(queues);
  queues.fill();
  if (list.count > 0) next.advance(queues);  // else there may be no splat to read
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
      queues.count = 0, queues.begin = queues.end;
      next.n = next.next_n = 0;
    }
    __syncwarp();
  }
  if constexpr (kKeep) blend.last[0] = Layout::max_of_sharers(blend.last[0]);
  blend.write(params, first);
}

}  // namespace ar::cuda
