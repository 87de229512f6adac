"""A training loop to copy and change: rendering, fused loss, optimiser and density control, each in a line or two.

    python examples/train_loop.py OUT [FOLDER]

trains on the capture in FOLDER (NeRF-synthetic, COLMAP or nerfstudio), or on pictures that it makes itself. Writes
OUT/scene.ply, which says for which footprint it is, and the training views OUT/cameras.json, so that the commands
`render` and `view` show OUT; `evaluate` needs `--data FOLDER`. Prints the PSNR of the training pictures. Runs on CUDA
where there is a device, otherwise on the CPU. Needs `pip install ".[train]"`.
"""

import math
import sys
from pathlib import Path

import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io, training

FOOTPRINT = "moment:samples=4"
FIRST, FIRST_SHARE = "box:samples=1", 0.9  # one sample is quicker, and mostly enough while shapes are being found


def own_pictures(device):
    """Pictures of a cloud of 300 Gaussians from 12 sides, and points with colours to start from."""
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    truth = ar.Gaussians.from_points(points, torch.sigmoid(2 * points), opacity=0.9, scale=0.5).to(device)
    views = []
    for i in range(12):
        c, s = math.cos(i * math.pi / 6), math.sin(i * math.pi / 6)
        pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 6], [0, 0, 0, 1]], dtype=torch.float64)
        views.append(ar.View(f"view_{i}", 64, 64, 80.0, 80.0, pose))
    settings = [view.settings(footprint="box:samples=16", device=device) for view in views]
    colors = [ar.GaussianRasterizer(s)(means2D=None, **truth.arguments())[0] for s in settings]
    stored = [(255 * color.clamp(0, 1)).round().to(torch.uint8) for color in colors]
    return training.Pictures(views, {1: settings}, {1: stored}), (points[::4], None)


def train(pictures, points, steps, options):
    """The trained Gaussians, and the loss of every step."""
    device, extent = pictures.colors[1][0].device, training.extent_of(pictures.views, points[0])
    gaussians = ar.Gaussians.from_points(*points).to(device).leaves()
    means_rate = 1.6e-4 * extent
    rates = {"means": means_rate, "log_scales": 5e-3, "rotations": 1e-3, "logit_opacities": 0.05, "shs": 1e-4}
    groups = [{"params": [getattr(gaussians, name)], "lr": rate} for name, rate in rates.items()]
    groups[-1] |= {"head": 1, "head_lr": 2.5e-3}  # the constant of the harmonics learns faster
    optimizer = ar.optim.FusedAdam(groups, eps=1e-15)
    control = ar.density.GradientDensity(gaussians, optimizer, extent, options)

    generator, losses = torch.Generator().manual_seed(0), []
    for step in range(1, steps + 1):
        i = int(torch.randint(len(pictures.views), (1,), generator=generator))
        footprint = FIRST if step <= FIRST_SHARE * steps else FOOTPRINT
        settings = pictures.settings[1][i]._replace(footprint=footprint, sh_degree=min(3, 8 * step // steps))
        leaf = control.leaf()  # gets the gradients of the projected means
        picture, radii = ar.GaussianRasterizer(settings)(means2D=leaf, **control.gaussians.arguments())
        loss = ar.losses.l1_ssim(picture, pictures.target(1, i))
        loss.backward()
        control.observe(leaf, radii)
        optimizer.param_groups[0]["lr"] = means_rate * 0.01 ** (step / steps)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        control.after_step(step, step / steps)  # control.gaussians may be others from here on
        losses.append(loss.detach())
    return control.gaussians.map(torch.Tensor.detach), torch.stack(losses).tolist()


def main(out, folder=None):
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if folder is None:
        pictures, points = own_pictures(device)
        steps, options = 700, ar.density.GradientOptions(densify_from=50, densify_every=10, max_gaussians=1000)
    else:
        capture = training.load_capture(folder)
        pictures = training.load_pictures(capture.train, (1,), capture.background, device)
        points = capture.points or training.random_points(100_000)
        steps, options = 7000, ar.density.GradientOptions(max_gaussians=500_000)
    gaussians, losses = train(pictures, points, steps, options)
    Path(out).mkdir(parents=True, exist_ok=True)
    io.save_scene(Path(out) / "scene.ply", gaussians, io.SceneMetadata(footprint=FOOTPRINT))
    io.save_views(Path(out) / "cameras.json", pictures.views)
    psnr = training.evaluate(gaussians, pictures, FOOTPRINT)["mean"]["psnr"]
    print(f"{gaussians.count} Gaussians, loss {losses[0]:.3f} to {losses[-1]:.3f}, PSNR {psnr:.2f} dB")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(*sys.argv[1:])
