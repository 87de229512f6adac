// The class Call of _C: calls an op of many arguments faster than torch.ops, which reads the schema every time.
// Autograd and tracing modes work; __torch_function__ does not.
#include "torch/call.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <pybind11/stl.h>
#include <torch/csrc/autograd/python_variable.h>
#include <torch/csrc/Exceptions.h>

#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace ar::ops {
namespace {

namespace py = pybind11;
using c10::IValue;

struct Parameter {
  py::str name;
  bool may_be_none;
  c10::TypeKind kind, element = c10::TypeKind::AnyType;  ///< The latter of a list.
  std::optional<IValue> default_value;

  explicit Parameter(const c10::Argument& argument)
      : name(py::reinterpret_steal<py::str>(PyUnicode_InternFromString(argument.name().c_str()))),
        may_be_none(argument.type()->kind() == c10::TypeKind::OptionalType),
        default_value(argument.default_value()) {
    c10::TypePtr type = argument.type();
    if (may_be_none) type = type->expectRef<c10::OptionalType>().getElementType();
    kind = type->kind();
    if (kind == c10::TypeKind::ListType) element = type->containedType(0)->kind();
  }

  IValue value_of(py::handle given) const {
    if (may_be_none && given.is_none()) return IValue();
    switch (kind) {
      case c10::TypeKind::TensorType:
        if (!THPVariable_Check(given.ptr()))
          throw py::type_error(std::string(name) + " must be a tensor, got " + Py_TYPE(given.ptr())->tp_name);
        return THPVariable_Unpack(given.ptr());
      case c10::TypeKind::IntType:
        return cast<int64_t>(given, "an int");
      case c10::TypeKind::FloatType:
        return cast<double>(given, "a float");
      case c10::TypeKind::BoolType:
        return cast<bool>(given, "a bool");
      case c10::TypeKind::StringType:
        return cast<std::string>(given, "a string");
      case c10::TypeKind::ListType:
        return list_of(given);
      default:
        throw py::type_error(std::string(name) + " is of a type that Call does not take");
    }
  }

 private:
  IValue list_of(py::handle given) const {
    if (element == c10::TypeKind::FloatType) return cast<std::vector<double>>(given, "a list of floats");
    if (element == c10::TypeKind::IntType) return cast<std::vector<int64_t>>(given, "a list of ints");
    if (element != c10::TypeKind::TensorType || !PySequence_Check(given.ptr()))
      throw py::type_error(std::string(name) + " is of a type that Call does not take");
    c10::List<at::Tensor> tensors;
    for (const py::handle& item : py::reinterpret_borrow<py::sequence>(given)) {
      if (!THPVariable_Check(item.ptr())) throw py::type_error(std::string(name) + " must hold tensors");
      tensors.push_back(THPVariable_Unpack(item.ptr()));
    }
    return tensors;
  }
  template <class Value> Value cast(py::handle given, const char* what) const {
    try {
      return given.cast<Value>();
    } catch (const py::cast_error&) {
      if (std::is_arithmetic_v<Value> && PyLong_Check(given.ptr()))
        throw py::value_error(std::string(name) + " must fit in 64 bits, got " + std::string(py::str(given)));
      throw py::type_error(std::string(name) + " must be " + what + ", got " + Py_TYPE(given.ptr())->tp_name);
    }
  }
};

py::object object_of(const at::Tensor& tensor) { return py::reinterpret_steal<py::object>(THPVariable_Wrap(tensor)); }

py::object object_of(const IValue& value) {
  if (value.isTensor()) return object_of(value.toTensor());
  const c10::List<at::Tensor> tensors = value.toTensorList();
  py::list list(tensors.size());
  for (size_t k = 0; k < tensors.size(); ++k) list[k] = object_of(tensors.get(k));
  return list;
}

class Call {
 public:
  explicit Call(const std::string& name)
      : op_(c10::Dispatcher::singleton().findSchemaOrThrow(("analytic_rasterizer::" + name).c_str(), "")) {
    for (const c10::Argument& argument : op_.schema().arguments()) parameters_.emplace_back(argument);
  }

  py::tuple operator()(const py::args& by_position, const py::kwargs& by_name) const {
    HANDLE_TH_ERRORS
    torch::jit::Stack stack;
    stack.reserve(parameters_.size());
    size_t used = 0;
    for (const Parameter& parameter : parameters_) {
      const size_t k = stack.size();
      PyObject* given = k < by_position.size() ? PyTuple_GET_ITEM(by_position.ptr(), Py_ssize_t(k))
                                               : PyDict_GetItemWithError(by_name.ptr(), parameter.name.ptr());
      used += given != nullptr;
      if (given) {
        stack.push_back(parameter.value_of(given));
      } else if (parameter.default_value) {
        stack.push_back(*parameter.default_value);
      } else {
        fail("needs the argument " + std::string(parameter.name));
      }
    }
    if (used != by_position.size() + by_name.size()) fail_with_more(by_position, by_name);
    {
      const py::gil_scoped_release no_gil;
      op_.callBoxed(stack);
    }
    py::tuple results(stack.size());
    for (size_t k = 0; k < stack.size(); ++k) results[k] = object_of(stack[k]);
    return results;
    END_HANDLE_TH_ERRORS_PYBIND
  }

 private:
  [[noreturn]] void fail_with_more(const py::args& by_position, const py::kwargs& by_name) const {
    for (const auto& [name, value] : by_name) {
      bool free = false;
      for (size_t k = by_position.size(); k < parameters_.size(); ++k) free = free || parameters_[k].name.equal(name);
      if (!free) fail("got " + std::string(py::str(name)) + ", which it does not have, or has by its place");
    }
    fail("takes " + std::to_string(parameters_.size()) + " arguments, got " + std::to_string(by_position.size()));
  }
  [[noreturn]] void fail(const std::string& why) const { throw py::type_error(op_.schema().name() + " " + why); }

  c10::OperatorHandle op_;
  std::vector<Parameter> parameters_;
};

}  // namespace

void define_call(py::module_& m) {
  py::class_<Call>(m, "Call",
                   "An op of torch.ops.analytic_rasterizer, which returns a tuple of its results. Takes the host less "
                   "time than torch.ops; torch.compile and __torch_function__ do not know it.")
      .def(py::init<const std::string&>(), py::arg("name"))
      .def("__call__", &Call::operator());
}

}  // namespace ar::ops
