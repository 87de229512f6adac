// The ops, each for all devices. The pass is in rasterize.cpp, stages in stages.cpp, rows for several ranks in
// packed.cpp, and a training step in training.cpp and picture.cpp. They are registered in ops.cpp, made differentiable
// in autograd.cpp and cast to float32 in autocast.cpp. Comments list results in the order of the schema.
#pragma once

#include <vector>

#include "torch/boxing.h"

namespace ar::ops {

/// `saved` is for the adjoint, which returns a gradient per tensor argument, empty if not wanted.
using Results = std::vector<IValue>;

/// color (C + K, H, W): colours and features; images (H, W), if wanted; radii (P,) int32; summary: what is
/// wanted of SummaryTensors, `total` as sums of weights in the scene's dtype; saved, which is always the last.
Results rasterize(RasterizeArguments a);
/// The same; seconds (3,) float64 of project, bin and blend. Always saves the lists.
Results rasterize_timed(RasterizeArguments a);
Results rasterize_vjp(VjpArguments<RasterizeArguments> a);

/// Rows, camera after camera: means2d, cov2d, opacities, depths, colors; radii, gaussian_ids, camera_ids, int32;
/// row_splits (C + 1,) int64 on the CPU; saved: dets, gaussian_ids, row_splits.
Results project(ProjectArguments a);
Results project_vjp(VjpArguments<ProjectArguments> a);

/// ends (C, P) int32: how many Gaussians up to each one have a row.
Results count_rows(ProjectArguments a);
/// Writes rows, radii, ids.
Results pack_rows(PackArguments a);
Results pack_rows_vjp(PackVjpArguments a);
/// image (3, H, W), alpha (H, W), saved: with `keep` ListTensors, BlendState and KeptRows.
Results blend_rows(BlendRowsArguments a);
/// dL_dbackground (3,) or empty. Writes dL_drows.
Results blend_rows_vjp(BlendRowsVjpArguments a);

/// ListTensors, camera after camera.
Results bin(BinArguments a);

/// image (C, K, H, W), alpha (C, H, W), saved: BlendState, camera after camera.
Results blend(BlendArguments a);
Results blend_vjp(VjpArguments<BlendArguments> a);

/// The same summary, of the splats of `bin`: medians of the depths that are given, and ids that are rows.
Results inspect(InspectArguments a);

Results footprint_weight(WeightArguments a);
Results footprint_weight_vjp(VjpArguments<WeightArguments> a);

/// map (..., H, W), saved: with `keep` (kSsimPartials, ..., H, W) derivatives.
Results ssim_map(SsimArguments a);
Results ssim_map_vjp(VjpArguments<SsimArguments> a);
/// loss (), saved: the same.
Results l1_ssim(L1SsimArguments a);
Results l1_ssim_vjp(VjpArguments<L1SsimArguments> a);

/// scales (N, 3), rotations (N, 4), opacities (N, 1).
Results activate(ActivateArguments a);
Results activate_vjp(VjpArguments<ActivateArguments> a);

/// corrected (3, H, W).
Results correct_colors(CorrectArguments a);
Results correct_colors_vjp(VjpArguments<CorrectArguments> a);

/// loss (), image (3, H, W), corrected; radii (P,) int32; gradients: of means, log_scales, quats, logit_opacities, shs,
/// with mean_columns means2D, with an exposure its matrix.
Results picture_gradients(PictureArguments a);

/// Writes gradient_sums, views.
Results observe(ObserveArguments a);

/// Writes params, exp_avgs, exp_avg_sqs.
Results adam(AdamArguments a);

/// Whether autograd may have asked this process for a gradient.
bool gradient_was_required();

}  // namespace ar::ops
