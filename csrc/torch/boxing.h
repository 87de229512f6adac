// The structs of arguments.h as torch's dispatcher has arguments: as text in a schema, and as values on a stack.
#pragma once

#include <ATen/core/ivalue.h>
#include <ATen/core/stack.h>

#include <string>
#include <string_view>
#include <vector>

#include "torch/training_arguments.h"

namespace ar::ops {

using c10::IValue;

template <class Value> std::string type_in_schema(const Value&) { return c10::getTypePtr<Value>()->str(); }
template <char kLetter> std::string type_in_schema(const WrittenTensors<kLetter>&) {
  return std::string("Tensor(") + kLetter + "!)[]";
}

template <char kLetter> std::string type_in_schema(const WrittenTensor<kLetter>&) {
  return std::string("Tensor(") + kLetter + "!)";
}

/// "Tensor means3D, Tensor? means2D, ...".
template <class Arguments> std::string schema_of() {
  std::string text;
  Arguments().each([&](std::string_view declaration, auto& value) {
    text += (text.empty() ? "" : ", ") + type_in_schema(value) + " " + std::string(declaration);
  });
  return text;
}

template <class Value> void assign(const IValue& from, Value& to) { to = from.to<Value>(); }
/// Autograd passes a missing tensor as an undefined one.
inline void assign(const IValue& from, OptionalTensor& to) {
  to = from.isTensor() && from.toTensor().defined() ? OptionalTensor(from.toTensor()) : std::nullopt;
}
inline void assign(const IValue& from, std::vector<OptionalTensor>& to) {
  to.clear();
  for (const OptionalTensor& t : from.toOptionalTensorVector()) to.push_back(t && t->defined() ? t : std::nullopt);
}
template <char kLetter> void assign(const IValue& from, WrittenTensors<kLetter>& to) {
  static_cast<std::vector<Tensor>&>(to) = from.toTensorVector();
}
template <char kLetter> void assign(const IValue& from, WrittenTensor<kLetter>& to) {
  static_cast<Tensor&>(to) = from.toTensor();
}

template <class Arguments> Arguments take(torch::jit::Stack& stack) {
  Arguments arguments;
  size_t count = 0;
  arguments.each([&](std::string_view, auto&) { ++count; });
  const IValue* next = stack.data() + (stack.size() - count);
  arguments.each([&](std::string_view, auto& value) { assign(*next++, value); });
  torch::jit::drop(stack, count);
  return arguments;
}

}  // namespace ar::ops
