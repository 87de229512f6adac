// The class Call of _C, by which Python calls ops (ops.py; call.cpp).
#pragma once

#include <pybind11/pybind11.h>

namespace ar::ops {

void define_call(pybind11::module_& m);

}  // namespace ar::ops
