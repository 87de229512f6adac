"""A step of a training by autograd through public functions, for tests that compare its one op with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, huber_loss

import analytic_rasterizer as ar
from analytic_rasterizer.losses import l1_ssim
from analytic_rasterizer.training.control import regularizers_of

# Relative, by the norm: the rounding of a variance in SSIM, 2^-24 over its constant 9e-4, is 7e-5 of a gradient.
TOLERANCE = 3e-4


def widened(arguments: dict[str, torch.Tensor], filter_3d: torch.Tensor | None) -> dict[str, torch.Tensor]:
    """`Gaussians.arguments` with the 3D filter, where there is one."""
    if filter_3d is None:
        return arguments
    made = ar.apply_3d_filter(arguments["scales"], arguments["opacities"], filter_3d)
    return arguments | dict(zip(("scales", "opacities"), made))


def falloff(height: int, width: int, coefficients: torch.Tensor, center) -> torch.Tensor:
    """(H, W): 1 + sum of k_j (r^(2j) - its mean over the picture), r about `center` [px] in halves of the diagonal."""
    nodes, weights = (torch.from_numpy(numbers) for numbers in np.polynomial.legendre.leggauss(5))

    def squares(x, y):
        return ((x - center[0]) ** 2 + (y[:, None] - center[1]) ** 2) * 4 / (height**2 + width**2)

    shown = squares(*(torch.arange(length, dtype=torch.float64) + 0.5 for length in (width, height)))
    over_area = squares((nodes + 1) * width / 2, (nodes + 1) * height / 2)
    means = [(over_area**j * weights * weights[:, None]).sum().item() / 4 for j in (1, 2)]
    terms = torch.stack([shown ** (j + 1) - mean for j, mean in enumerate(means)]).to(coefficients)
    return 1 + torch.einsum("j,jhw->hw", coefficients, terms)


def compared(
    settings, gaussians, means2D, target, *, times, exposure, mask, ssim_weight, vignetting=None, center=(), depth=None
):
    """The loss of a picture, the picture that is compared, and the radii.

    Args:
        settings: Of the rendering, which is `times` as large as the target.
        gaussians: Arguments of the rasterizer.
        depth: depth_target, depth_shares, depth_weight and depth_margin of the op, by their names.
    """
    loss = 0.0
    if depth is None:
        picture, radii = ar.GaussianRasterizer(settings)(means2D=means2D, **gaussians)
    else:
        effects = replace(settings.effects or ar.Effects(), inverse_depth=True)
        deep = settings._replace(effects=effects)
        picture, radii, outputs = ar.GaussianRasterizer(deep)(means2D=means2D, **gaussians)
        shown, margin = avg_pool2d(outputs.inverse_depth, times)[0], depth["depth_margin"]
        differences = huber_loss(shown, depth["depth_target"], reduction="none", delta=margin) / margin
        loss = depth["depth_weight"] * (differences * depth["depth_shares"]).sum()
    picture = avg_pool2d(picture, times)
    if vignetting is not None:
        picture = picture * falloff(*picture.shape[1:], vignetting, center)
    if exposure is not None:
        picture = torch.einsum("ij,jhw->ihw", exposure[:, :3], picture) + exposure[:, 3, None, None]
    return l1_ssim(picture, target, ssim_weight, mask) + loss, picture, radii


def by_autograd(trainer) -> dict[str, torch.Tensor]:
    """Loss and gradients of the next step, sums of density control after it, and gradients of corrections by view."""
    options, gaussians = trainer.options, trainer.gaussians.map(lambda field: field.detach().requires_grad_())
    state = trainer.generator.get_state()
    pictures, times = trainer._next(), options.supersampling
    trainer.generator.set_state(state)
    arguments = gaussians.arguments()
    shown_as = widened(arguments, trainer.filter_3d)
    losses, leaves, exposures, falloffs = [], [], {}, {}
    for shown in pictures:
        size = {"image_height": times * shown.settings.image_height, "image_width": times * shown.settings.image_width}
        leaves.append(
            torch.zeros(len(gaussians.means), trainer.density.columns, device=trainer.device).requires_grad_()
        )
        matrix, learned = None, trainer.corrections
        if learned.exposures is not None:
            own = learned.exposures.matrices[shown.view].clone().requires_grad_()
            matrix = exposures.setdefault(shown.view, own)
        target = trainer.pictures.target(shown.scale, shown.view, shown.background)
        mask, weight = trainer.pictures.mask(shown.scale, shown.view), options.ssim_weight
        how = {"times": times, "exposure": matrix, "mask": mask, "ssim_weight": weight}
        if learned.falloffs is not None:
            how |= learned.falloffs.arguments(shown.view, target.shape[2], target.shape[1])
            how["vignetting"] = falloffs.setdefault(shown.view, how["vignetting"].clone().requires_grad_())
        how["depth"] = trainer._depth(shown) or None
        losses.append(compared(shown.settings._replace(**size), shown_as, leaves[-1], target, **how)[0])
    opacity_weight, scale_weight = regularizers_of(options, trainer.extent)
    penalty = opacity_weight * arguments["opacities"].mean() + scale_weight * arguments["scales"].mean()
    loss = torch.stack(losses).mean() + penalty
    loss.backward()
    made = {"loss": loss.detach()} | {name: field.grad for name, field in gaussians._asdict().items()}
    watched = [leaf.grad for leaf, shown in zip(leaves, pictures) if trainer._watches(shown.scale)]
    if watched:
        first = 2 if trainer.density.columns == 4 else 0
        lengths = [gradient[:, first : first + 2].norm(dim=1) for gradient in watched]
        made["gradient_sums"] = trainer.density.gradient_sums + sum(lengths)
    made |= {f"exposure {view}": matrix.grad for view, matrix in exposures.items()}
    return made | {f"falloff {view}": coefficients.grad for view, coefficients in falloffs.items()}


def check_next_step(trainer) -> None:
    """Asserts that the next step has the gradients of autograd. It is not taken."""
    expected, given, falloffs, learned = by_autograd(trainer), {}, {}, trainer.corrections
    if learned.exposures is not None:
        learned.exposures.update = lambda gradients, share: given.update(gradients)
    if learned.falloffs is not None:
        learned.falloffs.update = lambda gradients, share: falloffs.update(gradients)
    with torch.no_grad():
        loss, _ = trainer._differentiate()
    found = {"loss": loss} | {name: field.grad for name, field in trainer.gaussians._asdict().items()}
    if "gradient_sums" in expected:
        found["gradient_sums"] = trainer.density.gradient_sums
    found |= {f"exposure {view}": gradient for view, gradient in given.items()}
    found |= {f"falloff {view}": gradient for view, gradient in falloffs.items()}
    assert found.keys() == expected.keys()
    for name, wanted in expected.items():
        assert wanted.norm() > 0, name
        assert (found[name] - wanted).norm() <= TOLERANCE * wanted.norm(), name
