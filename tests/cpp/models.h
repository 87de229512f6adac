// Every footprint of the registry behind function pointers, compiled once for all tests (models.cpp).
#pragma once

#include <gtest/gtest.h>

#include <ostream>
#include <string>
#include <vector>

#include "core/stages.h"

namespace ar::test {

/// The functions of core/footprint/contract.h on rows whose footprint is known at run time. A row's opacity counts.
template <typename T> struct Model {
  void (*prepare)(Cov2d<T> cov, FootprintOptions options, SplatRow<T>& row);
  T (*level)(const SplatRow<T>& row);
  Mat2<T> (*ellipse)(const SplatRow<T>& row);
  Mat2<T> (*mean_map)(const SplatRow<T>& row);
  /// Of every sample at offset d.
  void (*alphas)(const SplatRow<T>& row, Vec2<T> d, T* alphas);
  /// The sums of one pixel, as add_alpha_vjp leaves them.
  ShapeGrad<T> (*sums)(const SplatRow<T>& row, Vec2<T> d, const T* dL_dalphas);
  /// Of sample s with the pixel centre at offset d, displacement included; see contract.h. Samples of most footprints
  /// do not move.
  T (*alpha)(const SplatRow<T>& row, Vec2<T> d, int s);
  Vec2<T> (*move)(const SplatRow<T>& row, Vec2<T> d, int s, T alpha, Vec2<T> moved);
  MoveGrad<T> (*alpha_and_move_vjp)(const SplatRow<T>& row, Vec2<T> d, int s, T alpha, bool free, T dL_dalpha,
                                    Vec2<T> moved, Vec2<T>& dL_dmoved);
  SplatGrad<T> (*prepare_vjp)(Cov2d<T> cov, const SplatRow<T>& row, ShapeGrad<T> sums, T weighted,
                              FootprintOptions options);
};

struct Footprint {
  std::string name;  ///< key, with letters and digits only
  int index, samples;
  double reach, move_reach, extra_level;
  FootprintOptions options;  ///< the public default
  double (*support_variance)(FootprintOptions options);
  Vec2<double> (*node)(int sample);  ///< of the footprints that take alpha at nodes; else the pixel's centre
  Model<float> in_float;
  Model<double> in_double;

  template <typename T> const Model<T>& model() const {
    if constexpr (sizeof(T) == sizeof(float)) {
      return in_float;
    } else {
      return in_double;
    }
  }
  FootprintChoice choice() const { return {index, options}; }

  template <typename T> SplatRow<T> row(Cov2d<T> cov, T opacity = T(1)) const {
    SplatRow<T> out = {};
    model<T>().prepare(cov, options, out);
    out.opacity = opacity;
    return out;
  }

  bool is(const char* other) const { return name == other; }
  bool is_analytic() const { return is("analytic") || is("analytic_paper"); }
  bool is_normal() const { return is("erf") || is("exact"); }
  /// Whether the adjoint holds the pixel's frame fixed, which is not the formula's derivative.
  bool is_frozen() const { return is("analytic") || is("erf"); }
};
inline void PrintTo(const Footprint& footprint, std::ostream* out) { *out << footprint.name; }

const std::vector<Footprint>& footprints();
const Footprint& footprint_named(const char* name);

/// Tests of all footprints: class FooTest : public ::testing::TestWithParam<Footprint>; AR_ALL_FOOTPRINTS(FooTest).
#define AR_ALL_FOOTPRINTS(Suite)                                             \
  INSTANTIATE_TEST_SUITE_P(, Suite, ::testing::ValuesIn(test::footprints()), \
                           [](const auto& info) { return info.param.name; })

}  // namespace ar::test
