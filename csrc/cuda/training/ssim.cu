// The similarity of two images, a loss of it and l1, and the adjoint. `ssim` writes similarities, partial derivatives
// and sums of blocks, `loss` adds these up in a fixed order, and `ssim_vjp` makes the image's gradient from the partial
// derivatives.
//
// Sums go along rows, then columns, in shared memory. A thread makes kRun neighbouring sums from registers, to load
// less.
#include "core/ssim.h"

#include "cuda/launch.cuh"
#include "cuda/training/training.h"
#include "cuda/warp.cuh"

namespace ar::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kReach = 2 * kSsimRadius;

/// The tile of a block.
template <typename T> struct Tile {
  static constexpr int kColumns = 32;
  static constexpr int kRun =
      sizeof(T) == 4 ? 4 : 1;  ///< pixels of a thread, in a column: loads from shared memory against registers
  static constexpr int kRows = kThreads / kColumns * kRun;
  static constexpr int kReadColumns = kColumns + kReach, kReadRows = kRows + kReach;
  // The remainder by four is three: runs of four in neighbouring rows read from different banks.
  static constexpr int kReadPitch = kReadColumns + 1;
  static constexpr int kSumPitch = kColumns + 1;
};

template <typename T, int kImages, int kSums> struct Shared {
  T read[kImages][Tile<T>::kReadRows * Tile<T>::kReadPitch];
  T sums[kSums][Tile<T>::kReadRows * Tile<T>::kSumPitch];
};

struct Position {
  int64_t plane;
  int top, left;
};

__host__ __device__ inline int tiles_along(int size, int tile) { return (size - 1) / tile + 1; }

template <typename T> __device__ Position position_of(int block, int height, int width) {
  using Tile = Tile<T>;
  const int across = tiles_along(width, Tile::kColumns), down = tiles_along(height, Tile::kRows);
  return {block / across / down, block / across % down * Tile::kRows, block % across * Tile::kColumns};
}

/// copy(index in Shared::read, pixel of the plane or -1 outside the image) for what windows read.
template <typename T, class Copy>
__device__ void for_each_read(Position position, int height, int width, const Copy& copy) {
  using Tile = Tile<T>;
  for (int i = threadIdx.x; i < Tile::kReadRows * Tile::kReadColumns; i += kThreads) {
    const int row = i / Tile::kReadColumns, column = i % Tile::kReadColumns;
    const int y = position.top + row - kSsimRadius, x = position.left + column - kSsimRadius;
    const bool inside = y >= 0 && y < height && x >= 0 && x < width;
    copy(row * Tile::kReadPitch + column, inside ? int64_t(y) * width + x : -1);
  }
}

/// body(index in Shared::read, index in Shared::sums) for every run of sums along rows.
template <typename T, class Body> __device__ void for_each_run(const Body& body) {
  using Tile = Tile<T>;
  constexpr int kRuns = Tile::kColumns / Tile::kRun;
  for (int i = threadIdx.x; i < Tile::kReadRows * kRuns; i += kThreads) {
    const int row = i / kRuns, column = i % kRuns * Tile::kRun;
    body(row * Tile::kReadPitch + column, row * Tile::kSumPitch + column);
  }
}

/// out[j] is the window sum of the eleven values from v[j] on.
template <typename T, int kRun> __device__ void sum_run(const T (&v)[kRun + kReach], T (&out)[kRun]) {
  AR_UNROLL for (int j = 0; j < kRun; ++j) out[j] = window_sum<T>([&](int k) { return v[j + kSsimRadius + k]; });
}

template <typename T> __device__ void sum_columns(const T* along_rows, T (&out)[Tile<T>::kRun]) {
  using Tile = Tile<T>;
  const int column = threadIdx.x % Tile::kColumns, row = threadIdx.x / Tile::kColumns * Tile::kRun;
  T v[Tile::kRun + kReach];
  AR_UNROLL for (int k = 0; k < Tile::kRun + kReach; ++k) v[k] = along_rows[(row + k) * Tile::kSumPitch + column];
  sum_run<T, Tile::kRun>(v, out);
}

/// body(j, pixel of the plane) for each pixel j of this thread in the image.
template <typename T, class Body>
__device__ void for_each_pixel(Position position, int height, int width, const Body& body) {
  using Tile = Tile<T>;
  const int x = position.left + threadIdx.x % Tile::kColumns;
  const int top = position.top + threadIdx.x / Tile::kColumns * Tile::kRun;
  AR_UNROLL for (int j = 0; j < Tile::kRun; ++j) {
    if (x < width && top + j < height) body(j, int64_t(top + j) * width + x);
  }
}

/// block_sums: [blocks, 2] for sums of |x - y| and of the similarity, or null. Target: T or uint8_t.
template <typename T, typename Target>
__global__ void __launch_bounds__(kThreads) ssim_kernel(const SsimParams<T, Target> p, T* block_sums) {
  wait_for_earlier_kernels();
  constexpr int kRun = Tile<T>::kRun;
  __shared__ Shared<T, 2, kSsimMoments> shared;
  const Position position = position_of<T>(int(blockIdx.x), p.height, p.width);
  const int64_t plane = position.plane * p.height * p.width;
  const T* image = p.image + plane;
  const Target* target = p.target + plane;

  for_each_read<T>(position, p.height, p.width, [&](int to, int64_t pixel) {
    shared.read[0][to] = pixel < 0 ? T(0) : image[pixel];
    shared.read[1][to] = pixel < 0 ? T(0) : pixel_value<T>(target[pixel]);
  });
  __syncthreads();
  for_each_run<T>([&](int from, int to) {
    constexpr int kValues = kRun + kReach;
    T x[kValues], y[kValues], product[kValues], out[kRun];
    const auto sum = [&](const T(&values)[kValues], int moment) {
      sum_run<T, kRun>(values, out);
      AR_UNROLL for (int j = 0; j < kRun; ++j) shared.sums[moment][to + j] = out[j];
    };
    const auto sum_products = [&](const T(&a)[kValues], const T(&b)[kValues], int moment) {
      AR_UNROLL for (int k = 0; k < kValues; ++k) product[k] = a[k] * b[k];
      sum(product, moment);
    };
    AR_UNROLL for (int k = 0; k < kValues; ++k) {
      x[k] = shared.read[0][from + k];
      y[k] = shared.read[1][from + k];
    }
    sum(x, kMomentX);
    sum(y, kMomentY);
    sum_products(x, x, kMomentXX);
    sum_products(y, y, kMomentYY);
    sum_products(x, y, kMomentXY);
  });
  __syncthreads();
  T sums[kSsimMoments][kRun];
  AR_UNROLL for (int m = 0; m < kSsimMoments; ++m) sum_columns<T>(shared.sums[m], sums[m]);

  T l1_sum = T(0), ssim_sum = T(0);
  for_each_pixel<T>(position, p.height, p.width, [&](int j, int64_t pixel) {
    T moments[kSsimMoments];
    AR_UNROLL for (int m = 0; m < kSsimMoments; ++m) moments[m] = sums[m][j];
    const Ssim<T> s = ar::ssim(moments);
    if (p.map) p.map[plane + pixel] = s.value;
    if (p.partials) {
      AR_UNROLL for (int k = 0; k < kSsimPartials; ++k) p.partials[k * p.pixels() + plane + pixel] = s.partials[k];
    }
    l1_sum += abs(image[pixel] - pixel_value<T>(target[pixel]));
    ssim_sum += s.value;
  });
  if (!block_sums) return;
  T sums_of_block[] = {l1_sum, ssim_sum};
  sum_block<kThreads / 32>(sums_of_block);
  if (threadIdx.x == 0) {
    block_sums[2 * int64_t(blockIdx.x)] = sums_of_block[0];
    block_sums[2 * int64_t(blockIdx.x) + 1] = sums_of_block[1];
  }
}

/// One block. block_sums: [blocks, 2]. T, Target: as in ssim_kernel.
template <typename T, typename Target>
__global__ void loss_kernel(const SsimParams<T, Target> p, const T* block_sums, int64_t blocks) {
  wait_for_earlier_kernels();
  double sums[] = {0, 0};  // of L1 and of similarities
  for (int64_t i = threadIdx.x; i < blocks; i += kThreads) {
    for (int k = 0; k < 2; ++k) sums[k] += double(block_sums[2 * i + k]);
  }
  sum_block<kThreads / 32>(sums);
  if (threadIdx.x == 0) *p.loss = combined_loss(p, sums[0], sums[1]);
}

template <typename T, typename Target>
__global__ void __launch_bounds__(kThreads) ssim_vjp_kernel(const SsimVjpParams<T, Target> p) {
  wait_for_earlier_kernels();
  constexpr int kRun = Tile<T>::kRun;
  __shared__ Shared<T, kSsimPartials, kSsimPartials> shared;
  const Position position = position_of<T>(int(blockIdx.x), p.height, p.width);
  const int64_t plane = position.plane * p.height * p.width;

  for_each_read<T>(position, p.height, p.width, [&](int to, int64_t pixel) {
    const T scale = p.dL_dmap && pixel >= 0 ? p.dL_dmap[plane + pixel] : T(1);
    AR_UNROLL for (int k = 0; k < kSsimPartials; ++k) shared.read[k][to] =
        pixel < 0 ? T(0) : p.partials[k * p.pixels() + plane + pixel] * scale;
  });
  __syncthreads();
  for_each_run<T>([&](int from, int to) {
    AR_UNROLL for (int m = 0; m < kSsimPartials; ++m) {
      T values[kRun + kReach], out[kRun];
      AR_UNROLL for (int k = 0; k < kRun + kReach; ++k) values[k] = shared.read[m][from + k];
      sum_run<T, kRun>(values, out);
      AR_UNROLL for (int j = 0; j < kRun; ++j) shared.sums[m][to + j] = out[j];
    }
  });
  __syncthreads();
  T sums[kSsimPartials][kRun];
  AR_UNROLL for (int m = 0; m < kSsimPartials; ++m) sum_columns<T>(shared.sums[m], sums[m]);

  const LossWeights<T> weights = pixel_weights(p);
  for_each_pixel<T>(position, p.height, p.width, [&](int j, int64_t pixel) {
    T partials[kSsimPartials];
    AR_UNROLL for (int k = 0; k < kSsimPartials; ++k) partials[k] = sums[k][j];
    p.dL_dimage[plane + pixel] =
        ar::ssim_vjp(p.image[plane + pixel], pixel_value<T>(p.target[plane + pixel]), partials, weights);
  });
}

}  // namespace

template <typename T> int64_t ssim_blocks(int64_t planes, int height, int width) {
  return planes * tiles_along(height, Tile<T>::kRows) * tiles_along(width, Tile<T>::kColumns);
}

template <typename T, typename Target> void ssim(const SsimParams<T, Target>& p, T* block_sums, cudaStream_t stream) {
  const int64_t blocks = ssim_blocks<T>(p.planes, p.height, p.width);
  launch(ssim_kernel<T, Target>, {unsigned(blocks), kThreads}, stream, p, p.loss ? block_sums : nullptr);
  if (p.loss) launch(loss_kernel<T, Target>, {1, kThreads}, stream, p, block_sums, blocks);
}
template <typename T, typename Target> void ssim_vjp(const SsimVjpParams<T, Target>& p, cudaStream_t stream) {
  const int64_t blocks = ssim_blocks<T>(p.planes, p.height, p.width);
  launch(ssim_vjp_kernel<T, Target>, {unsigned(blocks), kThreads}, stream, p);
}

template int64_t ssim_blocks<float>(int64_t, int, int);
template int64_t ssim_blocks<double>(int64_t, int, int);
template void ssim(const SsimParams<float, float>&, float*, cudaStream_t);
template void ssim(const SsimParams<float, uint8_t>&, float*, cudaStream_t);
template void ssim(const SsimParams<double, double>&, double*, cudaStream_t);
template void ssim(const SsimParams<double, uint8_t>&, double*, cudaStream_t);
template void ssim_vjp(const SsimVjpParams<float, float>&, cudaStream_t);
template void ssim_vjp(const SsimVjpParams<float, uint8_t>&, cudaStream_t);
template void ssim_vjp(const SsimVjpParams<double, double>&, cudaStream_t);
template void ssim_vjp(const SsimVjpParams<double, uint8_t>&, cudaStream_t);

}  // namespace ar::cuda
