"""How far pictures in two orders are apart, and what `inspect` and `pareto` say of it."""

import math
from dataclasses import asdict, replace

import pytest
import torch
from gaussians import of_inputs
from scenes import Camera

import analytic_rasterizer as ar
from analytic_rasterizer.analysis import pareto
from analytic_rasterizer.analysis.orders import OrderDifference


def plates(angle):
    """Two plates, turned by `angle` either way about the vertical: at 0 they are parallel."""
    turn = angle / 2
    scene = {
        "means3D": torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.01]]),
        "scales": torch.tensor([[1.0, 1.0, 0.01]]).repeat(2, 1),
        "rotations": torch.tensor([[math.cos(turn), 0, s * math.sin(turn), 0] for s in (1, -1)]),
        "opacities": torch.full((2, 1), 0.99),
        "shs": torch.tensor([[[1.5, -1.5, -1.5]], [[-1.5, 1.5, -1.5]]]),
    }
    return of_inputs(scene)


CAMERA = Camera(image_height=16, image_width=32, tanfovx=16 / 30, tanfovy=8 / 30).facing_z()


def test_numbers_of_a_difference():
    dark = torch.zeros(3, 4, 5)
    one = dark.clone()
    one[1, 2, 3] = 0.5  # one of 20 pixels
    other = torch.full((3, 2, 2), 0.9 / 255)  # which nobody sees
    found = OrderDifference.of([(dark, one), (torch.zeros(3, 2, 2), other)])
    assert found.share == 1 / 24
    assert found.psnr == pytest.approx(-10 * math.log10((0.25 + 12 * (0.9 / 255) ** 2) / 72), rel=1e-6)
    assert found.rms == pytest.approx(math.sqrt(0.25 / 60))
    assert OrderDifference.of([(dark, dark)]).psnr > 100


@pytest.mark.parametrize(("angle", "needed"), [(0.0, False), (math.pi / 4, True)])
def test_inspect_says_whether_the_order_matters(angle, needed):
    scene, settings = plates(angle), CAMERA.settings(torch.float32)
    report = ar.inspect_scene(scene, [settings], 1 / 255, rounds=1)
    (found,) = (finding for finding in report.findings if finding.name == "order")
    assert (found.needed, found.kind) == (needed, "measured") and found.cost > 0
    assert found.recommendation == ("render --order ray" if needed else "center")
    pictures = [
        ar.GaussianRasterizer(settings._replace(footprint="box:samples=1", effects=ar.Effects(order=order)))(
            means2D=None, **scene.arguments()
        )[0]
        for order in ("center", "ray")
    ]
    expected = OrderDifference.of([pictures])
    assert found.change == pytest.approx(expected.rms, abs=1e-6)
    assert f"{expected.psnr:.1f} dB from those along rays" in found.reason
    assert f"{100 * expected.share:.1f}% of their pixels differ by more than 1/255" in found.reason
    assert report.effects.order == "center"  # an advice, and nothing that the footprints were measured with


def test_pareto_says_how_far_the_orders_are_apart(device):
    """Of the same pictures as `inspect`; None for views of the whole sphere."""
    scene, size = plates(math.pi / 4).to(device), {"width": 32, "height": 16, "fx": 30, "fy": 30}
    view = ar.View("one", **size, w2c=torch.eye(4, dtype=torch.float64))
    pictures = []
    for order in ("center", "ray"):
        settings = view.settings(sh_degree=0, footprint="box:samples=1", device=device, effects=ar.Effects(order=order))
        pictures.append(ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())[0])
    found = pareto._order_difference(scene, [view, view], (0.0, 0.0, 0.0))
    assert found == asdict(OrderDifference.of([pictures, pictures])) and found["share"] > 0
    assert (
        pareto._order_difference(scene, [view, replace(view, lens=ar.Lens.equirectangular())], (0.0, 0.0, 0.0)) is None
    )


def test_inspect_where_the_order_cannot_be_rendered():
    """A lens of the whole sphere."""
    from analytic_rasterizer.analysis.planner import _order_difference, _order_finding

    sphere = ar.Effects(lens=ar.Lens.equirectangular())
    settings = CAMERA.settings(torch.float32)._replace(effects=sphere)
    assert _order_difference(plates(0.0), [settings], sphere) is None
    assert _order_finding(None, 1 / 255, None).needed is None
