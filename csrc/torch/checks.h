// What ops accept, checked before they touch anything. A wrong dtype raises TypeError, anything else ValueError:
// `means3D must have shape (P, 3), got (5, 2)`.
#pragma once

#include "torch/backend.h"
#include "torch/training_arguments.h"

namespace ar::ops {

/// Afterwards every tensor is contiguous, and matrices are 4x4.
void check(Inputs& in);
/// Raises in the order along rays, which excludes `what`.
void refuse_rays(const Pass& pass, const char* what);
void check(RasterizeArguments& a);
/// The camera's numbers are finite. On CUDA, where the host waits, only with `debug`.
void check_values(const Inputs& in, bool debug);
/// And with debug those of the Gaussians are valid.
void check_values(const RasterizeArguments& a);
void check(BinArguments& a, const Pass& pass);
void check(BlendArguments& a, const Pass& pass);
void check(CompositeArguments& a, const Pass& pass);
void check(SeamArguments& a);
void check(InspectArguments& a, const ListTensors& lists, const Pass& pass);
void check(WeightArguments& a);
void check(SsimArguments& a);
void check(ActivateArguments& a);
void check(FilterArguments& a);
void check(ObserveArguments& a);
void check(NoiseArguments& a);
void check(PictureArguments& a);
void check(RowsPictureArguments& a);
void check(CorrectArguments& a);
void check(AdamArguments& a);

/// One batch.
ProjectArguments batch_of(const BatchArguments& a);
/// Of camera c. Not yet checked.
Inputs inputs_of(const ProjectArguments& a, int64_t c);
/// What camera c reads of a tensor whose rows have `dims` dimensions in one batch.
Tensor part_of(const ProjectArguments& a, int64_t c, const Tensor& t, int64_t dims);
/// Of tensors of Gaussians with the shapes of `a`. T: Tensor or OptionalTensor.
template <class T> void take_parts(const ProjectArguments& a, int64_t c, SceneTensors<T>& of);
/// Of `t`, which is `values` or like it.
inline Tensor values_of(const ProjectArguments& a, int64_t c, const Tensor& t) { return part_of(a, c, t, 2); }
/// Matrices of a single camera may lack the first dimension. Returns the number of cameras.
int64_t check_cameras(ProjectArguments& a);

/// With respect to differentiable output number `output`: contiguous, or undefined.
Tensor gradient_of(const std::vector<OptionalTensor>& dL_doutputs, size_t output, const char* name, const Tensor& like,
                   at::IntArrayRef sizes);
/// Of an op with one differentiable output. Must be defined.
Tensor only_gradient_of(const std::vector<OptionalTensor>& dL_doutputs, const std::string& output, const Tensor& like,
                        at::IntArrayRef sizes);
void check_needs(const std::vector<bool>& needs, size_t count);

/// Sizes fit the splats, the footprint and the image. Contents are trusted.
void check_saved(const ListTensors& lists, const BlendState& state, const Tensor& like, const Pass& pass);
void check_lists(const ListTensors& lists, const Tensor& like, const Pass& pass);

/// Whether `row_splits`, contiguous int64 on the CPU, rise from 0 to `rows`.
bool rises_to(const Tensor& row_splits, int64_t rows);

/// int32 must number them.
void check_row_count(int64_t rows, const char* name);
void check_image_size(int64_t height, int64_t width);

}  // namespace ar::ops
