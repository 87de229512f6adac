// The standard headers of the loops, included before the target is switched: their templates are compiled for the
// baseline.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string_view>
#include <vector>
