// What the ops accept. Checked once, before anything is touched, for every backend alike: TypeError for a wrong dtype,
// ValueError for anything else. Messages say which argument, what was expected and what came:
// `means3D must have shape (P, 3), got (5, 2)`.
#pragma once

#include "torch/backend.h"

namespace ar::ops {

/// Afterwards every tensor is contiguous, and the matrices are 4x4.
void check(Inputs& in);
void check(RasterizeArguments& a);
/// Raises for numbers of the camera that are not finite: always on the CPU, and on a device, for which the host must
/// then wait, with `debug`. Of arguments that have been checked; the forward pass alone asks.
void check_values(const Inputs& in, bool debug);
/// The same, and with debug for numbers that no Gaussian should have.
void check_values(const RasterizeArguments& a);
void check(BinArguments& a);
void check(BlendArguments& a, const Pass& pass);
void check(InspectArguments& a, const ListTensors& lists, const Pass& pass);
void check(WeightArguments& a);
void check(SsimArguments& a);
void check(ActivateArguments& a);
void check(ObserveArguments& a);
/// What the ops that it is made of would find only after a part of the work, or call by another name.
void check(PictureArguments& a);
void check(AdamArguments& a);

/// The inputs of camera `c` of a batch, not yet checked.
Inputs inputs_of(const ProjectArguments& a, int64_t c);
/// What inputs_of cannot check: that there are as many of everything as there are cameras. Returns their number.
int64_t check_cameras(const ProjectArguments& a);

/// The gradient with respect to the differentiable output at `place`, contiguous; undefined if there is none. It must
/// have the dtype and device of `like` and these sizes.
Tensor gradient_of(const std::vector<OptionalTensor>& dL_doutputs, size_t place, const char* name, const Tensor& like,
                   at::IntArrayRef sizes);
/// The same of an op whose only differentiable output is `output`: without its gradient nobody asks for the adjoint.
Tensor only_gradient_of(const std::vector<OptionalTensor>& dL_doutputs, const std::string& output, const Tensor& like,
                        at::IntArrayRef sizes);
/// Says of so many tensor arguments whether they want a gradient.
void check_needs(const std::vector<bool>& needs, size_t count);

/// Lists and state fit each other, the splats, the footprint and the image: the outputs of the forward pass for the
/// same arguments. What they contain is the forward pass's own and is not looked at.
void check_saved(const ListTensors& lists, const BlendState& state, const Tensor& like, const Pass& pass);
void check_lists(const ListTensors& lists, const Tensor& like, const Pass& pass);

/// Whether `row_splits`, a contiguous vector of int64 on the CPU that is not empty, rise from 0 to `rows`.
bool rises_to(const Tensor& row_splits, int64_t rows);

/// Rows that int32 can number: those of the splats of all cameras.
void check_row_count(int64_t rows, const char* name);
/// Sizes that tensors and tiles can be indexed with.
void check_image_size(int64_t height, int64_t width);

}  // namespace ar::ops
