// The list of footprints. A new footprint is a header and an entry here.
#pragma once

#include <cstddef>
#include <cstring>
#include <string_view>
#include <type_traits>

#include "core/footprint/analytic.h"
#include "core/footprint/box.h"
#include "core/footprint/cumulant.h"
#include "core/footprint/erf.h"
#include "core/footprint/exact.h"
#include "core/footprint/mip.h"
#include "core/footprint/moment.h"
#include "core/footprint/point.h"

namespace ar {

using Footprints = FootprintList<Point, Mip, Analytic<FrameGradient::kFrozen>, Analytic<FrameGradient::kPaper>,
                                 Cumulant, Box<1>, Box<4>, Box<16>, Moment<1>, Moment<4>, Moment<16>, Erf, Exact>;

template <class F> constexpr const char* key_of() {
  if constexpr (std::is_same_v<decltype(F::kKey), const std::nullptr_t>) {
    return F::kName;
  } else {
    return F::kKey;
  }
}

template <class Function, class... F> AR_HD void for_each_footprint(FootprintList<F...>, Function&& f) {
  (f(F{}), ...);
}

template <class Function, class... F> AR_HD void visit_footprint(int index, FootprintList<F...>, Function&& f) {
  int place = 0;
  ((index == place++ ? (f(F{}), true) : false) || ...);
}

/// Index of the footprint with this key, or -1.
inline int find_footprint(std::string_view key) {
  int found = -1, place = 0;
  for_each_footprint(Footprints{}, [&](auto f) {
    if (key == key_of<decltype(f)>()) found = place;
    ++place;
  });
  return found;
}

}  // namespace ar
