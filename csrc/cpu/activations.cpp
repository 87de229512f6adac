// activate, activate_vjp and observe of training.h. Threads share chunks of Gaussians.
#include "core/activations.h"

#include <algorithm>

#include "core/density.h"
#include "cpu/parallel.h"
#include "cpu/training.h"

namespace ar::cpu {
namespace {

constexpr int64_t kGaussians = 4096;

template <class Body> void for_each_gaussian(int64_t n, int threads, const Body& body) {
  parallel_for((n + kGaussians - 1) / kGaussians, threads, [&](int64_t item) {
    for (int64_t i = item * kGaussians; i < std::min(n, (item + 1) * kGaussians); ++i) body(i);
  });
}

}  // namespace

template <typename T> void activate(const ActivateParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::activate(p, i); });
}
template <typename T> void activate_vjp(const ActivateVjpParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::activate_vjp(p, i); });
}
template <typename T> void observe(const ObserveParams<T>& p, int threads) {
  for_each_gaussian(p.n, threads, [&](int64_t i) { ar::observe(p, i); });
}

template void activate(const ActivateParams<float>&, int);
template void activate(const ActivateParams<double>&, int);
template void activate_vjp(const ActivateVjpParams<float>&, int);
template void activate_vjp(const ActivateVjpParams<double>&, int);
template void observe(const ObserveParams<float>&, int);
template void observe(const ObserveParams<double>&, int);

}  // namespace ar::cpu
