// The Python module. Pointers come as integers, from tensors that analytic_simple_knn/__init__.py has checked: without
// torch's headers this compiles in seconds, and fits whichever version of torch.
#include <pthread.h>
#include <pybind11/pybind11.h>

#include <cstdint>

#include "backends.h"
#include "tree.h"

namespace py = pybind11;

namespace simple_knn {
namespace {

// GNU's OpenMP keeps a pool of threads, which a forked child does not have but would wait for.
bool is_forked = false;
[[maybe_unused]] const int kWatchesForks = pthread_atfork(nullptr, nullptr, [] { is_forked = true; });

void mean_distances_cpu(uintptr_t points, int64_t n, uintptr_t scratch, uintptr_t out, int threads) {
  cpu::mean_distances(reinterpret_cast<const float*>(points), n, reinterpret_cast<void*>(scratch),
                      reinterpret_cast<float*>(out), is_forked ? 1 : threads);
}

#ifdef SIMPLE_KNN_WITH_CUDA
void mean_distances_cuda(uintptr_t points, int64_t n, uintptr_t scratch, uintptr_t out, uintptr_t stream) {
  cuda::mean_distances(reinterpret_cast<const float*>(points), n, reinterpret_cast<void*>(scratch),
                       reinterpret_cast<float*>(out), reinterpret_cast<CUstream_st*>(stream));
}
#endif

}  // namespace
}  // namespace simple_knn

#define SIMPLE_KNN_QUOTED(text) #text
#define SIMPLE_KNN_TEXT(macro) SIMPLE_KNN_QUOTED(macro)

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  using Released = py::call_guard<py::gil_scoped_release>;
  // Looked for in the file of this module where it cannot be loaded (analytic_simple_knn/installation.py).
  m.attr("BUILT_FOR") = "analytic_simple_knn was built for torch " SIMPLE_KNN_TEXT(SIMPLE_KNN_TORCH);
  m.attr("MAX_POINTS") = simple_knn::kMaxPoints;
  m.def("scratch_bytes_cpu", &simple_knn::cpu::scratch_bytes);
  m.def("mean_distances_cpu", &simple_knn::mean_distances_cpu, Released());
#ifdef SIMPLE_KNN_WITH_CUDA
  m.attr("has_cuda") = true;
  m.def("scratch_bytes_cuda", &simple_knn::cuda::scratch_bytes);
  m.def("mean_distances_cuda", &simple_knn::mean_distances_cuda, Released());
#else
  m.attr("has_cuda") = false;
#endif
}
