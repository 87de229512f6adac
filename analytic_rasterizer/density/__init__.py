"""Density control: how many Gaussians there are, and where, during training.

One of three classes goes beside the optimizer: `GradientDensity`, `MonteCarloDensity` or `FixedDensity`, which changes
nothing. All have the same methods, so that a training loop need not know which it has:

    control = GradientDensity(gaussians, optimizer, extent)
    for step in range(1, steps + 1):
        leaf = control.leaf()
        color, radii = rasterizer(means2D=leaf, **control.gaussians.arguments())
        l1_ssim(color, target).backward()
        control.observe(leaf, radii)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        control.after_step(step, step / steps)

[3DGS] Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, section 5.2. Gaussians whose
projected mean would like to move, by the average norm of dL/d(mean) over the views that saw them, are *grown*: small
ones are cloned, large ones split into two that are 1.6 times smaller. Transparent ones, and after the first reset of
opacities also those that are large in the world, are pruned. At times all opacities are lowered, so that those which
matter rise again and the others are pruned.

The gradient is that by normalized device coordinates, which span 2 over the picture: dL/dx is W/2 times the derivative
by pixels, dL/dy H/2 times. The loss is a mean over the picture, so that as a function of these coordinates it does not
depend on the resolution, but for the detail that coarse pixels lose. Views at all scales therefore may enter one
average, with one threshold; but where one Gaussian covers several details of a coarse pixel, only the finest pictures
still ask for more of them.

[AbsGS] Ye et al., "AbsGS: Recovering Fine Details for 3D Gaussian Splatting", 2024: over a large Gaussian, gradients of
different pixels cancel. Summing their absolute values instead finds those that should be split.

[MCMC] Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024: transparent Gaussians move to where
opaque ones are, in a way that leaves the picture as it was, as many are added until a limit is reached, and noise on
the means of transparent Gaussians explores.

Where [3DGS] leaves a choice: a clone stays where its original is, and the momentum that only the original has takes
them apart; size in the picture is no reason to prune, as it would depend on the resolution; and on a white background
opacities are also lowered when growth begins, since white Gaussians in front of the object cost nothing there.
"""

from .control import FixedDensity
from .gradient import GradientDensity
from .monte_carlo import MonteCarloDensity
from .options import GradientOptions, MonteCarloOptions

__all__ = ["FixedDensity", "GradientDensity", "GradientOptions", "MonteCarloDensity", "MonteCarloOptions"]
