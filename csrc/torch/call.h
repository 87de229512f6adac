// Ops as Python calls them where every microsecond counts.
#pragma once

#include <pybind11/pybind11.h>

namespace ar::ops {

/// Adds the class Call to the module.
void define_call(pybind11::module_& m);

}  // namespace ar::ops
