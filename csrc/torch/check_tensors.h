// Checks of shapes, dtypes and devices, with one wording.
#pragma once

#include <algorithm>
#include <initializer_list>
#include <sstream>
#include <string>

#include "torch/arguments.h"

namespace ar::ops {

inline std::string text_of(at::IntArrayRef sizes) {
  std::ostringstream out;
  out << "(";
  for (size_t d = 0; d < sizes.size(); ++d) out << (d ? ", " : "") << sizes[d];
  out << (sizes.size() == 1 ? ",)" : ")");
  return out.str();
}
inline std::string shape_of(const Tensor& t) { return text_of(t.sizes()); }

/// The end of a message about a dtype: what to do with 16 bits.
inline const char* way_out_of(at::ScalarType type) {
  const bool is_half = type == at::kHalf || type == at::kBFloat16;
  return is_half ? ": call .float() on it, or use torch.autocast, under which this happens by itself" : "";
}

inline void check_floating(const Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must have dtype float32 or float64, got ", t.scalar_type(), way_out_of(t.scalar_type()));
}

template <class... Text> void check_shape(bool ok, const Tensor& t, const char* name, const Text&... expected) {
  TORCH_CHECK_VALUE(ok, name, " must have shape ", expected..., ", got ", shape_of(t));
}

/// Shape (count, row...), written as `expected` in the message.
inline void check_rows(const Tensor& t, const char* name, int64_t count, std::initializer_list<int64_t> row,
                       const char* expected) {
  const bool ok = t.dim() == int64_t(1 + row.size()) && t.size(0) == count &&
                  std::equal(row.begin(), row.end(), t.sizes().begin() + 1);
  check_shape(ok, t, name, expected, " with ", expected[1], " = ", count);
}

/// The tensor that others must match in dtype and device. The checked tensors become contiguous.
struct Like {
  const Tensor& tensor;
  const char* name;

  void check_type(const Tensor& t, const char* t_name) const {
    TORCH_CHECK_TYPE(t.scalar_type() == tensor.scalar_type(), t_name, " must have the dtype of ", name, ", ",
                     tensor.scalar_type(), ", got ", t.scalar_type(), way_out_of(t.scalar_type()));
    TORCH_CHECK_VALUE(t.device() == tensor.device(), t_name, " must be on the device of ", name, ", ", tensor.device(),
                      ", got ", t.device());
  }
  /// As many rows as `tensor`.
  void check_rows_of(Tensor& t, const char* t_name, std::initializer_list<int64_t> row, const char* expected) const {
    check_type(t, t_name);
    check_rows(t, t_name, tensor.size(0), row, expected);
    t = t.contiguous();
  }
  void check_rows_of(OptionalTensor& t, const char* t_name, std::initializer_list<int64_t> row,
                     const char* expected) const {
    if (t) check_rows_of(*t, t_name, row, expected);
  }
  /// As many rows as `tensor`, and 1 to `most` columns. The message calls their numbers `rows` and `columns`.
  void check_channels(Tensor& t, const char* t_name, char rows, char columns, int64_t most) const {
    check_type(t, t_name);
    const bool ok = t.dim() == 2 && t.size(0) == tensor.size(0) && t.size(1) >= 1 && t.size(1) <= most;
    check_shape(ok, t, t_name, "(", rows, ", ", columns, ") with ", rows, " = ", tensor.size(0), " and ", columns,
                " from 1 to ", most);
    t = t.contiguous();
  }
  void check_matrix(Tensor& t, const char* t_name) const {
    check_type(t, t_name);
    const bool ok = (t.dim() == 2 || (t.dim() == 3 && t.size(0) == 1)) && t.size(-1) == 4 && t.size(-2) == 4;
    check_shape(ok, t, t_name, "(4, 4) or (1, 4, 4)");
    if (t.dim() == 3) t = t.reshape({4, 4});
    t = t.contiguous();
  }
  void check_vector(Tensor& t, const char* t_name, int64_t size) const {
    check_type(t, t_name);
    const bool ok = t.numel() == size && (t.dim() == 1 || (t.dim() == 2 && t.size(0) == 1));
    check_shape(ok, t, t_name, "(", size, ",) or (1, ", size, ")");
    if (t.dim() == 2) t = t.reshape({size});
    t = t.contiguous();
  }
};

}  // namespace ar::ops
