#include "models.h"

#include "core/bin.h"

namespace ar::test {
namespace {

template <class F, typename T> Splat<F, T> splat_of(const SplatRow<T>& row) {
  Splat<F, T> splat;
  static_assert(sizeof splat == sizeof row, "padding would hold whatever was in memory, and torch would see it");
  std::memcpy(static_cast<void*>(&splat), &row, sizeof splat);
  return splat;
}

template <class F, typename T> auto terms_of(const SplatRow<T>& row) {
  return F::terms(splat_of<F>(row).shape, row.opacity);
}

/// Of F, blended as P: the same for the footprints that name no other.
template <class F, class P, typename T> Model<T> make_model() {
  Model<T> m;
  m.prepare = [](Cov2d<T> cov, FootprintOptions options, SplatRow<T>& row) {
    set_shape<F>(row, F::prepare(cov, options));
  };
  m.level = [](const SplatRow<T>& row) { return F::level(shape_of<F>(row), row.opacity); };
  m.ellipse = [](const SplatRow<T>& row) { return F::ellipse(shape_of<F>(row)); };
  m.mean_map = [](const SplatRow<T>& row) { return P::mean_map(shape_of<P>(row)); };
  m.alphas = [](const SplatRow<T>& row, Vec2<T> d, T* alphas) {
    const auto terms = terms_of<P>(row);
    for (int s = 0; s < P::kSamples; ++s) alphas[s] = P::alpha(terms, d, s);
  };
  m.sums = [](const SplatRow<T>& row, Vec2<T> d, const T* dL_dalphas) {
    const auto terms = terms_of<P>(row);
    ShapeGrad<T> sums = {};
    for (int s = 0; s < P::kSamples; ++s)
      P::add_alpha_vjp(terms, d, s, AlphaGrad<T>{dL_dalphas[s], P::alpha(terms, d, s) * dL_dalphas[s]}, sums);
    return sums;
  };
  m.alpha = [](const SplatRow<T>& row, Vec2<T> d, int s) { return P::alpha(terms_of<P>(row), d, s); };
  m.move = [](const SplatRow<T>& row, Vec2<T> d, int s, T alpha, Vec2<T> moved) {
    if constexpr (P::kMoves) return P::move(terms_of<P>(row), d, s, alpha, moved);
    return moved;
  };
  m.alpha_and_move_vjp = [](const SplatRow<T>& row, Vec2<T> d, int s, T alpha, bool free, T dL_dalpha, Vec2<T> moved,
                            Vec2<T>& dL_dmoved) {
    const auto terms = terms_of<P>(row);
    if constexpr (P::kMoves) {
      return P::alpha_and_move_vjp(terms, d, s, alpha, free, dL_dalpha, moved, dL_dmoved);
    } else {
      MoveGrad<T> grad = {};
      if (!free) return grad;
      P::add_alpha_vjp(terms, d, s, AlphaGrad<T>{dL_dalpha, alpha * dL_dalpha}, grad.sums);
      grad.weighted = alpha * dL_dalpha;
      return grad;
    }
  };
  m.prepare_vjp = [](Cov2d<T> cov, const SplatRow<T>& row, ShapeGrad<T> sums, T weighted, FootprintOptions options) {
    return F::prepare_vjp(cov, shape_of<F>(row), sums, weighted, options);
  };
  return m;
}

}  // namespace

const std::vector<Footprint>& footprints() {
  static const std::vector<Footprint> all = [] {
    std::vector<Footprint> list;
    for_each_footprint(Footprints{}, [&](auto f) {
      using F = decltype(f);
      using P = PixelsOf<F>;
      Footprint one;
      one.name = key_of<F>();
      one.index = int(list.size());
      one.samples = F::kSamples;
      one.reach = F::kReach;
      one.move_reach = 0;
      if constexpr (F::kMoves) one.move_reach = F::kMoveReach;
      one.extra_level = F::kExtraLevel;
      one.options = {F::kOption.number};
      one.support_variance = [](FootprintOptions options) { return F::support_variance(options); };
      one.node = [](int sample) {
        if constexpr (F::kMoves) {
          return F::node(sample);
        } else if constexpr (F::kSamples > 1) {
          return box_node<F::kSamples>(sample);
        } else {
          return Vec2<double>{0, 0};
        }
      };
      one.in_float = make_model<F, P, float>();
      one.in_double = make_model<F, P, double>();
      list.push_back(one);
    });
    return list;
  }();
  return all;
}

const Footprint& footprint_named(const char* name) { return footprints()[find_footprint(name)]; }

}  // namespace ar::test
