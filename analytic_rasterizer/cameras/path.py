"""Camera paths for films: around a scene, and through the views of a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from .camera import View
from .focus import focus, position  # noqa: F401  (names that this module had)
from .rotations import quaternion, rotation_matrices
from .up import level_up  # noqa: F401

HIGHEST = math.radians(80)  # elevation of an orbit: above it the direction of up would turn with the camera


def orbit(views: Sequence[View], center: Tensor, up: Tensor, frames: int) -> list[View]:
    """A full circle about a point, which every frame looks at.

    The circle has the median distance and the median elevation of the views. It begins in the direction of the first
    view, and has the size and the focal lengths of this view.

    Args:
        views: At least one.
        center: (3,) the point, world units.
        up: (3,) direction that is up, of any length.
        frames: Number of frames; the next one would be the first again.

    Raises:
        ValueError: The views are at the point, or there are no frames.
    """
    _check_frames(frames)
    center, up = center.double(), torch.nn.functional.normalize(up.double(), dim=0)
    offsets = torch.stack([position(view) for view in views]) - center
    distances = offsets.norm(dim=1)
    distance = distances.median()
    if not distance > 1e-9 * (1 + center.norm()):
        raise ValueError("an orbit needs views that are away from its centre: these are at it")
    away = distances > 0
    heights = (offsets[away] @ up) / distances[away]
    elevation = heights.clamp(-1, 1).asin().median().clamp(-HIGHEST, HIGHEST)
    first = _across(offsets[0], up)
    second = torch.linalg.cross(up, first)
    found = []
    for i in range(frames):
        angle = torch.tensor(2 * math.pi * i / frames, dtype=torch.float64)
        level = angle.cos() * first + angle.sin() * second
        place = center + distance * (elevation.cos() * level + elevation.sin() * up)
        found.append(replace(views[0], name=_name(i), w2c=looking_at(place, center, up)))
    return found


def through(views: Sequence[View], frames: int) -> list[View]:
    """A smooth path from the first of the views through all others, in their order, to the last.

    Positions lie on a Catmull-Rom spline, rotations are interpolated along the shortest arcs, focal lengths by their
    logarithms. All frames have the size of the first view.

    Args:
        views: At least two.
        frames: Number of frames, evenly spread: each leg between two views takes the same time.

    Raises:
        ValueError: There are fewer than two views, or there are no frames.
    """
    _check_frames(frames)
    if len(views) < 2:
        raise ValueError(f"a path through views needs at least 2 of them, got {len(views)}")
    places = torch.stack([position(view) for view in views])
    turns = torch.stack([quaternion(view.w2c[:3, :3]) for view in views])
    lenses = torch.stack([_lens(view, views[0]) for view in views])
    # Beyond both ends the path goes on as it would when seen in a mirror.
    ends = 2 * places[:1] - places[1:2], 2 * places[-1:] - places[-2:-1]
    places = torch.cat([ends[0], places, ends[1]])
    found = []
    for i in range(frames):
        at = i * (len(views) - 1) / max(frames - 1, 1)
        leg = min(int(at), len(views) - 2)
        t = at - leg
        rotation = rotation_matrices(_between(turns[leg], turns[leg + 1], t))
        w2c = torch.eye(4, dtype=torch.float64, device="cpu")
        w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ _catmull_rom(places[leg : leg + 4], t)
        focal_x, focal_y, x, y = ((1 - t) * lenses[leg] + t * lenses[leg + 1]).tolist()
        lens = {"fx": math.exp(focal_x), "fy": math.exp(focal_y)}
        lens |= {"cx": views[0].width / 2 + x, "cy": views[0].height / 2 + y}
        found.append(replace(views[0], name=_name(i), w2c=w2c, **lens))
    return found


def looking_at(place: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """(4, 4) world to camera, float64, of a camera at `place` that has `target` in its centre; all (3,)."""
    forward = torch.nn.functional.normalize(target - place, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    w2c = torch.eye(4, dtype=torch.float64, device="cpu")
    w2c[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    w2c[:3, 3] = -w2c[:3, :3] @ place
    return w2c


def _between(a: Tensor, b: Tensor, t: float) -> Tensor:
    """Unit quaternion at the share t of the shortest arc from a to b."""
    cos = torch.dot(a, b)
    b, cos = torch.where(cos < 0, -b, b), cos.abs().clamp(max=1)
    angle = cos.acos()
    if angle < 1e-6:
        return torch.nn.functional.normalize((1 - t) * a + t * b, dim=0)
    return (((1 - t) * angle).sin() * a + (t * angle).sin() * b) / angle.sin()


def _catmull_rom(points: Tensor, t: float) -> Tensor:
    """The point (3,) at the share t of the way from the second to the third of four points (4, 3)."""
    before, start, end, after = points
    linear = end - before
    square = 2 * before - 5 * start + 4 * end - after
    cube = 3 * (start - end) + after - before
    return start + 0.5 * t * (linear + t * (square + t * cube))


def _lens(view: View, like: View) -> Tensor:
    """(4,) logarithms of fx and fy and the principal point's offset from the centre, in a picture as large as `like`:
    the view is scaled so that both have the same area, whatever their orientation."""
    scale = math.sqrt(like.width * like.height / (view.width * view.height))
    x = 0.0 if view.cx is None else scale * (view.cx - view.width / 2)
    y = 0.0 if view.cy is None else scale * (view.cy - view.height / 2)
    lens = [math.log(scale * view.fx), math.log(scale * view.fy), x, y]
    return torch.tensor(lens, dtype=torch.float64, device="cpu")


def _across(direction: Tensor, up: Tensor) -> Tensor:
    """Unit vector (3,) of the part of `direction` that is across `up`; any such vector where there is none."""
    level = direction - (direction @ up) * up
    if level.norm() <= 1e-6 * direction.norm():
        axis = torch.eye(3, dtype=torch.float64, device="cpu")[up.abs().argmin()]
        level = axis - (axis @ up) * up
    return torch.nn.functional.normalize(level, dim=0)


def _name(i: int) -> str:
    return f"frame_{i:05d}"


def _check_frames(frames: int) -> None:
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
