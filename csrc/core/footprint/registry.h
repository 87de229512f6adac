// Every footprint the library knows. A new one is a header and a line here.
#pragma once

#include <string_view>

#include "core/footprint/adaptive.h"
#include "core/footprint/analytic.h"
#include "core/footprint/box.h"
#include "core/footprint/cumulant.h"
#include "core/footprint/erf.h"
#include "core/footprint/exact.h"
#include "core/footprint/mip.h"
#include "core/footprint/point.h"

namespace ar {

using Footprints = FootprintList<Point, Mip, Analytic<FrameGradient::kFrozen>, Analytic<FrameGradient::kPaper>,
                                 Cumulant, Box<1>, Box<2>, Box<4>, Box<8>, Box<16>, Adaptive, Erf, Exact>;

/// Calls f(F{}) for the footprint whose kName is `name`; false if there is none.
template <class Function, class... F> bool visit_footprint(std::string_view name, FootprintList<F...>, Function&& f) {
  return ((name == F::kName ? (f(F{}), true) : false) || ...);
}

/// Calls f(F{}) for the footprint of the list that has so many samples.
template <class Function, class... F> void visit_samples(int samples, FootprintList<F...>, Function&& f) {
  ((samples == F::kSamples ? (f(F{}), true) : false) || ...);
}

/// Calls f(F{}) for every footprint of the list.
template <class Function, class... F> void for_each_footprint(FootprintList<F...>, Function&& f) { (f(F{}), ...); }

}  // namespace ar
