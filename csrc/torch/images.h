// What is blended and the images that are made of it: their names, their memory, and the views that kernels get of
// both.
#pragma once

#include <ATen/ops/empty.h>

#include <array>

#include "core/stages.h"
#include "torch/pointers.h"

namespace ar::ops {

/// The images that `rasterize` can make besides the colours, in the order of its switches and of its result `images`.
/// Python reads their names (_C.IMAGES).
enum ImageIndex : size_t { kAlpha, kDepth, kInverseDepth, kImageCount };
inline constexpr std::array<const char*, kImageCount> kImageSwitches = {"alpha=False", "depth=False",
                                                                        "inverse_depth=False"};
/// Which of them are wanted.
using ImageSwitches = std::array<bool, kImageCount>;

/// Images, or gradients with respect to them; those are undefined where they are zero.
struct ImageTensors {
  Tensor color;                            ///< (C, H, W) of C colour channels, which features are too
  std::array<Tensor, kImageCount> others;  ///< (H, W); undefined where nobody wants them
};

/// What is blended: a row of channels for every splat or Gaussian.
struct ChannelTensors {
  Tensor rows;             ///< (m, count) contiguous; undefined: the three colours in the splats
  bool by_gaussian;        ///< a row per Gaussian; else per splat
  int64_t count;           ///< of channels
  int64_t color_channels;  ///< the first ones; each of the others makes an image of its own
  Tensor background;       ///< (count,)
  Tensor given;            ///< (m, k) those of `rows` that the caller gave; undefined: none
  int first_given = 0;     ///< their first column
  /// Columns of `rows` that `project` fills, -1 where it does not (ChannelRows in core/stages.h).
  int color = -1, depth = -1, inverse_depth = -1;

  bool made_by_projection() const { return color >= 0 || depth >= 0 || inverse_depth >= 0; }
  /// The projection makes all of them, and nobody else looks at their gradient.
  bool only_made_by_projection() const { return made_by_projection() && !given.defined(); }
};

inline ImageTensors make_images(const ChannelTensors& channels, const ImageSwitches& wanted, TileGrid grid) {
  const at::TensorOptions options = channels.background.options();
  ImageTensors out;
  out.color = at::empty({channels.color_channels, grid.height, grid.width}, options);
  for (size_t k = 0; k < kImageCount; ++k) {
    if (wanted[k]) out.others[k] = at::empty({grid.height, grid.width}, options);
  }
  return out;
}

/// The image of every channel.
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

/// Sets what `blend` writes.
template <typename T> void set_images(BlendParams<T>& p, const ImageTensors& image, const ChannelTensors& channels) {
  p.image = planes_of<T>(image, channels);
  p.alpha = pointer<T>(image.others[kAlpha]);
}
/// Sets the gradients that `blend_vjp` reads.
template <typename T>
void set_images(BlendVjpParams<T>& p, const ImageTensors& dL_dimage, const ChannelTensors& channels) {
  p.dL_dimage = planes_of<const T>(dL_dimage, channels);
  p.dL_dalpha = const_pointer<T>(dL_dimage.others[kAlpha]);
}

/// The rows that `project` fills, or with a const T the gradient with respect to them in `rows`.
template <typename T> ChannelRows<T> channel_rows(const Tensor& rows, const ChannelTensors& channels) {
  if (!channels.made_by_projection()) return {nullptr, 0, -1, -1, -1};
  return {const_cast<T*>(const_pointer<std::remove_const_t<T>>(rows)), rows.defined() ? rows.size(1) : 0,
          channels.color, channels.depth, channels.inverse_depth};
}

}  // namespace ar::ops
