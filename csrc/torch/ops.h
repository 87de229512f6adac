// The ops, each written once for every device: the pass in rasterize.cpp, its stages in stages.cpp, what a training
// step has besides in training.cpp, a picture of a training from end to end in picture.cpp. Registered with torch in
// ops.cpp, made differentiable in autograd.cpp, and given float32 under autocast in autocast.cpp.
#pragma once

#include <vector>

#include "torch/boxing.h"

namespace ar::ops {

/// What an op returns, in the order of its schema (ops.cpp). `saved` is for its adjoint.
using Results = std::vector<IValue>;

/// color (C + K, H, W) of C colours and K features; images: those of kImageSwitches that are asked for, (H, W); radii
/// (P,) int32; saved.
Results rasterize(RasterizeArguments a);
/// The same, and the seconds that project, bin and blend took, (3,) float64. Saves the lists without `keep` too. Waits
/// for the device.
Results rasterize_timed(RasterizeArguments a);
/// gradients, as from every adjoint: a tensor for every tensor among the op's arguments, empty where none is wanted.
Results rasterize_vjp(VjpArguments<RasterizeArguments> a);

/// means2d, cov2d, opacities, depths, colors (N, ...): rows, camera after camera; radii, gaussian_ids, camera_ids (N,)
/// int32; row_splits (C + 1,) int64 on the CPU; saved: dets (N,), gaussian_ids, row_splits.
Results project(ProjectArguments a);
Results project_vjp(VjpArguments<ProjectArguments> a);

/// What several ranks do in the place of `project`, `bin` and `blend`: rows of splats in one piece, which travel
/// (packed.cpp). `ends` (C, P) int32: how many Gaussians up to each one have a row of each camera. Waits for no device.
Results count_rows(ProjectArguments a);
/// Nothing: writes to rows, radii and ids.
Results pack_rows(PackArguments a);
Results pack_rows_vjp(PackVjpArguments a);
/// image (3, H, W), alpha (H, W), saved: with `keep` ListTensors, BlendState, and what row_grads reads of the rows.
Results blend_rows(BlendRowsArguments a);
/// dL_dbackground (3,), empty where it is not wanted; writes dL_drows.
Results blend_rows_vjp(BlendRowsVjpArguments a);

/// lists: ListTensors of camera after camera.
Results bin(BinArguments a);

/// image (C, K, H, W), alpha (C, H, W), saved: BlendState of camera after camera.
Results blend(BlendArguments a);
Results blend_vjp(VjpArguments<BlendArguments> a);

/// summary: SummaryTensors.
Results inspect(InspectArguments a);

/// weight
Results footprint_weight(WeightArguments a);
Results footprint_weight_vjp(VjpArguments<WeightArguments> a);

/// map (..., H, W), saved: with `keep` the derivatives of the similarity, (kSsimPartials, ..., H, W).
Results ssim_map(SsimArguments a);
Results ssim_map_vjp(VjpArguments<SsimArguments> a);
/// loss (), saved: as from ssim_map.
Results l1_ssim(L1SsimArguments a);
Results l1_ssim_vjp(VjpArguments<L1SsimArguments> a);

/// scales (N, 3), rotations (N, 4), opacities (N, 1)
Results activate(ActivateArguments a);
Results activate_vjp(VjpArguments<ActivateArguments> a);

/// loss (), image (3, H, W), radii (P,) int32, gradients: with respect to means, log_scales, quats, logit_opacities,
/// shs and, with mean_columns, means2D.
Results picture_gradients(PictureArguments a);

/// Nothing: writes to gradient_sums and views.
Results observe(ObserveArguments a);

/// Nothing: writes to params, exp_avgs and exp_avg_sqs.
Results adam(AdamArguments a);

/// Whether an op of this process has been called for which autograd will ask a gradient.
bool gradient_was_required();

}  // namespace ar::ops
