"""LPIPS, by torchmetrics on a small network in place of torchvision's, whose weights cannot be shipped."""

import sys
import types

import pytest
import torch

functional = pytest.importorskip("torchmetrics.functional.image.lpips", reason="needs the train extra")
metric = pytest.importorskip("torchmetrics.image.lpip", reason="needs the train extra")

import commands  # noqa: E402
from capture_files import circle, write_nerf_synthetic  # noqa: E402

from analytic_rasterizer import training  # noqa: E402

FILE = "vgg16-397923af.pth"
# Of the layers of VGG-16 those after which LPIPS reads features, and the channels that they then must have.
STAGES, CHANNELS = (0, 4, 9, 16, 23), (64, 128, 256, 512, 512)
# Of LPIPS, for pictures from -1 to 1.
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])


def small_vgg() -> torch.nn.Sequential:
    """As many layers as VGG-16 has features, most of which do nothing."""
    layers = [torch.nn.Identity() for _ in range(31)]
    for stage, width, channels in zip(STAGES, (3, *CHANNELS), CHANNELS):
        layers[stage] = torch.nn.Conv2d(width, channels, 1, stride=2)
    return torch.nn.Sequential(*layers)


@pytest.fixture
def network(tmp_path, monkeypatch):
    """The small network, whose weights are where torchvision keeps those that it has downloaded."""
    torch.manual_seed(0)
    path = tmp_path / "checkpoints" / FILE
    path.parent.mkdir()
    trained = small_vgg()
    torch.save(trained.state_dict(), path)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))

    def vgg16(weights):
        assert weights == "the default"
        features = small_vgg()
        features.load_state_dict(torch.load(path))
        return types.SimpleNamespace(features=features)

    torchvision = types.ModuleType("torchvision")
    torchvision.models = types.SimpleNamespace(vgg16=vgg16, VGG16_Weights=types.SimpleNamespace(DEFAULT="the default"))
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    for module in (functional, metric):
        monkeypatch.setattr(module, "_TORCHVISION_AVAILABLE", True)
    return trained


@torch.no_grad()
def lpips_of(network, image, truth) -> float:
    """By its definition [Zhang et al. 2018, Eq. 1], with the weights of its channels that torchmetrics brings."""
    folder = functional.__file__.replace("lpips.py", "lpips_models")
    channel_weights = torch.load(f"{folder}/vgg.pth", map_location="cpu")
    distance, pair = 0.0, (torch.stack([image, truth]) - SHIFT[:, None, None]) / SCALE[:, None, None]
    for k, stage in enumerate(STAGES):
        pair = network[stage](pair)
        a, b = pair / pair.square().sum(1, keepdim=True).sqrt()
        weighted = channel_weights[f"lin{k}.model.1.weight"][0] * (a - b).square()
        distance += weighted.sum(0).mean().item()
    return distance


@pytest.mark.parametrize("like_3dgs", [False, True])
def test_lpips_is_what_it_is_defined_as(network, like_3dgs):
    generator = torch.Generator().manual_seed(1)
    image, truth = torch.rand(2, 3, 32, 48, generator=generator)
    measure = training.load_lpips("vgg", "cpu", like_3dgs)
    expected = lpips_of(network, image, truth) if like_3dgs else lpips_of(network, 2 * image - 1, 2 * truth - 1)
    assert expected > 0.01
    # Thousands of roundings of float32 in sums that torchmetrics orders otherwise.
    assert measure(image, truth).item() == pytest.approx(expected, rel=1e-4)
    assert measure(truth, truth).item() == 0
    assert measure(image + 2 * (image > 0.5), truth) == measure(torch.where(image > 0.5, 1.0, image), truth)


def test_evaluate_prints_lpips(network, tmp_path, capsys):
    write_nerf_synthetic(tmp_path / "scene", circle(3), circle(2))
    small = "--iterations 2 --random-points 50 --sh-degree 0 --no-evaluate"
    assert commands.train(tmp_path / "scene", tmp_path / "out", small) == 0
    capsys.readouterr()
    assert commands.command("evaluate", tmp_path / "out", "--pictures 0 --scales 1,2 --device cpu") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    names, values = rows[3][:2], [float(value) for value in rows[3][2:]]
    assert names == ["moment:samples=4", "LPIPS"] and len(values) == 3
    assert min(values) > 0 and values[2] == pytest.approx(sum(values[:2]) / 2, abs=1.01e-4)  # of printed numbers


@pytest.mark.parametrize("content", [None, "raise RuntimeError('operator torchvision::nms does not exist')"])
def test_lpips_without_a_fitting_torchvision_says_so(network, monkeypatch, tmp_path, content):
    """As where it is missing, and as where it was built for another torch."""
    if content is None:
        monkeypatch.setitem(sys.modules, "torchvision", None)
    else:
        monkeypatch.delitem(sys.modules, "torchvision")
        (tmp_path / "torchvision.py").write_text(content)
        monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match="LPIPS needs torchvision, in the version that fits torch"):
        training.load_lpips("vgg", "cpu")
