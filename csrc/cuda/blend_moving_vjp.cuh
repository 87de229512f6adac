// Kernel of blend_vjp for footprints whose samples move: a block per tile, a lane per few cells of a pixel, back to
// front. Lists that are cut have the kernel of blend_moving_segments.cuh.
//
// The state of a sample in front of a splat cannot be had from the state behind it, since the displacement depends on
// itself through alpha. So a warp composites each chunk of 32 splats once more, from the checkpoint that blend has left
// in front of it, keeps where the samples were in front of each splat, and then walks back over those that its pixels
// show.
//
// dL/dalpha is linear in the gradient of the image: of many channels each kernel adds the share of its own to the six
// sums of a pair, which a single block owns. Only MeanSums need all channels at once: where they are wanted, the first
// kernel makes all sums, and reads the channels of the others where they lie.
#pragma once

#include <algorithm>

#include "cuda/blend_moving_grads.cuh"
#include "cuda/blend_moving_sums.cuh"
#include "cuda/launch.cuh"

namespace ar::cuda {

/// Blocks that an SM should hold: bounds the registers, as waiting for the samples in front costs more than a few
/// numbers in memory. With more than two cells of a lane in whole lists fewer, since the caches do not hold the places
/// of all those.
template <class F, int C, class Layout, int kSegment>
inline constexpr int kMovingVjpBlocks = std::max(1, (C > 3                                 ? 512
                                                     : Layout::kCells > 2 && kSegment == 0 ? 768
                                                                                           : 1024) /
                                                        Layout::kThreads);

/// Where a lane's samples are in front of each splat of a chunk that reaches its warp. Those in front of the first few
/// splats are in shared memory, as many as there is room for. The others, if there are any, are in local memory, of
/// which the caches hold a part only: a thousand lanes on an SM have half a KiB of places each.
template <class Layout> class PlacesInFront {
  static constexpr int kCells = Layout::kCells, kTogether = kCells % 2 == 0 ? 2 : 1;
  struct alignas(kTogether * sizeof(Vec2<float>)) Together {
    Vec2<float> of[kTogether];
  };
  using OfWarp = Together[kCells / kTogether][32];

 public:
  using Places = Vec2<float>[kCells];
  /// Bytes of shared memory that a block needs for each splat.
  static constexpr size_t kBytes = Layout::kWarps * sizeof(OfWarp);
  /// The number of splats whose places are in shared memory has to be a multiple of this one.
  static constexpr int kUnit = kListAhead<Layout>;
  /// More than these few would take more from the cache than they save.
  static constexpr int kMost = 8;

  /// The shared memory from byte `begin` on is for the places in front of so many splats.
  __device__ PlacesInFront(size_t begin, int splats)
      : begin_(int(begin) + int(threadIdx.x) / 32 * splats * int(sizeof(OfWarp))), in_shared_(splats) {}

  __device__ int in_shared() const { return in_shared_; }
  /// For the splats that leave room for so many blocks on an SM, each with `bytes` of shared memory besides.
  static int in_shared_of_blocks(int blocks, size_t bytes) {
    const size_t room = shared_bytes_of_blocks(blocks), splats = room > bytes ? (room - bytes) / kBytes : 0;
    return int(std::min<size_t>(splats, kMost)) / kUnit * kUnit;
  }

  /// In front of splat n of the list; kShared: n < in_shared().
  template <bool kShared> __device__ void put(int n, const Places& places) {
#pragma unroll
    for (int i = 0; i < kCells; i += kTogether) {
      Together together;
#pragma unroll
      for (int j = 0; j < kTogether; ++j) together.of[j] = places[i + j];
      if constexpr (kShared) {
        shared()[n][i / kTogether][lane_id()] = together;
      } else {
        local_[n][i / kTogether] = together;
      }
    }
  }
  __device__ void get(int n, Places& places) const {
    if (n < in_shared_) {
      take([&](int i) { return shared()[n][i][lane_id()]; }, places);
    } else {
      take([&](int i) { return local_[n][i]; }, places);
    }
  }

 private:
  /// Not a pointer that is kept: the compiler has to see that it is one to shared memory.
  __device__ OfWarp* shared() const {
    return reinterpret_cast<OfWarp*>(reinterpret_cast<char*>(dynamic_shared()) + begin_);
  }
  template <class From> __device__ static void take(From&& from, Places& places) {
#pragma unroll
    for (int i = 0; i < kCells; i += kTogether) {
      const Together together = from(i / kTogether);
#pragma unroll
      for (int j = 0; j < kTogether; ++j) places[i + j] = together.of[j];
    }
  }

  int begin_, in_shared_;
  Together local_[kStateChunk][kCells / kTogether];
};

/// Composites those of the staged splats [from, from + 32) that reach the warp, and lists them; `k0`: the pair that is
/// staged first. Puts the places of the samples in front of each into `in_front`, unless that is null, and returns
/// which of them a sample of the warp shows. `last`: of LastSplats.
template <class F, class Layout, class Stage, class Samples, class InFront>
__device__ uint32_t replay_chunk(Stage& stage, int from, int k0, const CellCorners<F, Layout>& corners,
                                 const int (&last)[Layout::kCells], Samples& samples, InFront in_front) {
  constexpr bool kKeeps = !std::is_null_pointer_v<InFront>;
  __syncwarp();  // all have read the last list
  const int listed = stage.lists.list(stage.reach, from, from + kStateChunk, Layout::own_bit());
  uint32_t shown = 0;
  int n = 0;
  const auto composite = [&](uint32_t entry, auto is_shared) {
    const auto& terms = Stage::Lists::splat_of(stage.splats, entry).terms;
    if constexpr (kKeeps) in_front->template put<decltype(is_shared)::value>(n, samples.place);
    bool any = false;
#pragma unroll
    for (int i = 0; i < Layout::kCells; ++i) {
      const Vec2<float> z = corners.node(terms, i, samples.place[i]);
      any |= replay_placed_sample<F>(terms, z, exp2(F::log_alpha(terms, z)), k0 + int(entry) < last[i],
                                     UnitCell<F::kSide>(), samples.transmittance[i], samples.place[i]);
    }
    if (any) shown |= 1u << n;
    ++n;
  };
  int in_shared = listed;
  if constexpr (kKeeps) in_shared = min(in_shared, in_front->in_shared());
  stage.lists.for_each(0, in_shared, [&](uint32_t entry) { composite(entry, std::true_type()); });
  if constexpr (kKeeps)
    stage.lists.for_each(in_shared, listed, [&](uint32_t entry) { composite(entry, std::false_type()); });
  return warp_or(shown);
}

/// Takes a lane's samples, and what they carry, from behind pair j of the batch that begins with pair k0 to its front,
/// where they are at `places`, and sums over them; of_splat.sums as they are before F::collect. `g_color`: the colour
/// of its splat times the gradient.
template <class F, int C, class Layout, class Samples>
__device__ MovingBlendGrad<float> walk_back(TileSplatRef<F, C>& splat, int k0, int j, float g_color,
                                            const CellCorners<F, Layout>& corners, const int (&last)[Layout::kCells],
                                            const Vec2<float> (&places)[Layout::kCells], Samples& samples,
                                            Adjoint (&adjoint)[Layout::kCells]) {
  MovingBlendGrad<float> sums = no_moving_blend_grad<float>();
#pragma unroll
  for (int i = 0; i < Layout::kCells; ++i) {
    const Vec2<float> z = corners.node(splat.terms, i, places[i]);
    const float raw = exp2(F::log_alpha(splat.terms, z));
    const bool composited = raw >= float(kAlphaMin) && k0 + j < last[i];
    add_placed_sample_vjp<F>(splat.terms, z, composited ? raw : 0.0f, UnitCell<F::kSide>(), g_color, places[i],
                             samples.transmittance[i], adjoint[i].behind, adjoint[i].dL_dplace, sums);
  }
  return sums;
}

/// Takes a warp's samples from behind the chunk of 32 pairs that begins at the staged one `from` to its front, and
/// leaves in `sums` those of its splats that replay_chunk() has `shown`. `k0`: the pair that is staged first. Returns
/// which pairs of the chunk have sums. All lanes must call it.
template <class F, int C, class Layout, class Shared, class Samples>
__device__ uint32_t chunk_vjp(const BlendVjpParams& params, Shared& shared, float (*sums)[Shared::kSums],
                              const TileList& list, int k0, int from, uint32_t shown, const Pixel& pixel,
                              const CellCorners<F, Layout>& corners, const int (&last)[Layout::kCells],
                              const SampleGrad<F, C>& grad, const PlacesInFront<Layout>& in_front, bool with_means,
                              Samples& samples, Adjoint (&adjoint)[Layout::kCells]) {
  const auto& listed = shared.stage.lists.of_warps[threadIdx.x / 32];
  const int own_sum = sum_of_lane<C>();
  for (uint32_t mask = shown; mask != 0;) {
    const int n = 31 - __clz(mask), j = int(listed[n]);
    mask ^= 1u << n;
    TileSplatRef<F, C> splat = shared.stage.splats[j];
    const float g_color = grad.times(splat.channels, params, pixel, [&] { return list.splat(k0 + j); });
    Vec2<float> places_in_front[Layout::kCells];
    in_front.get(n, places_in_front);
    const auto [contribution, of_splat] =
        walk_back<F, C, Layout>(splat, k0, j, g_color, corners, last, places_in_front, samples, adjoint);
    if (with_means) put_warp_means<Layout>(params, shared.mean_maps[j], of_splat.sums.offset, sums[j] + Shared::kMeans);
    const PairGrad<float> of_pair = {F::collect(splat.terms, of_splat.sums, of_splat.weighted), of_splat.weighted};
    put_warp_sums(of_pair, times(contribution, grad.channels), sums[j] + own_sum);
  }
  return warp_or(shown >> lane_id() & 1 ? 1u << (listed[lane_id()] - from) : 0u);
}

/// A block per tile whose list is not cut. `in_shared`: of PlacesInFront, whose memory is that behind Shared.
template <class F, int C, class Layout>
__global__ void __launch_bounds__(Layout::kThreads, kMovingVjpBlocks<F, C, Layout, 0>)
    moving_vjp_kernel(const BlendVjpParams params, int first, int in_shared) {
  wait_for_earlier_kernels();
  using Shared = MovingVjpShared<F, C, Layout>;
  using Samples = MovingSamples<F, Layout>;
  constexpr int S = F::kSamples, kCells = Layout::kCells, kBatch = Shared::kBatch;
  constexpr bool kMany = C > kFewChannels;  // `first` may be above 0, and there may be more channels than C
  static_assert(Layout::kBlocks == 1);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  const int tile = listed_tile<S>(params, params.plan->counts.segments + int(blockIdx.x));
  if (tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  const StatePlaces places(params.lists, list, params.grid, tile);
  const auto* splats = reinterpret_cast<const Splat<F, float>*>(params.splats);
  const int lane = lane_id(), warp = threadIdx.x / 32, channel_count = params.channels.count;
  const bool with_means = params.mean_sums != MeanSums::kNone;
  const bool all_at_once = kMany && with_means && channel_count > C;
  const bool with_shape = !all_at_once || first == 0;
  const Vec2<float> p = Layout::pixel();
  const Pixel pixel(list, params.grid, p);
  const CellCorners<F, Layout> corners(p);
  Samples samples(pixel.inside);

  const LastSplats<F, Layout> lasts(params.last, pixel, shared.last);
  const int (&last)[kCells] = lasts.samples;
  if (first % kChannelGroup == 0 && !list.of_patch) {  // pairs that nothing reached
    for (int k = lasts.block + threadIdx.x / kClearThreads; k < list.count; k += Layout::kThreads / kClearThreads)
      clear_pair_together<kChannelGroup>(params, list.slot(k), first == 0);
  }

  const SampleGrad<F, C> grad(params, pixel, first);
  Adjoint adjoint[kCells];
#pragma unroll
  for (int i = 0; i < kCells; ++i) adjoint[i] = {grad.through, {0, 0}};

  PlacesInFront<Layout> in_front(sizeof(Shared), in_shared);
  const auto replay = [&](int from, int k0, auto keep_in) {  // pair k0 is staged first
    return replay_chunk<F, Layout>(shared.stage, from, k0, corners, last, samples, keep_in);
  };

  const int stop = lasts.block;
  int k0 = (stop - 1) / kBatch * kBatch;
  int32_t id = shared.stage.splat_of(list, k0, stop);
  for (int k1 = stop; k1 > 0; k1 = k0, k0 -= kBatch) {
    const int count = k1 - k0;
    if (places.spacing > kStateChunk) {  // with too many pairs: from the checkpoint to the batch
      const int checkpoint = k0 / places.spacing;
      int k = checkpoint * places.spacing;
      samples.load(params.checkpoints + (places.first + checkpoint - 1) * Samples::kCheckpoint, k, last);
      for (; k < k0; k += kBatch) {
        __syncthreads();
        shared.stage.load(splats, params.channels, first, list, shared.stage.splat_of(list, k, k0));
        __syncthreads();
        for (int from = 0; from < kBatch; from += kStateChunk) replay(from, k, nullptr);
      }
    }
    const int32_t next_id = k0 > 0 ? shared.stage.splat_of(list, k0 - kBatch, k0) : -1;
    __syncthreads();  // all have read what the last batch left
    shared.load(splats, params, first, list, k0, id, with_means);
    __syncthreads();
    if (next_id >= 0) prefetch(splats + next_id);  // so that the next batch need not wait for memory
    id = next_id;
    const Samples at_batch = samples;
    for (int from = (Shared::kChunks - 1) * kStateChunk; from >= 0; from -= kStateChunk) {
      uint32_t shown = 0;
      if (k0 + from < lasts.warp) {
        if (places.spacing > kStateChunk) {
          samples = at_batch;
          for (int ahead = 0; ahead < from; ahead += kStateChunk) replay(ahead, k0, nullptr);
        } else {
          const int64_t number = places.of_chunk_at(k0 + from);
          samples.load(params.checkpoints + number * Samples::kCheckpoint, k0 + from, last);
        }
        shown = replay(from, k0, &in_front);
      }
      const uint32_t hits =
          chunk_vjp<F, C, Layout>(params, shared, shared.sums[warp], list, k0, from, shown, pixel, corners, last, grad,
                                  in_front, with_means && with_shape, samples, adjoint);
      if (lane == 0) shared.hits[warp][from / kStateChunk] = hits;
    }
    __syncthreads();
    write_pairs<C, Layout::kThreads>(params, first, with_means, with_shape, list, shared.rows, count,
                                     [&](int j, int v) { return shared.total(j, v); });
  }
}

/// Launches moving_vjp_kernel with as much of PlacesInFront in shared memory as leaves room for kMovingVjpBlocks on an
/// SM.
template <class F, int C, class Layout>
void launch_moving_vjp_kernel(const BlendVjpParams& p, unsigned blocks, int first, cudaStream_t stream) {
  constexpr size_t kShared = sizeof(MovingVjpShared<F, C, Layout>);
  const int in_shared = PlacesInFront<Layout>::in_shared_of_blocks(kMovingVjpBlocks<F, C, Layout, 0>, kShared);
  const LaunchShape shape = {blocks, Layout::kThreads, kShared + in_shared * PlacesInFront<Layout>::kBytes};
  launch(moving_vjp_kernel<F, C, Layout>, shape, stream, p, first, in_shared);
}

}  // namespace ar::cuda
