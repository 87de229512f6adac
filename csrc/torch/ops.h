// The ops, registered in ops.cpp, differentiable by autograd.cpp, cast to float32 by autocast.cpp. Comments list
// results in order.
#pragma once

#include <string>
#include <utility>
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

/// viewmatrix (C, 4, 4), projmatrix (C, 4, 4), campos (C, 3), lens (C, kLensWidth).
Results prepare_cameras(PrepareCamerasArguments a);
Results prepare_cameras_vjp(VjpArguments<PrepareCamerasArguments> a);
/// lens (kLensWidth,).
Results prepare_lens(PrepareLensArguments a);
Results prepare_lens_vjp(VjpArguments<PrepareLensArguments> a);
/// Angles up to which a lens is a map, and its Jacobian not clamped, rad; only an equirectangular lens needs `height`,
/// px.
double lens_fold(const std::string& model, const std::vector<double>& distortion);
double lens_reach(const std::string& model, const std::vector<double>& distortion, double tan_x, double tan_y, double x,
                  double y, int height);
/// What a lens makes of points (N, 3): see lens_points in Python.
std::pair<Tensor, Tensor> lens_points(const std::string& model, std::vector<double> distortion, const Tensor& points);

/// Rows, camera after camera: means2d, cov2d, opacities, depths, features (K,); radii, gaussian_ids, camera_ids, int32;
/// row_splits (C + 1,) int64 on the CPU; dets; of a RowMeasure conics (3,) and shown_opacities, else empty; saved: what
/// RowPlaces reads.
Results project(ProjectArguments a);
Results project_vjp(VjpArguments<ProjectArguments> a);

/// image (C, H, W, K), alpha (C, H, W, 1), saved: by camera ListTensors and BlendState; of `expected` alpha and depth.
Results composite(CompositeArguments a);
Results composite_vjp(VjpArguments<CompositeArguments> a);

/// Rows: means2d, cov2d, opacities, depths, colors, beside; radii, gaussian_ids, camera_ids, dets, row_splits; saved.
Results repeat_at_seam(SeamArguments a);
Results repeat_at_seam_vjp(VjpArguments<SeamArguments> a);
/// Of rows of copies the sums over those of each of `counts` (n,), in order.
Tensor summed_copies(const Tensor& of_copies, const Tensor& counts);

/// ends (C, P) int32: how many Gaussians up to each one have a row.
Results count_rows(BatchArguments a);
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

/// The same summary, of the splats of `bin`: of depths as given, and ids that are rows.
Results inspect(InspectArguments a);

Results footprint_weight(WeightArguments a);
Results footprint_weight_vjp(VjpArguments<WeightArguments> a);

/// map (..., H, W), saved: with `keep` (kSsimPartials, ..., H, W) derivatives.
Results ssim_map(SsimArguments a);
Results ssim_map_vjp(VjpArguments<SsimArguments> a);
/// loss (), saved: the same.
Results l1_ssim(L1SsimArguments a);
Results l1_ssim_vjp(VjpArguments<L1SsimArguments> a);

/// scales (N, 3), rotations (N, 4), opacities (N, 1), penalty: () or without weights empty.
Results activate(ActivateArguments a);
Results activate_vjp(VjpArguments<ActivateArguments> a);

/// filtered_scales (P, 3), filtered_opacities as opacities.
Results apply_3d_filter(FilterArguments a);
Results apply_3d_filter_vjp(VjpArguments<FilterArguments> a);

/// corrected (3, H, W).
Results correct_colors(CorrectArguments a);
Results correct_colors_vjp(VjpArguments<CorrectArguments> a);

/// loss (); image (3, H, W) as compared with the target, but for the mask; radii (P,) int32; gradients: of means,
/// log_scales, quats, logit_opacities, shs, with mean_columns means2D, with an exposure its matrix.
Results picture_gradients(PictureArguments a);
/// loss (); image (3, H, W); dL_drows (n, kPackedGradWidth or kPackedGradWidthAbsolute).
Results rows_picture_gradients(RowsPictureArguments a);

/// Writes gradient_sums, views.
Results observe(ObserveArguments a);
/// Writes means.
Results add_noise(NoiseArguments a);

/// Writes params, exp_avgs, exp_avg_sqs.
Results adam(AdamArguments a);

/// Whether autograd may have asked for a gradient.
bool gradient_was_required();

}  // namespace ar::ops
