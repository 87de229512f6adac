// ssim and ssim_vjp of training.h, in blocks of pixels. Window sums go along rows, then columns. Sums of blocks are
// added in order.
#include "core/ssim.h"

#include <algorithm>
#include <vector>

#include "cpu/parallel.h"
#include "cpu/training.h"

namespace ar::cpu {
namespace {

/// Few columns, for the cache, and many rows: two blocks read those at a border.
constexpr int kColumns = 128, kRows = 64;

/// [top, bottom) x [left, right) of a plane.
struct Block {
  int64_t plane;
  int top, left, bottom, right;
};

class Blocks {
 public:
  template <class Params>
  explicit Blocks(const Params& p)
      : height_(p.height), width_(p.width), down_((p.height - 1) / kRows + 1), across_((p.width - 1) / kColumns + 1) {
    count_ = p.planes * down_ * across_;
  }
  int64_t count() const { return count_; }
  Block operator[](int64_t i) const {
    const int top = int(i / across_ % down_) * kRows, left = int(i % across_) * kColumns;
    return {i / across_ / down_, top, left, std::min(height_ - top, kRows) + top,
            std::min(width_ - left, kColumns) + left};
  }

 private:
  int height_, width_;
  int64_t down_, across_, count_;
};

/// Window sums of kImages images over a block, row by row.
template <typename T, int kImages> struct RollingWindow {
  T row[kImages][kColumns + 2 * kSsimRadius];  ///< kSsimRadius pixels more on both sides.
  T sums[kImages][kColumns];

  void push(int y) {
    for (int m = 0; m < kImages; ++m) {
      const T* in = row[m] + kSsimRadius;
      T* __restrict__ out = along_rows_[slot(y)][m];
      for (int x = 0; x < kColumns; ++x) out[x] = window_sum<T>([&](int k) AR_HD_LAMBDA { return in[x + k]; });
      std::copy(out, out + kColumns, along_rows_[slot(y) + kSsimWindow][m]);
    }
  }
  /// After the last row under the windows of row y was pushed.
  void sum(int y) {
    for (int m = 0; m < kImages; ++m) {
      const auto* in = along_rows_ + slot(y - kSsimRadius) + kSsimRadius;
      T* __restrict__ out = sums[m];
      for (int x = 0; x < kColumns; ++x) out[x] = window_sum<T>([&](int k) AR_HD_LAMBDA { return in[k][m][x]; });
    }
  }

 private:
  static int slot(int y) { return (y + 2 * kSsimWindow) % kSsimWindow; }

  /// Each row is there twice, so that rows under a window are adjacent.
  T along_rows_[2 * kSsimWindow][kImages][kColumns];
};

/// visit(y, is_inside) for rows under a block's windows; finish(y) for rows whose windows are complete.
template <class Visit, class Finish>
void for_each_row(const Block& block, int height, const Visit& visit, const Finish& finish) {
  for (int y = block.top - kSsimRadius; y < block.bottom + kSsimRadius; ++y) {
    visit(y, y >= 0 && y < height);
    if (y - kSsimRadius >= block.top) finish(y - kSsimRadius);
  }
}

template <typename T, typename Value> void copy_row(const Value* image_row, const Block& block, int width, T* out) {
  const int first = block.left - kSsimRadius;
  const int begin = std::max(first, 0), end = std::min(block.left + kColumns + kSsimRadius, width);
  std::fill(out, out + (begin - first), T(0));
  for (int x = begin; x < end; ++x) out[x - first] = pixel_value<T>(image_row[x]);
  std::fill(out + (end - first), out + kColumns + 2 * kSsimRadius, T(0));
}

struct Sums {
  double l1, ssim;
};

template <typename T, typename Target> Sums ssim_of_block(const SsimParams<T, Target>& p, const Block& block) {
  RollingWindow<T, kSsimMoments> window;
  double l1_sums[kColumns] = {}, ssim_sums[kColumns] = {};
  const int64_t plane = block.plane * p.height * p.width;
  const int columns = block.right - block.left;
  const auto visit = [&](int y, bool is_inside) {
    if (is_inside) {
      T *row_x = window.row[kMomentX], *row_y = window.row[kMomentY];
      copy_row(p.image + plane + int64_t(y) * p.width, block, p.width, row_x);
      copy_row(p.target + plane + int64_t(y) * p.width, block, p.width, row_y);
      for (int x = 0; x < kColumns + 2 * kSsimRadius; ++x) {
        window.row[kMomentXX][x] = row_x[x] * row_x[x];
        window.row[kMomentYY][x] = row_y[x] * row_y[x];
        window.row[kMomentXY][x] = row_x[x] * row_y[x];
      }
    } else {
      std::fill(&window.row[0][0], &window.row[0][0] + sizeof(window.row) / sizeof(T), T(0));
    }
    window.push(y);
  };
  const auto finish = [&](int y) {
    window.sum(y);
    T values[kColumns], partials[kSsimPartials][kColumns];
    for (int x = 0; x < kColumns; ++x) {
      T moments[kSsimMoments];
      for (int m = 0; m < kSsimMoments; ++m) moments[m] = window.sums[m][x];
      const Ssim<T> s = ar::ssim(moments);
      values[x] = s.value;
      for (int k = 0; k < kSsimPartials; ++k) partials[k][x] = s.partials[k];
    }
    const int64_t first = plane + int64_t(y) * p.width + block.left;
    if (p.map) std::copy(values, values + columns, p.map + first);
    if (p.partials) {
      for (int k = 0; k < kSsimPartials; ++k)
        std::copy(partials[k], partials[k] + columns, p.partials + k * p.pixels() + first);
    }
    for (int x = 0; x < columns; ++x) {
      l1_sums[x] += double(abs(p.image[first + x] - pixel_value<T>(p.target[first + x])));
      ssim_sums[x] += double(values[x]);
    }
  };
  for_each_row(block, p.height, visit, finish);
  Sums sums = {0, 0};
  for (int x = 0; x < columns; ++x) {
    sums.l1 += l1_sums[x];
    sums.ssim += ssim_sums[x];
  }
  return sums;
}

template <typename T, typename Target>
void ssim_vjp_of_block(const SsimVjpParams<T, Target>& p, const Block& block, LossWeights<T> weights) {
  RollingWindow<T, kSsimPartials> window;
  const int64_t plane = block.plane * p.height * p.width;
  const auto visit = [&](int y, bool is_inside) {
    if (is_inside) {
      const int64_t first = plane + int64_t(y) * p.width;
      for (int k = 0; k < kSsimPartials; ++k)
        copy_row(p.partials + k * p.pixels() + first, block, p.width, window.row[k]);
      if (p.dL_dmap) {
        T dL_dmap[kColumns + 2 * kSsimRadius];
        copy_row(p.dL_dmap + first, block, p.width, dL_dmap);
        for (int k = 0; k < kSsimPartials; ++k)
          for (int x = 0; x < kColumns + 2 * kSsimRadius; ++x) window.row[k][x] *= dL_dmap[x];
      }
    } else {
      std::fill(&window.row[0][0], &window.row[0][0] + sizeof(window.row) / sizeof(T), T(0));
    }
    window.push(y);
  };
  const auto finish = [&](int y) {
    window.sum(y);
    const int64_t first = plane + int64_t(y) * p.width + block.left;
    for (int x = 0; x < block.right - block.left; ++x) {
      T partials[kSsimPartials];
      for (int k = 0; k < kSsimPartials; ++k) partials[k] = window.sums[k][x];
      p.dL_dimage[first + x] = ar::ssim_vjp(p.image[first + x], pixel_value<T>(p.target[first + x]), partials, weights);
    }
  };
  for_each_row(block, p.height, visit, finish);
}

}  // namespace

template <typename T, typename Target> void ssim(const SsimParams<T, Target>& p, int threads) {
  const Blocks blocks(p);
  std::vector<Sums> sums(blocks.count());
  parallel_for(blocks.count(), threads, [&](int64_t i) { sums[i] = ssim_of_block(p, blocks[i]); });
  if (!p.loss) return;
  Sums total = {0, 0};
  for (const Sums& of_block : sums) {
    total.l1 += of_block.l1;
    total.ssim += of_block.ssim;
  }
  *p.loss = combined_loss(p, total.l1, total.ssim);
}

template <typename T, typename Target> void ssim_vjp(const SsimVjpParams<T, Target>& p, int threads) {
  const Blocks blocks(p);
  const LossWeights<T> weights = pixel_weights(p);
  parallel_for(blocks.count(), threads, [&](int64_t i) { ssim_vjp_of_block(p, blocks[i], weights); });
}

template void ssim(const SsimParams<float, float>&, int);
template void ssim(const SsimParams<float, uint8_t>&, int);
template void ssim(const SsimParams<double, double>&, int);
template void ssim(const SsimParams<double, uint8_t>&, int);
template void ssim_vjp(const SsimVjpParams<float, float>&, int);
template void ssim_vjp(const SsimVjpParams<float, uint8_t>&, int);
template void ssim_vjp(const SsimVjpParams<double, double>&, int);
template void ssim_vjp(const SsimVjpParams<double, uint8_t>&, int);

}  // namespace ar::cpu
