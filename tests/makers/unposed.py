"""Photographs without cameras, of a room whose cameras are known to the test."""

import math

import numpy as np
import torch
from cli_extra import image

from analytic_rasterizer import io
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.training import rendering as g

SIZE, FOCAL = (320, 240), 300.0  # px
SPECKLES = 9000


def room() -> Gaussians:
    """The corner of a room, its floor and two walls, covered with coloured speckles of many sizes."""
    generator = torch.Generator().manual_seed(7)
    uniform = 3.2 * torch.rand(SPECKLES, 3, generator=generator) - 1.6
    side = torch.randint(3, (SPECKLES,), generator=generator)
    uniform[torch.arange(SPECKLES), side] = 1.6
    made = Gaussians.from_points(uniform, torch.rand(SPECKLES, 3, generator=generator), 0)
    sizes = torch.exp(torch.rand(SPECKLES, 1, generator=generator) * math.log(6)) * 0.012
    return made._replace(
        log_scales=sizes.expand(-1, 3).log().contiguous(), logit_opacities=torch.full((SPECKLES, 1), 4.0)
    )


def walk(count: int) -> list[io.View]:
    """Cameras on a path before the corner, which look into it."""
    views = []
    for i in range(count):
        along = i / max(count - 1, 1) - 0.5
        place = torch.tensor([-2.2 + 2.4 * along, -1.4 + 0.5 * math.sin(5 * along), -2.2 - 2.4 * along]).double()
        ahead = torch.tensor([0.7, 0.7, 0.7]).double() - place
        ahead = ahead / ahead.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).double(), ahead)
        right = right / right.norm()
        w2c = torch.eye(4, dtype=torch.float64)
        w2c[:3, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
        w2c[:3, 3] = -w2c[:3, :3] @ place
        views.append(io.View(f"p_{i}", *SIZE, FOCAL, FOCAL, w2c))
    return views


def draw(view) -> np.ndarray:
    """(H, W, 3) uint8 of the room."""
    color, _ = g.render(room().arguments(), view.settings(1, sh_degree=0, footprint="box"))
    return (255 * color.clamp(0, 1)).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def write_photographs(folder, views, suffix=".png", exif=None) -> None:
    """A file for each view, by its name."""
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        more = {} if exif is None else {"exif": exif}
        image.fromarray(draw(view)).save(folder / f"{view.name}{suffix}", **more)


def places(views) -> dict[str, torch.Tensor]:
    """Camera centres (3,) float64 by the names of views."""
    return {view.name: torch.linalg.inv(view.w2c)[:3, 3] for view in views}


def disagreement(found: dict[str, torch.Tensor], true: dict[str, torch.Tensor]) -> float:
    """The median distance of camera centres from the true ones, as a share of the scene's size: 1.1 times the largest
    distance of a camera from their mean (3DGS).

    The similarity that aligns them is that of least squares. Source: Umeyama, Least-squares estimation of
    transformation parameters, TPAMI 1991.
    """
    names = sorted(found.keys() & true.keys())
    own, other = (torch.stack([places[name] for name in names]) for places in (found, true))
    a, b = own - own.mean(0), other - other.mean(0)
    left, values, right = torch.linalg.svd(b.T @ a)
    signs = torch.tensor([1.0, 1.0, torch.linalg.det(left @ right).sign().item()], dtype=torch.float64)
    turn = left @ torch.diag(signs) @ right
    scale = (values * signs).sum() / a.square().sum()
    apart = (scale * a @ turn.T - b).norm(dim=1)
    return (apart.median() / (1.1 * b.norm(dim=1).max())).item()
