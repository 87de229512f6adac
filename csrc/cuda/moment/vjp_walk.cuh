// Kernel moving_vjp: the backward pass for lists that are not cut. The state before a splat does not follow from that
// after it: a warp composites each chunk of 32 splats again from the checkpoint before it, stores positions, and walks
// back over splats that its pixels show.
#pragma once

#include <algorithm>

#include "cuda/launch.cuh"
#include "cuda/moment/maps.cuh"
#include "cuda/moment/vjp_sums.cuh"

namespace ar::cuda {

/// Resident blocks of moving_vjp_kernel or, with kSegments, segment_vjp_kernel.
template <int C, class Layout, bool kSegments>
inline constexpr int kMovingVjpBlocks = blocks_per_sm(
    std::max(MomentPolicy::vjp_threads(C, Layout::kCells, kSegments) / Layout::kThreads, 1), Layout::kThreads);

/// Before each splat of a chunk that reaches the warp: the first in_shared in shared memory, others in local memory.
template <class Layout> struct EarlierPositions {
  static constexpr int kCells = Layout::kCells, kTogether = kCells % 2 == 0 ? 2 : 1;
  struct alignas(kTogether * sizeof(Vec2<float>)) Together {
    Vec2<float> of[kTogether];
  };
  using OfWarp = Together[kCells / kTogether][32];
  using Positions = Vec2<float>[kCells];
  /// Of shared memory, for each splat of a block.
  static constexpr size_t kBytes = Layout::kWarps * sizeof(OfWarp);
  /// in_shared is a multiple of it.
  static constexpr int kUnit = kListAhead<Layout>;

  int begin, in_shared;
  Together local[kStateChunk][kCells / kTogether];

  /// From byte `begin` of shared memory on.
  __device__ EarlierPositions(size_t begin, int splats)
      : begin(int(begin) + int(threadIdx.x) / 32 * splats * int(sizeof(OfWarp))), in_shared(splats) {}
  /// The compiler has to see that this is shared memory.
  __device__ OfWarp* shared() const {
    return reinterpret_cast<OfWarp*>(reinterpret_cast<char*>(dynamic_shared()) + begin);
  }
  /// kShared: n < in_shared.
  template <bool kShared> __device__ void put(int n, const Positions& positions) {
    AR_UNROLL for (int i = 0; i < kCells; i += kTogether) {
      Together together;
      AR_UNROLL for (int j = 0; j < kTogether; ++j) together.of[j] = positions[i + j];
      (kShared ? shared()[n][i / kTogether][lane_id()] : local[n][i / kTogether]) = together;
    }
  }
  __device__ void get(int n, Positions& positions) const {
    const bool is_shared = n < in_shared;
    AR_UNROLL for (int i = 0; i < kCells; i += kTogether) {
      Together together;
      if (is_shared) together = shared()[n][i / kTogether][lane_id()];
      if (!is_shared) together = local[n][i / kTogether];
      AR_UNROLL for (int j = 0; j < kTogether; ++j) positions[i + j] = together.of[j];
    }
  }
};

/// Composites the staged splats [from, from + 32); pair k0 is staged first. Returns which listed splats any sample
/// shows.
template <class Stage, class F, int C, class Layout, bool kTogether, class Earlier>
__device__ uint32_t replay_chunk(Stage& stage, int from, int k0, VjpLane<F, C, Layout, kTogether>& lane,
                                 Earlier earlier) {
  constexpr bool kKeeps = !std::is_null_pointer_v<Earlier>;
  auto& samples = lane.samples;
  __syncwarp();  // all have read the last list
  const int listed = stage.lists.list(stage.reach, from, from + kStateChunk, Layout::own_bit());
  uint32_t shown = 0;
  int n = 0;
  const auto composite = [&](uint32_t entry, auto is_shared) {
    const auto& terms = Stage::Lists::splat_of(stage.splats, entry).terms;
    if constexpr (kKeeps) earlier->template put<decltype(is_shared)::value>(n, samples.position);
    bool any = false;
    AR_UNROLL for (int i = 0; i < Layout::kCells; ++i) {
      const auto [z, raw] = lane.corners.see(terms, i, samples.position[i]);
      any |= replay_placed_sample<F>(terms, z, raw, k0 + int(entry) < lane.last.samples[i], UnitCell<F::kSide>(),
                                     samples.transmittance[i], samples.position[i]);
    }
    if (any) shown |= 1u << n;
    ++n;
  };
  int in_shared = listed;
  if constexpr (kKeeps) in_shared = min(in_shared, earlier->in_shared);
  stage.lists.for_each(0, in_shared, [&](uint32_t entry) { composite(entry, std::true_type()); });
  if constexpr (kKeeps)
    stage.lists.for_each(in_shared, listed, [&](uint32_t entry) { composite(entry, std::false_type()); });
  return warp_or(shown);
}

/// Takes a group back through the batch from pair k0 on. load(from) brings the samples to before staged splat `from`.
template <class F, int C, class Layout, bool kTogether, class Shared, class Load>
__device__ void batch_vjp(const BlendVjpParams& params, Shared& shared, int group, typename Shared::SumsOfGroup& sums,
                          const TileList& list, int k0, bool with_means, VjpLane<F, C, Layout, kTogether>& lane,
                          EarlierPositions<Layout>& earlier, Load&& load) {
  for (int from = (Shared::kChunks - 1) * kStateChunk; from >= 0; from -= kStateChunk) {
    uint32_t shown = 0;
    if (k0 + from < lane.last.warp) {
      load(from);
      shown = replay_chunk(shared.stage, from, k0, lane, &earlier);
    }
    const auto& listed = shared.stage.lists.of_warps[threadIdx.x / 32];
    const int own_sum = sum_of_lane<C>();
    for (uint32_t mask = shown; mask != 0;) {
      const int n = 31 - __clz(mask), j = int(listed[n]);
      mask ^= 1u << n;
      TileSplatRef<F, C> splat = shared.stage.splats[j];
      const float g_color = lane.grad.times(splat.channels, params, lane.pixel, [&] { return list.splat(k0 + j); });
      Vec2<float> positions[Layout::kCells];
      earlier.get(n, positions);
      MovingBlendGrad<float> of_cells = no_moving_blend_grad<float>();
      AR_UNROLL for (int i = 0; i < Layout::kCells; ++i) {
        const auto [z, raw] = lane.corners.see(splat.terms, i, positions[i]);
        const bool composited = raw >= float(kAlphaMin) && k0 + j < lane.last.samples[i];
        add_placed_sample_vjp<F>(splat.terms, z, composited ? raw : 0.0f, UnitCell<F::kSide>(), g_color, positions[i],
                                 lane.samples.transmittance[i], lane.adjoint[i].later, lane.adjoint[i].dL_dposition,
                                 of_cells);
      }
      const auto& [contribution, of_splat] = of_cells;
      if (with_means)
        put_warp_means<Layout>(params, shared.mean_maps[j], of_splat.sums.offset, sums[j] + Shared::kMeans);
      const PairGrad<float> of_pair = {of_splat.sums, of_splat.weighted};
      put_warp_sums(of_pair, times(contribution, lane.grad.channels), sums[j] + own_sum);
    }
    const uint32_t hits = warp_or(shown >> lane_id() & 1 ? 1u << (listed[lane_id()] - from) : 0u);
    if (lane_id() == 0) shared.hits[group][from / kStateChunk] = hits;
  }
}

/// Batches are short where positions take much shared memory.
template <class F, int C, class Layout>
struct MovingVjpShared : VjpBatch<F, C, Layout, Layout::kCells == 1 ? 2 * kStateChunk : kStateChunk, true> {
  int last[Layout::kWarps];

  __device__ float total(int j, int v) const {
    float sum = 0;
    AR_UNROLL for (int w = 0; w < Layout::kWarps; ++w) {
      if (this->is_hit(w, j)) sum += this->inside[w][j][v];
    }
    return sum;
  }
};

/// A block per tile. Parameters as of segment_vjp_kernel.
template <class F, int C, class Layout>
__global__ void __launch_bounds__(Layout::kThreads, kMovingVjpBlocks<C, Layout, false>)
    moving_vjp_kernel(const BlendVjpParams params, int first, int in_shared) {
  wait_for_earlier_kernels();
  using Shared = MovingVjpShared<F, C, Layout>;
  using Lane = VjpLane<F, C, Layout>;
  using Samples = typename Lane::Samples;
  constexpr int kBatch = Shared::kBatch;
  static_assert(Layout::kBlocks == 1);
  Shared& shared = *reinterpret_cast<Shared*>(dynamic_shared());
  const int tile = listed_tile(params, params.plan->counts.segments + int(blockIdx.x)), warp = threadIdx.x / 32;
  if (tile < 0) return;
  const TileList list = list_of(params.lists, params.grid, tile);
  const TileCheckpoints stored(params.lists, list, params.grid, tile);
  const WantedSums<C> wanted(params, first);
  Lane lane(params, list);
  const int stop = lane.last.of_block(shared.last);
  clear_pairs<Layout::kThreads>(params, list, stop, list.count, first);
  lane.begin(params, first, wanted);
  EarlierPositions<Layout> earlier(sizeof(Shared), in_shared);
  int k0 = (stop - 1) / kBatch * kBatch;
  int32_t id = shared.stage.splat_of(list, k0, stop);
  for (int k1 = stop; k1 > 0; k1 = k0, k0 -= kBatch) {
    if (stored.spacing > kStateChunk) {  // too many pairs: from the checkpoint to the batch
      const int checkpoint = k0 / stored.spacing;
      int k = checkpoint * stored.spacing;
      lane.samples.load(params.checkpoints + (stored.first + checkpoint - 1) * Samples::kCheckpoint, k,
                        lane.last.samples);
      for (; k < k0; k += kBatch) {
        __syncthreads();
        shared.stage.load(params, first, list, shared.stage.splat_of(list, k, k0));
        __syncthreads();
        for (int from = 0; from < kBatch; from += kStateChunk) replay_chunk(shared.stage, from, k, lane, nullptr);
      }
    }
    const int32_t next_id = k0 > 0 ? shared.stage.splat_of(list, k0 - kBatch, k0) : -1;
    __syncthreads();  // all have read what the last batch left
    if (threadIdx.x < kBatch) shared.load(int(threadIdx.x), params, first, list, k0, id, wanted.means);
    __syncthreads();
    if (next_id >= 0) prefetch_splat(params.splats, next_id);
    id = next_id;
    const Samples at_batch = lane.samples;
    batch_vjp(params, shared, warp, shared.inside[warp], list, k0, wanted.means, lane, earlier, [&](int from) {
      if (stored.spacing > kStateChunk) {
        lane.samples = at_batch;
        for (int ahead = 0; ahead < from; ahead += kStateChunk) replay_chunk(shared.stage, ahead, k0, lane, nullptr);
      } else {
        lane.samples.load(stored.at<Samples>(params.checkpoints, k0 + from), k0 + from, lane.last.samples);
      }
    });
    __syncthreads();
    shared.write(params, first, wanted, list, k1 - k0, [&](int j, int v) { return shared.total(j, v); });
  }
}

/// With as many positions in shared memory as let kMovingVjpBlocks blocks be resident.
template <class Shared, int C, class Layout, bool kSegments, class Kernel>
void launch_vjp(Kernel kernel, const BlendVjpParams& p, unsigned blocks, int first, cudaStream_t stream) {
  using Earlier = EarlierPositions<Layout>;
  const size_t all = shared_bytes_of_blocks(kMovingVjpBlocks<C, Layout, kSegments>);
  const size_t splats = all > sizeof(Shared) ? (all - sizeof(Shared)) / Earlier::kBytes : 0;
  const int in_shared = int(std::min<size_t>(splats, MomentPolicy::kMostInShared)) / Earlier::kUnit * Earlier::kUnit;
  launch(kernel, {blocks, Layout::kThreads, sizeof(Shared) + in_shared * Earlier::kBytes}, stream, p, first, in_shared);
}

}  // namespace ar::cuda
