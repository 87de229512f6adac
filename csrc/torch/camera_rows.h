// Selects the rows of one camera, for ops with several.
#pragma once

#include "torch/backend.h"

namespace ar::ops {

/// By row_splits (C + 1,); undefined where `t` is.
inline Tensor rows_of(const Tensor& t, const Tensor& row_splits, int64_t c) {
  if (!t.defined() || row_splits.numel() == 2) return t;  // of one camera all
  const int64_t* splits = row_splits.const_data_ptr<int64_t>();
  return t.slice(0, splits[c], splits[c + 1]);
}

/// What of an op's arguments describes the shapes of rows.
template <class Arguments> RowTensors shapes_of(const Arguments& a, int64_t c) {
  RowTensors rows;
  rows.means2d = rows_of(a.means2d, a.row_splits, c);
  rows.cov2d = rows_of(a.cov2d, a.row_splits, c);
  rows.dets = rows_of(a.dets, a.row_splits, c);
  rows.opacities = rows_of(a.opacities, a.row_splits, c);
  return rows;
}

/// Channels (n, K) of rows, before a background (K,).
inline ChannelTensors row_channels(const Tensor& features, const Tensor& background) {
  ChannelTensors channels;
  channels.rows = features;
  channels.by_gaussian = false;
  channels.count = channels.color_channels = features.size(1);
  channels.background = background;
  return channels;
}

}  // namespace ar::ops
