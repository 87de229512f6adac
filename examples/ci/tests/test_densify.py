"""A short training with density control."""

import numpy as np
import torch
from model import NAMES, Model
from renderer import Camera, render


def target(camera):
    """A red disc on black."""
    y, x = torch.meshgrid(
        torch.arange(camera.height, device="cuda"), torch.arange(camera.width, device="cuda"), indexing="ij"
    )
    inside = (x - camera.width / 2) ** 2 + (y - camera.height / 2) ** 2 < (camera.height / 3) ** 2
    return torch.stack([inside.float(), torch.zeros_like(inside).float(), torch.zeros_like(inside).float()])


def step(model, camera, wanted):
    image, radii, screen_points = render(camera, model, torch.zeros(3, device="cuda"))
    loss = (image - wanted).abs().mean()
    loss.backward()
    model.gather(screen_points, radii)
    model.optimizer.step()
    model.optimizer.zero_grad(set_to_none=True)
    return loss.item()


def test_training_with_density_control():
    rng = np.random.default_rng(1)
    model = Model(rng.normal(size=(100, 3)) * 0.3, np.full((100, 3), 0.5))
    camera = Camera(64, 48)
    wanted = target(camera)
    losses = [step(model, camera, wanted) for _ in range(20)]

    assert (model.views == 20).all() and (model.gradients > 0).any()
    middle = float((model.gradients / model.views).median())
    expected = 100 + int((model.gradients / model.views > middle).sum())
    model.densify(threshold=middle, largest=0.15)  # a copy, or two halves of one: one more in either case
    assert model.means.shape[0] == expected
    assert (model.gradients == 0).all() and model.gradients.shape == (expected,)
    for group, name in zip(model.optimizer.param_groups, NAMES):
        assert group["params"][0] is getattr(model, name)
        assert model.optimizer.state[getattr(model, name)]["exp_avg"].shape == getattr(model, name).shape

    losses += [step(model, camera, wanted) for _ in range(40)]
    assert losses[-1] < 0.7 * losses[0]


def test_transparent_gaussians_go():
    model = Model(np.zeros((4, 3)), np.full((4, 3), 0.5))
    with torch.no_grad():
        model.opacities[1:3] = -10.0
    model.densify(threshold=1.0, largest=1.0)
    assert model.means.shape[0] == 2
