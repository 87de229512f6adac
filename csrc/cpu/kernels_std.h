// The standard headers of the loops. kernels_*.cpp include it before they switch the target, so that standard templates
// are compiled for the baseline.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string_view>
#include <vector>
