"""Pictures and gradients of the repository's renderer."""

import numpy as np
import pytest
import torch
from model import NAMES, Model
from renderer import Camera, render


@pytest.fixture
def model():
    rng = np.random.default_rng(0)
    return Model(rng.normal(size=(200, 3)) * 0.4, rng.random((200, 3)))


def test_a_picture_has_the_background_where_nothing_is(model):
    background = torch.tensor([0.2, 0.4, 0.6], device="cuda")
    image, radii, _ = render(Camera(64, 48), model, background)
    assert image.shape == (3, 48, 64) and image.isfinite().all()
    assert (radii > 0).all()
    assert torch.equal(image[:, 0, 0], background)
    assert (image[:, 24, 32] - background).abs().max() > 0.1


def test_every_parameter_has_a_gradient(model):
    with torch.no_grad():
        model.scales[:, 0] += 0.5  # a ball has no gradient of its rotation
    image, _, screen_points = render(Camera(64, 48), model, torch.zeros(3, device="cuda"))
    image.square().mean().backward()
    for name in NAMES:
        gradient = getattr(model, name).grad
        assert gradient.isfinite().all() and (gradient != 0).any(), name
    assert (screen_points.grad[:, :2] != 0).any()
