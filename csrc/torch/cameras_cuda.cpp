// cameras.h: allocates, and launches the kernels of cuda/project/cameras.h on the current stream.
#include "torch/cameras.h"

#include <ATen/Dispatch.h>
#include <ATen/ops/empty.h>

#include "cuda/project/cameras.h"
#include "torch/cuda_stream.h"

namespace ar::ops {

template <class Source> void prepare_on_cuda(const Source& source, const Tensor& like) {
  const bool searches = finds_fold(source) || finds_reach(source);
  const int64_t numbers = searches ? int64_t(source.count) * kLimitDirections : 0;
  const Tensor folds = at::empty({numbers}, like.options().dtype(at::kDouble));
  const Tensor seen = at::empty({numbers}, like.options().dtype(at::kInt));
  on_stream(like, [&](cudaStream_t stream) {
    cuda::prepare(source, {pointer<double>(folds), pointer<int32_t>(seen)}, stream);
  });
}
template void prepare_on_cuda(const CameraSource<float>&, const Tensor&);
template void prepare_on_cuda(const CameraSource<double>&, const Tensor&);
template void prepare_on_cuda(const LensSource<float>&, const Tensor&);
template void prepare_on_cuda(const LensSource<double>&, const Tensor&);

template <typename T>
void prepare_vjp_on_cuda(const CameraSource<T>& source, const CameraSourceGrads<T>& grads, const Tensor& like) {
  on_stream(like, [&](cudaStream_t stream) { cuda::prepare_vjp(source, grads, stream); });
}
template void prepare_vjp_on_cuda(const CameraSource<float>&, const CameraSourceGrads<float>&, const Tensor&);
template void prepare_vjp_on_cuda(const CameraSource<double>&, const CameraSourceGrads<double>&, const Tensor&);

void middle_vjp_on_cuda(const Tensor& view, const Tensor& proj, const Tensor& dL_dlens, const Tensor& dL_dview,
                        const Tensor& dL_dproj) {
  AT_DISPATCH_FLOATING_TYPES(view.scalar_type(), "prepare_lens_vjp", [&] {
    on_stream(view, [&](cudaStream_t stream) {
      cuda::middle_vjp(const_pointer<scalar_t>(view), const_pointer<scalar_t>(proj), const_pointer<scalar_t>(dL_dlens),
                       pointer<scalar_t>(dL_dview), pointer<scalar_t>(dL_dproj), stream);
    });
  });
}

}  // namespace ar::ops
