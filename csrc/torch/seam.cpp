// The op repeat_at_seam: rows of equirectangular pictures, whose left and right borders are one line, with a row for
// every place at which a splat may show (docs/internals/numerics.md, "Equirectangular pictures"). And its adjoint. A
// splat wider than the turn overlaps itself: the opacity of its copies is lowered, to be together what it was at the
// centre.
#include <ATen/ops/arange.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/exp.h>
#include <ATen/ops/expm1.h>
#include <ATen/ops/log1p.h>
#include <ATen/ops/segment_reduce.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/where.h>
#include <ATen/ops/zeros.h>
#include <ATen/ops/zeros_like.h>

#include <iterator>

#include "core/project.h"
#include "torch/checks.h"
#include "torch/ops.h"
#include "torch/scene_grads.h"

namespace ar::ops {
namespace {

// Standard deviations along a row of pixels, in turns. Wider splats are narrowed to the first: their copies together
// vary by 2% at most. Narrower than the second, copies do not overlap: exp(-32) is rounding.
constexpr double kWidest = 0.75, kOverlapping = 0.125;
constexpr double kOpaque = 1 - 1e-6;  // The logarithm of 1 - opacity has to be finite.
constexpr int kSteps = 6;             // Of Newton's method, for the opacity of copies.
constexpr int kNeighbours = 4;        // Copies on one side that overlap a splat of the largest width.

/// Every copy's covariance. Tensors have a number for each splat.
struct Narrowed {
  Tensor turn;    ///< px, infinite in a picture without a seam.
  Tensor wide;    ///< bool.
  Tensor factor;  ///< By which it is narrower along a row of pixels.
  Tensor cov2d;   ///< (n, 3).

  explicit Narrowed(const SeamArguments& a) {
    turn = a.turns.index_select(0, a.camera_ids);
    const Tensor xx = a.cov2d.select(1, 0), widest = turn.mul(kWidest);
    wide = xx.gt(widest.square());
    factor = at::where(wide, widest.div(at::where(wide, xx, 1).sqrt()), 1);
    cov2d = at::stack({xx.mul(factor.square()), a.cov2d.select(1, 1).mul(factor), a.cov2d.select(1, 2)}, 1);
  }
  Tensor overlaps() const { return cov2d.select(1, 0).gt(turn.mul(kOverlapping).square()); }
};

/// Solves prod_k (1 - o w_k) = 1 - opacity for the opacity o of a copy, w_k being the splat's falloff at k turns. In x
/// = -ln(1 - o) the product's logarithm is concave: Newton's method rises to the solution.
struct CopyOpacity {
  Tensor falloff;  ///< (kNeighbours, n).
  Tensor wanted;   ///< -ln(1 - opacity).

  CopyOpacity(const SeamArguments& a, const Narrowed& narrowed, const Tensor& overlaps) {
    const Tensor xx = narrowed.cov2d.select(1, 0);
    const Tensor square = at::where(overlaps, narrowed.turn.square().div(at::where(overlaps, xx.mul(2), 1)), 1);
    std::vector<Tensor> by_turns;
    for (int k = 1; k <= kNeighbours; ++k) by_turns.push_back(square.mul(-k * k).exp());
    falloff = at::stack(by_turns);
    wanted = a.opacities.clamp_max(kOpaque).neg().log1p().neg();
  }
  Tensor start() const { return wanted.div(falloff.sum(0).mul(2).add(1)); }

  struct At {
    Tensor hidden, left, slope;  ///< 1 - e^-x; 1 - w_k hidden, (kNeighbours, n); the derivative of the logarithm.
  };
  At at(const Tensor& x) const {
    const Tensor light = x.neg().exp(), hidden = light.neg().add(1), left = falloff.mul(hidden).neg().add(1);
    return {hidden, left, falloff.mul(light).div(left).sum(0).mul(2).add(1)};
  }
  Tensor step(const Tensor& x) const { return step(x, at(x)); }
  Tensor step(const Tensor& x, const At& here) const {
    return wanted.sub(x).add(here.left.log().sum(0).mul(2)).div(here.slope).add(x);
  }
};

/// First and last place, in turns from that of the row, at which a splat may show.
std::pair<Tensor, Tensor> places_of(const SeamArguments& a, const Narrowed& narrowed) {
  const CullBounds<double> bounds = cull_bounds<double>(find_footprint(a.footprint, a.option).choice);
  const Tensor levels = a.opacities.clamp_min(1).log().mul(2).add(bounds.level);
  const Tensor variance = narrowed.cov2d.select(1, 0).add(bounds.variance);
  const Tensor reach = variance.mul(levels).sqrt().mul(double(kReachMargin)).add(2), x = a.means2d.select(1, 0);
  const Tensor first = reach.neg().sub(0.5).sub(x).div(narrowed.turn).ceil();
  const Tensor last = reach.add(double(a.image_width) - 0.5).sub(x).div(narrowed.turn).floor();
  return {first.clamp_max(0).to(at::kLong), last.clamp_min(0).to(at::kLong)};
}

}  // namespace

Tensor summed_copies(const Tensor& of_copies, const Tensor& counts) {
  return at::segment_reduce(of_copies.contiguous(), "sum", counts, {}, {}, 0, /*unsafe=*/true);
}

Results repeat_at_seam(SeamArguments a) {
  check(a);
  const Narrowed narrowed(a);
  const Tensor overlaps = narrowed.overlaps();
  Tensor opacities = a.opacities, solution = at::empty({0}, a.means2d.options());
  if (overlaps.any().item<bool>()) {
    const CopyOpacity equation(a, narrowed, overlaps);
    solution = equation.start();
    for (int k = 0; k < kSteps; ++k) solution = equation.step(solution);
    opacities = at::where(overlaps, equation.step(solution).neg().expm1().neg(), a.opacities);
  }
  const auto [first, last] = places_of(a, narrowed);
  const Tensor counts = last.sub(first).add(1), ends = counts.cumsum(0);
  const Tensor of_row = at::arange(counts.numel(), counts.options()).repeat_interleave(counts);
  const Tensor place = at::arange(of_row.numel(), counts.options())
                           .sub(ends.sub(counts).index_select(0, of_row))
                           .add(first.index_select(0, of_row));
  const auto repeated = [&](const Tensor& t) { return t.index_select(0, of_row); };
  const Tensor turn = at::where(narrowed.turn.isfinite(), narrowed.turn, 0);
  const Tensor means = repeated(a.means2d);
  means.select(1, 0).add_(repeated(turn).mul(place));
  const Tensor colors = a.colors.size(0) == counts.numel() ? repeated(a.colors) : a.colors.clone();
  const Tensor splits = at::cat({ends.new_zeros({1}), ends}).index_select(0, a.row_splits.to(ends.device())).cpu();
  std::vector<Tensor> saved;
  if (a.keep) saved = {counts, place, solution};
  return {means,
          repeated(narrowed.cov2d),
          repeated(opacities),
          repeated(a.depths),
          colors,
          a.beside ? repeated(*a.beside) : at::empty({0}, a.means2d.options()),
          repeated(a.radii),
          repeated(a.gaussian_ids),
          repeated(a.camera_ids),
          repeated(a.dets.mul(narrowed.factor.square())),
          splits,
          saved};
}

Results repeat_at_seam_vjp(VjpArguments<SeamArguments> arguments) {
  SeamArguments& a = arguments.of_op;
  check(a);
  const std::vector<bool>& needs = arguments.needs;
  check_needs(needs, SeamArguments::kTensors);
  const int64_t n = a.means2d.size(0);
  TORCH_CHECK_VALUE(arguments.saved.size() == 3 && arguments.saved[0].numel() == n,
                    "saved must be what repeat_at_seam saved with keep=True");
  const Tensor counts = arguments.saved[0], place = arguments.saved[1], solution = arguments.saved[2];
  const int64_t copies = place.numel();
  const auto gradient = [&](size_t output, const char* name, const Tensor& of) {
    std::vector<int64_t> sizes = of.sizes().vec();
    if (of.size(0) == n) sizes[0] = copies;
    return gradient_of(arguments.dL_doutputs, output, name, a.means2d, sizes);
  };
  const auto summed = [&](const Tensor& of_copies) {
    return of_copies.defined() && of_copies.size(0) == copies ? summed_copies(of_copies, counts) : of_copies;
  };
  const Tensor dL_dmeans = gradient(0, "dL_dmeans2d", a.means2d);
  const Tensor dL_dcov = summed(gradient(1, "dL_dcov2d", a.cov2d));
  Tensor dL_dopacities = summed(gradient(2, "dL_dopacities", a.opacities));
  const Tensor dL_ddepths = summed(gradient(3, "dL_ddepths", a.depths));
  const Tensor dL_dcolors = summed(gradient(4, "dL_dcolors", a.colors));
  const Tensor dL_dbeside = a.beside ? summed(gradient(5, "dL_dbeside", *a.beside)) : Tensor();

  const Narrowed narrowed(a);
  const Tensor xx = narrowed.cov2d.select(1, 0), nothing = at::zeros({n}, a.means2d.options());
  Tensor dL_dxx = nothing, dL_dxy = nothing, dL_dyy = nothing, dL_dturn = nothing;
  if (dL_dcov.defined()) {
    dL_dxx = dL_dcov.select(1, 0);
    dL_dxy = dL_dcov.select(1, 1);
    dL_dyy = dL_dcov.select(1, 2);
  }
  if (dL_dopacities.defined() && solution.numel() > 0) {
    const Tensor overlaps = narrowed.overlaps();
    const CopyOpacity equation(a, narrowed, overlaps);
    // By the last step alone, whose derivative is that of the solution.
    const CopyOpacity::At here = equation.at(solution);
    const Tensor dL_dwanted =
        at::where(overlaps, dL_dopacities.mul(equation.step(solution, here).neg().exp()).div(here.slope), 0);
    const Tensor dL_dfalloff = dL_dwanted.mul(-2).mul(here.hidden).div(here.left);
    Tensor dL_dsquare = nothing;
    for (int k = 1; k <= kNeighbours; ++k)
      dL_dsquare = dL_dsquare.sub(dL_dfalloff[k - 1].mul(equation.falloff[k - 1]).mul(k * k));
    const Tensor by_variance = at::where(overlaps, dL_dsquare.mul(narrowed.turn).div(xx), 0);  // Over the turn.
    dL_dturn = dL_dturn.add(by_variance);
    dL_dxx = dL_dxx.sub(at::where(overlaps, by_variance.mul(narrowed.turn).div(xx.mul(2)), 0));
    const Tensor below = a.opacities.le(kOpaque);
    const Tensor by_opacity = at::where(below, dL_dwanted.div(at::where(below, a.opacities, 0).neg().add(1)), 0);
    dL_dopacities = at::where(overlaps, by_opacity, dL_dopacities);
  }
  // A wide splat has the turn's variance: its own only narrows its correlation.
  const Tensor dL_dfactor = dL_dxy.mul(a.cov2d.select(1, 1)).mul(narrowed.factor), wide = narrowed.wide;
  dL_dturn = dL_dturn.add(at::where(wide, dL_dxx.mul(narrowed.turn).mul(2 * kWidest * kWidest), 0));
  dL_dturn = dL_dturn.add(at::where(wide, dL_dfactor.div(narrowed.turn), 0));
  dL_dxx = at::where(wide, dL_dfactor.div(a.cov2d.select(1, 0).mul(-2)), dL_dxx);
  dL_dxy = dL_dxy.mul(narrowed.factor);

  std::vector<Tensor> out(SeamArguments::kTensors);
  out[0] = summed(dL_dmeans);
  out[1] = at::stack({dL_dxx, dL_dxy, dL_dyy}, 1);
  out[2] = dL_dopacities;
  out[3] = dL_ddepths;
  out[4] = dL_dcolors;
  out[6] = dL_dbeside;
  if (needs[5]) {
    if (dL_dmeans.defined()) dL_dturn = dL_dturn.add(summed_copies(dL_dmeans.select(1, 0).mul(place), counts));
    dL_dturn = at::where(narrowed.turn.isfinite(), dL_dturn, 0);
    const Tensor splats = a.row_splits.diff().to(counts.device());  // Summed in order: the same bits in every run.
    out[5] = summed_copies(dL_dturn, splats);
  }
  // The gradient through dets is in that of cov2d.
  const Tensor like[] = {a.means2d, a.cov2d, a.opacities, a.depths, a.colors, a.turns, a.beside.value_or(Tensor())};
  for (size_t k = 0; k < out.size(); ++k) {
    if (needs[k] && !out[k].defined()) out[k] = at::zeros_like(k < std::size(like) ? like[k] : a.dets);
    out[k] = needs[k] ? out[k] : at::empty({0}, a.means2d.options());
  }
  return {out};
}

}  // namespace ar::ops
