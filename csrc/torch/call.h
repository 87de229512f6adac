// The class Call of _C, by which Python calls ops (ops.py; call.cpp). ops.cpp adds it.
#pragma once

#include <pybind11/pybind11.h>

namespace ar::ops {

void define_call(pybind11::module_& m);

}  // namespace ar::ops
