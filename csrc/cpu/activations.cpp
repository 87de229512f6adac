// Functions of training.h for Gaussians. Sums over chunks are added in order.
#include "core/activations.h"

#include <algorithm>
#include <numeric>
#include <vector>

#include "core/density.h"
#include "cpu/parallel.h"
#include "cpu/training.h"

namespace ar::cpu {
namespace {

constexpr int64_t kGaussians = 4096;

int64_t chunks_of_gaussians(int64_t n) { return (n + kGaussians - 1) / kGaussians; }

template <class Body> void for_each_of_chunk(int64_t chunk, int64_t n, const Body& body) {
  for (int64_t i = chunk * kGaussians; i < std::min(n, (chunk + 1) * kGaussians); ++i) body(i);
}

template <class Body> void for_each_gaussian(int64_t n, int threads, const Body& body) {
  parallel_for(chunks_of_gaussians(n), threads, [&](int64_t chunk) { for_each_of_chunk(chunk, n, body); });
}

}  // namespace

template <typename T> void activate(const ActivateParams<T>& p, int threads) {
  std::vector<double> sums(size_t(chunks_of_gaussians(p.n)));
  parallel_for(int64_t(sums.size()), threads, [&](int64_t chunk) {
    double sum = 0;
    for_each_of_chunk(chunk, p.n, [&](int64_t i) { sum += double(ar::activate(p, i)); });
    sums[size_t(chunk)] = sum;
  });
  if (p.penalty) *p.penalty = T(std::accumulate(sums.begin(), sums.end(), 0.0));
}
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::activate_vjp(p, i); });
}
template <typename T> void observe(const ObserveParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::observe(p, i); });
}
template <typename T> void apply_filter(const FilterParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::apply_filter(p, i); });
}
template <typename T> void apply_filter_vjp(const FilterVjpParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::apply_filter_vjp(p, i); });
}
template <typename T> void add_noise(const NoiseParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::add_noise(p, i); });
}

template void activate(const ActivateParams<float>&, int);
template void activate(const ActivateParams<double>&, int);
template void activate_vjp(const ActivateVjpParams<float>&, int);
template void activate_vjp(const ActivateVjpParams<double>&, int);
template void observe(const ObserveParams<float>&, int);
template void observe(const ObserveParams<double>&, int);
template void apply_filter(const FilterParams<float>&, int);
template void apply_filter(const FilterParams<double>&, int);
template void apply_filter_vjp(const FilterVjpParams<float>&, int);
template void apply_filter_vjp(const FilterVjpParams<double>&, int);
template void add_noise(const NoiseParams<float>&, int);
template void add_noise(const NoiseParams<double>&, int);

}  // namespace ar::cpu
