// The images of a rendering, and the channels that they are blended from.
#pragma once

#include <array>

#include "core/stages.h"
#include "torch/pointers.h"

namespace ar::ops {

/// Images besides the colours, in the order of `rasterize`: _C.IMAGES.
enum ImageIndex : size_t { kAlpha, kDepth, kInverseDepth, kImageCount };
inline constexpr std::array<const char*, kImageCount> kImageSwitches = {"alpha=False", "depth=False",
                                                                        "inverse_depth=False"};
using ImageSwitches = std::array<bool, kImageCount>;

/// What a picture shows, without gradient, in the order of the ops' results.
enum SummaryIndex : size_t { kMedianDepth, kDominantIndex, kGaussianStats, kSummaryCount };
inline constexpr std::array<const char*, kSummaryCount> kSummarySwitches = {
    "median_depth=False", "dominant_index=False", "gaussian_stats=False"};
using SummarySwitches = std::array<bool, kSummaryCount>;
inline bool any_of(const SummarySwitches& wanted) {
  return wanted[kMedianDepth] || wanted[kDominantIndex] || wanted[kGaussianStats];
}

/// Images, or their gradients. Undefined: not wanted, or zero.
struct ImageTensors {
  Tensor color;                            ///< (C, H, W), with features.
  std::array<Tensor, kImageCount> others;  ///< (H, W).
};

/// A row of channels per Gaussian, or else per splat. The first `color_channels` make one image, the others one each.
struct ChannelTensors {
  Tensor rows;  ///< (m, count). Undefined: the three colours in the splats.
  bool by_gaussian;
  int64_t count;
  int64_t color_channels;
  Tensor background;    ///< (count,).
  Tensor given;         ///< (m, k): the caller's columns of `rows`, if any.
  int first_given = 0;  ///< Their first.
  /// Columns that `project` fills (ChannelRows in core/stages.h), or -1.
  int color = -1, depth = -1, inverse_depth = -1;

  bool made_by_projection() const { return color >= 0 || depth >= 0 || inverse_depth >= 0; }
  /// Then only project_vjp reads the gradient of `rows`.
  bool only_made_by_projection() const { return made_by_projection() && !given.defined(); }
};

template <typename T> Planes<T> planes_of(const ImageTensors& image, const ChannelTensors& channels) {
  const auto plane = [](const Tensor& t) { return const_cast<T*>(const_pointer<std::remove_const_t<T>>(t)); };
  Planes<T> planes = {};
  planes.first = plane(image.color);
  planes.split = int(channels.color_channels);
  if (channels.depth >= 0) planes.extra[channels.depth - planes.split] = plane(image.others[kDepth]);
  if (channels.inverse_depth >= 0)
    planes.extra[channels.inverse_depth - planes.split] = plane(image.others[kInverseDepth]);
  return planes;
}

template <typename T> void set_images(BlendParams<T>& p, const ImageTensors& image, const ChannelTensors& channels) {
  p.image = planes_of<T>(image, channels);
  p.alpha = pointer<T>(image.others[kAlpha]);
}
template <typename T>
void set_images(BlendVjpParams<T>& p, const ImageTensors& dL_dimage, const ChannelTensors& channels) {
  p.dL_dimage = planes_of<const T>(dL_dimage, channels);
  p.dL_dalpha = const_pointer<T>(dL_dimage.others[kAlpha]);
}

/// What `project` fills, or for a const T its gradient.
template <typename T> ChannelRows<T> channel_rows(const Tensor& rows, const ChannelTensors& channels) {
  if (!channels.made_by_projection()) return {nullptr, 0, -1, -1, -1};
  return {const_cast<T*>(const_pointer<std::remove_const_t<T>>(rows)), rows.defined() ? rows.size(1) : 0,
          channels.color, channels.depth, channels.inverse_depth};
}

}  // namespace ar::ops
