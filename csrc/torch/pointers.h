// Typed pointers into tensors. A missing or empty tensor gives null.
#pragma once

#include <ATen/core/Tensor.h>

#include <optional>

namespace ar::ops {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;

/// The scalar type of an Element: T of a Vec2<T>, else the type itself.
template <class Element> struct ScalarIn {
  using Type = Element;
};
template <template <class> class Vector, class T> struct ScalarIn<Vector<T>> {
  using Type = T;
};

template <class Element> const Element* const_pointer(const Tensor& t) {
  if (!t.defined() || t.numel() == 0) return nullptr;
  return reinterpret_cast<const Element*>(t.const_data_ptr<typename ScalarIn<Element>::Type>());
}
template <class Element> const Element* const_pointer(const OptionalTensor& t) {
  return t ? const_pointer<Element>(*t) : nullptr;
}
template <class Element> Element* pointer(const Tensor& t) {
  if (!t.defined() || t.numel() == 0) return nullptr;
  return reinterpret_cast<Element*>(t.data_ptr<typename ScalarIn<Element>::Type>());
}

}  // namespace ar::ops
