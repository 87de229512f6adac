"""The op of a step: the loss of a picture and its gradients."""

import math
from dataclasses import replace

import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, truth_gaussians
from training_step import TOLERANCE, compared, widened

from analytic_rasterizer.cameras.lens import Lens
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.render.arguments import camera_arguments
from analytic_rasterizer.render.seam import turn_of

FIELDS = ("means", "log_scales", "quats", "logit_opacities", "shs")
PARTS = ("", "mask", "exposure", "vignetting", "filter", "supersampling", "regularizers", "depth", "all")


def settings_of(lens, device, dtype=torch.float32):
    view = circle(1)[0]
    if lens is SPHERE:
        view = replace(view, lens=lens, fx=view.width / (2 * math.pi), fy=view.height / math.pi)
    return replace(view, lens=lens).settings(sh_degree=0, footprint="box:samples=4", device=device, dtype=dtype)


def picture_arguments(device, parts="", lens=None, dtype=torch.float32, **changed):
    """Of the op `picture_gradients`, with some of `PARTS`."""
    view, generator = replace(circle(1)[0], lens=lens), torch.Generator().manual_seed(1)
    gaussians = truth_gaussians().map(torch.Tensor.detach)
    log_scales = gaussians.log_scales + 0.5 * torch.rand(gaussians.log_scales.shape, generator=generator)
    times = 2 if parts in ("supersampling", "all") else 1
    size = view.height // times, view.width // times
    of_parts = {
        "mask": {"mask": torch.rand(size, generator=generator)},
        "exposure": {"exposure": torch.eye(3, 4) + 0.1 * torch.rand(3, 4, generator=generator)},
        "vignetting": {"vignetting": torch.tensor([-0.4, 0.1]), "center": [0.4 * size[1], 0.55 * size[0]]},
        "filter": {"filter_3d": 0.3 * torch.rand(len(log_scales), generator=generator)},
        "regularizers": {"opacity_weight": 0.3, "scale_weight": 0.2},
        "depth": {
            "depth_target": 0.2 + 0.2 * torch.rand(size, generator=generator),
            "depth_shares": torch.rand(size, generator=generator),
            "depth_weight": 0.01,
            "depth_margin": 0.05,
        },
    }
    given = dict(zip(FIELDS, gaussians._replace(log_scales=log_scales)))
    given |= {"dL_dloss": torch.tensor(0.75), "bg": torch.full((3,), 0.2), "exposure": None, "mask": None}
    given |= {"supersampling": times, "vignetting": None, "center": []}
    for name, more in of_parts.items():
        given |= more if parts in (name, "all") else {}
    moved = {name: v.to(device, dtype) if isinstance(v, torch.Tensor) else v for name, v in given.items()}
    target = torch.rand(3, *size, generator=generator).mul(255).byte().to(device)
    settings = settings_of(lens, device, dtype)
    camera = camera_arguments(settings, moved["means"], None, with_seam=True) | {"turn": turn_of(settings)}
    return moved | {"mean_columns": 4, "target": target, "ssim_weight": 0.2} | camera | changed


SPHERE = Lens.equirectangular()


@pytest.mark.parametrize("lens", [None, SPHERE], ids=["pinhole", "sphere"])
@pytest.mark.parametrize("parts, columns", [*((parts, 4) for parts in PARTS), ("", 0), ("all", 0), ("all", 3)])
def test_gradients_of_a_picture_are_those_of_autograd(device, lens, parts, columns):
    given = picture_arguments(device, parts, lens, mean_columns=columns)
    loss, picture, radii, gradients = torch.ops.analytic_rasterizer.picture_gradients(**given)
    times, weights = given["supersampling"], (given.get("opacity_weight", 0), given.get("scale_weight", 0))
    parameters = Gaussians(*(given[name] for name in FIELDS)).map(lambda field: field.clone().requires_grad_())
    means2D = torch.zeros(len(radii), max(columns, 3), device=device, requires_grad=True)
    arguments = parameters.arguments()
    shown = widened(arguments, given.get("filter_3d"))
    exposure = given["exposure"] if given["exposure"] is None else given["exposure"].clone().requires_grad_()
    vignetting = None if given["vignetting"] is None else given["vignetting"].clone().requires_grad_()
    how = {"times": times, "exposure": exposure, "mask": given["mask"], "ssim_weight": given["ssim_weight"]}
    how |= {"vignetting": vignetting, "center": given["center"]}
    if "depth_target" in given:
        how["depth"] = {name: value for name, value in given.items() if name.startswith("depth_")}
    settings = settings_of(lens, device)._replace(bg=given["bg"])
    expected, image, expected_radii = compared(settings, shown, means2D, given["target"], **how)
    expected = expected + weights[0] * arguments["opacities"].mean() + weights[1] * arguments["scales"].mean()
    wanted = [*parameters, *([means2D] if columns else []), *(t for t in (exposure, vignetting) if t is not None)]
    made = torch.autograd.grad(expected, wanted, given["dL_dloss"])
    torch.testing.assert_close(picture, image.detach(), rtol=0, atol=1e-6)
    assert torch.equal(radii, expected_radii)
    for found, of_autograd in zip((*gradients, loss), (*made, expected), strict=True):
        assert of_autograd.norm() > 0 and (found - of_autograd).norm() <= TOLERANCE * of_autograd.norm()


def test_opcheck_of_picture_gradients(device):
    op = torch.ops.analytic_rasterizer.picture_gradients.default
    for columns in (0, 3, 4):
        torch.library.opcheck(op, (), picture_arguments(device, mean_columns=columns))
    torch.library.opcheck(op, (), picture_arguments(device, "all"))


LENSES = {
    "pinhole": None,
    "perspective": Lens.perspective([-0.1, 0.03], [0.01, -0.02]),
    "fisheye": Lens.fisheye([0.05, -0.01]),
    "rad_tan_fisheye": Lens.rad_tan_fisheye([-0.05], [0.01]),
    "fov": Lens.fov(0.9),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("parts", PARTS)
def test_picture_gradients_of_devices_and_precisions_agree(device, lens, parts):
    results = []
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        arguments = picture_arguments(where, parts, LENSES[lens], dtype)
        loss, image, _, gradients = torch.ops.analytic_rasterizer.picture_gradients(**arguments)
        results.append([t.double().cpu() for t in (loss, image, *gradients)])
    assert len(results[0]) == 8 + (parts in ("exposure", "vignetting")) + 2 * (parts == "all")
    for number, (expected, found) in enumerate(zip(*results)):
        assert expected.norm() > 0 and (found - expected).norm() < TOLERANCE * expected.norm(), number


def test_threads_change_no_bit_of_the_regularizers():
    """Of more Gaussians than a thread takes at a time."""
    generator = torch.Generator().manual_seed(2)
    given = [torch.randn(20_000, width, generator=generator) for width in (3, 4, 1)]
    penalties = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        penalties.append(torch.ops.analytic_rasterizer.activate(*given, 0.3, 0.2)[3])
    assert all(torch.equal(penalty, penalties[0]) for penalty in penalties)


@pytest.mark.parametrize(
    "changed, error, message",
    [
        ({"mean_columns": 2}, ValueError, "mean_columns must be 0, 3 or 4, got 2"),
        ({"quats": torch.zeros(12, 3)}, ValueError, r"quats must have shape \(N, 4\) with N = 12, got \(12, 3\)"),
        ({"means": torch.zeros(11, 3)}, ValueError, r"log_scales must have shape \(N, 3\) with N = 11, got \(12, 3\)"),
        ({"means": torch.zeros(12, 2)}, ValueError, r"means must have shape \(N, 3\), got \(12, 2\)"),
        ({"target": torch.zeros(3, 5, 5)}, ValueError, r"target must have shape \(3, .*\), got \(3, 5, 5\)"),
        ({"target": torch.zeros(3, 5, 5, dtype=torch.int32)}, TypeError, "target must have the dtype of means"),
        ({"ssim_weight": 1.5}, ValueError, r"ssim_weight must be in \[0, 1\], got 1.5"),
        ({"dL_dloss": torch.zeros(2)}, ValueError, "dL_dloss must have shape"),
        ({"mask": torch.zeros(5, 5)}, ValueError, r"mask must have shape \(.*\), got \(5, 5\)"),
        ({"mask": torch.zeros(5, 5, dtype=torch.uint8)}, TypeError, "mask must have the dtype of means"),
        ({"exposure": torch.zeros(4, 3)}, ValueError, r"exposure must have shape \(3, 4\), got \(4, 3\)"),
        ({"vignetting": torch.zeros(2)}, ValueError, "center must have two numbers with vignetting, and none .* got 0"),
        ({"center": [1.0, 2.0]}, ValueError, "center must have two numbers with vignetting, and none without, got 2"),
        (
            {"vignetting": torch.zeros(3), "center": [1.0, 2.0]},
            ValueError,
            r"vignetting must have shape \(2,\), got \(3,\)",
        ),
        (
            {"vignetting": torch.zeros(2), "center": [1.0, math.inf]},
            ValueError,
            "center must be finite, got 1 and inf",
        ),
        ({"filter_3d": torch.zeros(11)}, ValueError, r"filter_3d must have shape \(N,\) with N = 12, got \(11,\)"),
        ({"filter_3d": torch.zeros(12).double()}, TypeError, "filter_3d must have the dtype of means"),
        ({"supersampling": 3}, ValueError, "supersampling must be at least 1 and divide .*, 32 and 32, got 3"),
        ({"supersampling": 0}, ValueError, "supersampling must be at least 1 and divide"),
        ({"supersampling": 2}, ValueError, r"target must have shape \(3, 16, 16\), got \(3, 32, 32\)"),
        ({"scale_weight": math.nan}, ValueError, "opacity_weight and scale_weight must be finite, got 0 and nan"),
        ({"depth_target": torch.zeros(32, 32)}, ValueError, "depth_target and depth_shares must be given together"),
        ({"depth_shares": torch.zeros(32, 32)}, ValueError, "depth_target and depth_shares must be given together"),
        ({"depth_weight": -1.0}, ValueError, "depth_weight must be finite and not negative, got -1"),
        ({"depth_margin": 0.0}, ValueError, "depth_margin must be finite and positive, got 0"),
        (
            {"depth_target": torch.zeros(16, 32), "depth_shares": torch.zeros(32, 32)},
            ValueError,
            r"depth_target must have shape \(32, 32\), got \(16, 32\)",
        ),
        (
            {"depth_target": torch.zeros(32, 32), "depth_shares": torch.zeros(32, 32).double()},
            TypeError,
            "depth_shares must have the dtype of means",
        ),
    ],
)
def test_errors_of_picture_gradients(changed, error, message):
    with pytest.raises(error, match=message):
        torch.ops.analytic_rasterizer.picture_gradients(**picture_arguments("cpu", **changed))
