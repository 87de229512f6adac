"""A step of a training by autograd through public functions, for tests that compare its one op with it."""

from __future__ import annotations

import torch
from torch.nn.functional import avg_pool2d

import analytic_rasterizer as ar
from analytic_rasterizer.losses import l1_ssim

# Relative, by the norm: the rounding of a variance in SSIM, 2^-24 over its constant 9e-4, is 7e-5 of a gradient.
TOLERANCE = 3e-4


def by_autograd(trainer) -> dict[str, torch.Tensor]:
    """Loss and gradients of the next step, sums of density control after it, and gradients of exposures by view."""
    options, gaussians = trainer.options, trainer.gaussians.map(lambda field: field.detach().requires_grad_())
    state = trainer.generator.get_state()
    pictures, times = trainer._next(), options.supersampling
    trainer.generator.set_state(state)
    arguments, shown_as = gaussians.arguments(), gaussians.arguments()
    if trainer.filter_3d is not None:
        filtered = ar.apply_3d_filter(shown_as["scales"], shown_as["opacities"], trainer.filter_3d)
        shown_as |= dict(zip(("scales", "opacities"), filtered))
    losses, leaves, exposures = [], [], {}
    for shown in pictures:
        size = {"image_height": times * shown.settings.image_height, "image_width": times * shown.settings.image_width}
        leaves.append(
            torch.zeros(len(gaussians.means), trainer.density.columns, device=trainer.device).requires_grad_()
        )
        picture, _ = ar.GaussianRasterizer(shown.settings._replace(**size))(means2D=leaves[-1], **shown_as)
        picture = avg_pool2d(picture, times)
        if trainer.exposures is not None:
            matrix = exposures.setdefault(shown.view, trainer.exposures.matrices[shown.view].clone().requires_grad_())
            picture = torch.einsum("ij,jhw->ihw", matrix[:, :3], picture) + matrix[:, 3, None, None]
        target = trainer.pictures.target(shown.scale, shown.view, shown.background)
        mask = trainer.pictures.mask(shown.scale, shown.view)
        losses.append(l1_ssim(picture, target, options.ssim_weight, mask))
    opacity_weight, scale_weight = options.regularizers
    penalty = opacity_weight * arguments["opacities"].mean() + scale_weight * arguments["scales"].mean()
    loss = torch.stack(losses).mean() + penalty
    loss.backward()
    made = {"loss": loss.detach()} | {name: field.grad for name, field in gaussians._asdict().items()}
    watched = [leaf.grad for leaf, shown in zip(leaves, pictures) if trainer._watches(shown.scale)]
    if watched:
        first = 2 if trainer.density.columns == 4 else 0
        lengths = [gradient[:, first : first + 2].norm(dim=1) for gradient in watched]
        made["gradient_sums"] = trainer.density.gradient_sums + sum(lengths)
    return made | {f"exposure {view}": matrix.grad for view, matrix in exposures.items()}


def check_next_step(trainer) -> None:
    """Asserts that the next step has the gradients of autograd. It is not taken."""
    expected, given = by_autograd(trainer), {}
    if trainer.exposures is not None:
        trainer.exposures.update = lambda gradients, share: given.update(gradients)
    with torch.no_grad():
        loss, _ = trainer._differentiate()
    found = {"loss": loss} | {name: field.grad for name, field in trainer.gaussians._asdict().items()}
    if "gradient_sums" in expected:
        found["gradient_sums"] = trainer.density.gradient_sums
    found |= {f"exposure {view}": gradient for view, gradient in given.items()}
    assert found.keys() == expected.keys()
    for name, wanted in expected.items():
        assert wanted.norm() > 0, name
        assert (found[name] - wanted).norm() <= TOLERANCE * wanted.norm(), name
