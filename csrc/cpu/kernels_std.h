// The standard headers that the loops use. kernels_*.cpp include them before they switch the target,
// so that what these headers instantiate stays within the baseline instruction set.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string_view>
#include <vector>
