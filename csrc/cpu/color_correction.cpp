// correct_colors and correct_colors_vjp of training.h. Sums of chunks are added in order.
#include "core/color_correction.h"

#include <algorithm>
#include <array>
#include <vector>

#include "cpu/parallel.h"
#include "cpu/training.h"

namespace ar::cpu {
namespace {

constexpr int64_t kPixels = 4096;

int64_t chunks_of_pixels(int64_t pixels) { return (pixels + kPixels - 1) / kPixels; }

template <class Body> void for_each_pixel(int64_t chunk, int64_t pixels, const Body& body) {
  for (int64_t i = chunk * kPixels; i < std::min(pixels, (chunk + 1) * kPixels); ++i) body(i);
}

template <bool kVignetted, typename T> void correct(const CorrectParams<T>& p, int threads) {
  const Correction<T> correction = read_correction(p.matrix);
  parallel_for(chunks_of_pixels(p.pixels), threads, [&](int64_t chunk) {
    for_each_pixel(chunk, p.pixels, [&](int64_t i) { correct_color<kVignetted>(p, correction, i); });
  });
}

template <bool kVignetted, typename T> void correct_vjp(const CorrectVjpParams<T>& p, int threads) {
  constexpr int kSums = kCorrection + (kVignetted ? kVignetting : 0);
  const Correction<T> correction = read_correction(p.matrix);
  std::vector<std::array<T, kSums>> sums(size_t(chunks_of_pixels(p.pixels)));
  parallel_for(int64_t(sums.size()), threads, [&](int64_t chunk) {
    T own[kSums] = {};
    for_each_pixel(chunk, p.pixels, [&](int64_t i) { correct_color_vjp<kVignetted>(p, correction, i, own); });
    std::copy(own, own + kSums, sums[size_t(chunk)].begin());
  });
  for (int k = 0; k < kSums; ++k) {
    T* const wanted = k < kCorrection ? p.dL_dmatrix : p.dL_dvignetting;
    if (!wanted) continue;
    double sum = 0;
    for (const auto& of_chunk : sums) sum += double(of_chunk[size_t(k)]);
    wanted[k < kCorrection ? k : k - kCorrection] = T(sum);
  }
}

}  // namespace

template <typename T> void correct_colors(const CorrectParams<T>& p, int threads) {
  if (p.vignetting) return correct<true>(p, threads);
  correct<false>(p, threads);
}

template <typename T> void correct_colors_vjp(const CorrectVjpParams<T>& p, int threads) {
  if (p.vignetting) return correct_vjp<true>(p, threads);
  correct_vjp<false>(p, threads);
}

template void correct_colors(const CorrectParams<float>&, int);
template void correct_colors(const CorrectParams<double>&, int);
template void correct_colors_vjp(const CorrectVjpParams<float>&, int);
template void correct_colors_vjp(const CorrectVjpParams<double>&, int);

}  // namespace ar::cpu
