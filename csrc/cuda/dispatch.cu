// Entry points of blending for csrc/torch: blend, blend_vjp and inspect. blend and blend_vjp call the family of kernels
// that the table of dispatch.h names. Before each group of a backward pass the kernel clear_sums sets chunks_taken to
// zero and, where tiles share the lists of patches, the sums to which tiles add.
#include "cuda/dispatch.h"
#include "cuda/inspect.cuh"
#include "cuda/launch.cuh"
#include "cuda/params.h"

namespace ar::cuda {
namespace {

constexpr int kClearBlock = 256;

/// Sets *chunks_taken to zero. If lists are of patches, also the rows that tiles add to: pair_grads for the first group
/// of channels, and channel_sums [n, width] for every group.
__global__ void clear_sums_kernel(const BlendVjpParams params, int first, int width) {
  wait_for_earlier_kernels();
  if (blockIdx.x == 0 && threadIdx.x == 0) *params.chunks_taken = 0;
  if (!params.lists.counts->in_patches(params.lists.capacity)) return;
  const auto clear = [&](float* to, int numbers_of_row) {
    const int64_t n = params.lists.n * numbers_of_row;
    for (int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < n; i += int64_t(gridDim.x) * blockDim.x)
      to[i] = 0;
  };
  if (first == 0) clear(params.pair_grads, kPairGradWidth);
  if (params.channel_sums) clear(params.channel_sums, width);
}

Family family_at(int footprint, int channels) {
  Family found = Family::kStill;
  visit_pixels(footprint, [&](auto f) { found = family_of<decltype(f)>(channels); });
  return found;
}

}  // namespace

int multiprocessors_of_device() { return int(multiprocessors()); }

void blend(int footprint, const BlendParams& p, cudaStream_t stream) {
  const Family family = family_at(footprint, p.channels.count);
  if (family == Family::kStill) blend_still(footprint, p, stream);
  if (family == Family::kMoment) blend_moment(footprint, p, stream);
  if (family == Family::kChannels) blend_channels(footprint, p, stream);
}

void blend_vjp(int footprint, const BlendVjpParams& p, int first, cudaStream_t stream) {
  const int width = channel_group(footprint, p.channels.count - first);
  launch(clear_sums_kernel, {kBlocksPerSm * multiprocessors(), kClearBlock}, stream, p, first, width);
  const Family family = family_at(footprint, p.channels.count);
  if (family == Family::kStill) blend_vjp_still(footprint, p, stream);
  if (family == Family::kMoment) blend_vjp_moment(footprint, p, first, stream);
  if (family == Family::kChannels) blend_vjp_channels(footprint, p, first, stream);
}

void inspect(int footprint, const InspectParams& p, cudaStream_t stream) {
  visit_pixels(footprint, [&](auto f) {
    using F = decltype(f);
    with_tile_side<F>(p.grid, [&](auto side) {
      const auto kernel = p.touched    ? inspect_kernel<F, side, Look::kStatistics>
                          : p.dominant ? inspect_kernel<F, side, Look::kImages>
                                       : inspect_kernel<F, side, Look::kMedian>;
      launch(kernel, {unsigned(p.grid.tiles()), kInspectThreads<side>}, stream, p);
    });
  });
}

}  // namespace ar::cuda
