"""What the textbook formulas and this package do with the hard cases, in float32: tables of docs/internals/testing.md.

    python benchmarks/stability.py            prints the tables
    python benchmarks/stability.py --write    puts them into docs/internals/testing.md, between their markers

The textbook: the covariance as a product of matrices, the conic by a c - b^2, eigenvectors as [AS, Eq. 2] has them,
the logistic distribution and differences of it as they are written, gradients by autograd. In the same float32.
Errors are against float64, relative to the largest entry of the same Gaussian's gradient (of the image: to the largest
colour, or 1): the worst of the image and of all gradients, of all Gaussians and, of the package, of the footprints but
`point` without dilation and `analytic` with the paper's gradient. Of the two textbook formulas, conic and eigenvectors,
the table has the better one.
"""

import argparse
import math
import pathlib
import sys

import torch

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / folder) for folder in (".", "makers", "kernels"))]

import hard_cases  # noqa: E402
import scenes  # noqa: E402
import test_stability  # noqa: E402
from hard_cases import CASES, FULL_CASES  # noqa: E402
from scenes import VARIANTS  # noqa: E402

from analytic_rasterizer.analysis.tables import markdown_table  # noqa: E402

# Gradients that grow without bound by themselves, or vanish by symmetry: held to their tolerance all the same.
UNBOUNDED = ({"frame_gradient": "paper"}, {"dilation": 0.0})


def textbook(settings, scene, footprint):
    """Image (3, H, W) of `mip` with a variance of 1/12 or of `analytic`, as one would write them down."""
    import reference

    if "scales" in scene:
        covariance = reference.covariance_3d(scene["scales"], scene["rotations"], settings.scale_modifier)
    else:
        covariance = reference.unpack_covariance(scene["cov3D_precomp"])
    means, dtype = scene["means3D"], scene["means3D"].dtype
    size = torch.tensor([settings.image_width, settings.image_height], dtype=dtype)
    homogeneous = torch.cat([means, torch.ones_like(means[:, :1])], -1)
    view, clip = homogeneous @ settings.viewmatrix, homogeneous @ settings.projmatrix
    means2d = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) / 2
    tangent = torch.tensor([settings.tanfovx, settings.tanfovy], dtype=dtype)
    focal, z = size / (2 * tangent), view[:, 2]
    t = torch.minimum(torch.maximum(view[:, :2] / z[:, None], -1.3 * tangent), 1.3 * tangent) * z[:, None]
    zero = torch.zeros_like(z)
    rows = [[focal[0] / z, zero, -focal[0] * t[:, 0] / z**2], [zero, focal[1] / z, -focal[1] * t[:, 1] / z**2]]
    to_image = torch.stack([torch.stack(row, -1) for row in rows], -2) @ settings.viewmatrix[:3, :3].T
    cov2d = to_image @ covariance @ to_image.transpose(-1, -2)
    a, b, c = (cov2d[:, i, j][:, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    if "shs" in scene:
        colors = reference.sh_color(settings.sh_degree, scene["shs"], means - settings.campos)
    else:
        colors = scene["colors_precomp"]

    order = torch.argsort(z.detach(), stable=True)
    order = order[z.detach()[order] > 0.2]
    ys, xs = torch.meshgrid(*(torch.arange(int(n), dtype=dtype) for n in size.flip(0)), indexing="ij")
    dx, dy = (grid - means2d[:, i, None, None] for i, grid in enumerate((xs, ys)))
    if footprint == "mip":
        v = 1 / 12
        det, wider = a * c - b * b, (a + v) * (c + v) - b * b
        power = ((c + v) * dx * dx - 2 * b * dx * dy + (a + v) * dy * dy) / wider
        weight = torch.sqrt(det / wider) * torch.exp(-power / 2)
    else:
        middle, det = (a + c) / 2, a * c - b * b
        root = torch.sqrt(middle * middle - det)
        l1, l2 = middle + root, middle - root
        length = torch.sqrt(b * b + (l1 - a) ** 2)
        vx, vy = b / length, (l1 - a) / length

        def window(u, s):
            def logistic(x):
                return 1 / (1 + torch.exp(-1.6 * x - 0.07 * x**3))

            return logistic((u + 0.5) / s) - logistic((u - 0.5) / s)

        s1, s2 = torch.sqrt(l1), torch.sqrt(l2)
        weight = 2 * math.pi * s1 * s2 * window(dx * vx + dy * vy, s1) * window(dx * vy - dy * vx, s2)
    alpha = torch.clamp(scene["opacities"][:, :, None] * weight, max=0.99)[order]
    alpha = torch.where(alpha < 1 / 255, torch.zeros_like(alpha), alpha)
    through = torch.cumprod(1 - alpha, 0)
    alpha = torch.where(through.detach() < 1e-4, torch.zeros_like(alpha), alpha)
    through = torch.cumprod(1 - alpha, 0)
    front = torch.cat([torch.ones_like(through[:1]), through[:-1]])
    image = torch.einsum("phw,pc->chw", front * alpha, colors[order])
    last = through[-1] if len(order) else torch.ones_like(xs)
    return image + last * settings.bg[:, None, None]


def textbook_error(case, footprint):
    """The larger error of the image and of the gradients; NaN if one of their entries is not finite."""
    camera, scene = case.build()
    variant = ("mip", {"variance": 1 / 12}) if footprint == "mip" else ("analytic", {"frame_gradient": "paper"})
    naive = hard_cases.settings_of(camera, torch.float32, torch.float32, variant)
    exact = hard_cases.settings_of(camera, torch.float64, torch.float32, variant)
    ours = {name: value.float() for name, value in scene.items()}
    theirs = {name: value.double() for name, value in ours.items()}
    clear = hard_cases.clear_pixels(exact, theirs, case.margin)
    g = torch.Generator().manual_seed(1)
    loss = scenes.rand(g, 3, camera.image_height, camera.image_width, low=-1.0) * clear
    expected, _, wanted = hard_cases.run(exact, theirs, loss)
    leaves = scenes.leaves(ours)
    image = textbook(naive, leaves, footprint)
    (image * loss.float()).sum().backward()
    if not torch.isfinite(image.detach()).all():
        return math.nan
    errors = []
    if clear.any():
        size = max(1.0, expected.abs().max().item())
        errors.append((image.detach().double() - expected).abs()[:, clear].max().item() / size)
    for name, value in wanted.items():
        if name == "means2D":
            continue
        grad = torch.zeros_like(leaves[name]) if leaves[name].grad is None else leaves[name].grad
        if not torch.isfinite(grad).all():
            return math.nan
        scale = hard_cases.rows(value)
        seen = scale > 0
        if seen.any():
            errors.append((hard_cases.rows(grad.double() - value)[seen] / scale[seen]).max().item())
    return max(errors)


def number(value):
    """One digit."""
    if value == 0:
        return "0"
    return f"{value:.1g}" if math.isfinite(value) else "NaN"


def case_table():
    rows = []
    for case in CASES:
        if case.effects is None:
            textbooks = [textbook_error(case, footprint) for footprint in ("mip", "analytic")]
            best = min((error for error in textbooks if not math.isnan(error)), default=math.nan)
            rows.append([f"`{case.name}`", number(best), *our_cells(case)])
            print(rows[-1], [number(error) for error in textbooks], file=sys.stderr, flush=True)
    return markdown_table(["case", "textbook", "ours", "of tolerance"], rows)


def our_cells(case):
    """The worst error of image and gradients of all footprints, and the largest share of its tolerance of a variant."""
    worst, share = 0.0, 0.0
    for variant in VARIANTS:
        report = hard_cases.measure(case, variant, "cpu", torch.float32)
        for name, error in report.error.items():
            if variant[1] not in UNBOUNDED and name != "means2D":
                worst = max(worst, report.relative(name))
            tolerance = report.tolerance[name].expand_as(error)
            if (tolerance > 0).any():
                share = max(share, (error / tolerance)[tolerance > 0].max().item())
    return number(worst), f"{share:.2f}"


def full_table():
    return markdown_table(
        ["case", "ours", "of tolerance"], [[f"`{case.name}`", *our_cells(case)] for case in FULL_CASES]
    )


def weight_table():
    """The worst of each footprint's options."""
    worst = {}
    for variant in VARIANTS:
        cells = worst.setdefault(variant[0], [0.0] * 3)
        for i, dtype in enumerate((torch.float32, torch.float64)):
            report = test_stability.measure_weights(variant, "cpu", dtype)
            cells[i] = max(cells[i], report["error"].max().item())
            cells[2] = max(cells[2], (report["error"] / report["tolerance"]).max().item())
    rows = [[name, number(a), number(b), f"{share:.2f}"] for name, (a, b, share) in worst.items()]
    return markdown_table(["footprint", "float32", "float64", "of tolerance"], rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    path = ROOT / "docs" / "internals" / "testing.md"
    text = path.read_text() if arguments.write else ""
    for name, table in (("cases", case_table()), ("full", full_table()), ("weights", weight_table())):
        if not arguments.write:
            print(table, end="\n\n")
            continue
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, rest = text.split(begin)
        text = before + begin + "\n" + table + "\n\n" + end + rest.split(end)[1]
    if arguments.write:
        path.write_text(text)


if __name__ == "__main__":
    main()
