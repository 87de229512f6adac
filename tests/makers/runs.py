"""Small trainings, and which Gaussians their pictures show."""

import torch

from analytic_rasterizer.training import model as g

TINY = {"sh_degree": 1, "random_points": 150, "densify_from": 20, "densify_every": 20, "max_gaussians": 400}


@torch.no_grad()
def scatter(gaussians) -> None:
    """Puts Gaussians where no picture shows them, and others where only some pictures do."""
    gaussians.means[::3, 1] += 50
    gaussians.means[1::3] *= 4


def rows_shown(trainer) -> list[torch.Tensor]:
    """Which Gaussians each picture of the next step shows."""
    supersampling = trainer.options.supersampling
    with torch.no_grad():
        scene = trainer.scene().arguments()
        return [g.render(scene, s.settings, None, supersampling)[1] > 0 for s in trainer._next()]
