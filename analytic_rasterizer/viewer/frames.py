"""Frames of scenes that may change, rendered by the library's own kernels for any footprint.

Used by `LiveViewer`. Needs nothing but the library itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from .. import io
from ..cameras.rotations import rotation_matrices
from ..footprints import footprint_variants, resolve_footprint
from ..gaussians import Gaussians
from ..render.effects import Effects
from ..render.order import CENTER, can_be_in
from ..render.rasterizer import GaussianRasterizer

MOVING_SECONDS = 0.06
"""What a frame should take while its camera moves; the resolution adapts to it."""
FIRST_MOVING_PIXELS = 40_000
"""Pixels of such a frame as long as nothing is known."""
SMALLEST_MOVING_SCALE = 1 / 8
LARGEST_SIDE = 8192
"""Pixels of a frame along one side, at most."""


LIVE_FOOTPRINTS = footprint_variants()
"""The footprints that can be chosen in a live viewer: all of them, with every number of samples."""


def camera_view(position, wxyz, fov: float, width: int, height: int) -> io.View:
    """The pinhole of a camera of viser, whose axes are x right, y down, z forward, as those of `View`.

    Args:
        position: (3,) world units.
        wxyz: (4,) quaternion of the rotation from camera to world, of any length but zero.
        fov: Vertical field of view, radians, between 0 and pi.
        width, height: Size of the picture, px, 1 to `LARGEST_SIDE`.

    Raises:
        ValueError: Numbers that are not finite or out of their range.
    """
    pose = torch.as_tensor(np.concatenate([position, wxyz]), dtype=torch.float64, device="cpu")
    if not (pose.shape == (7,) and pose.isfinite().all() and pose[3:].norm() > 0):
        raise ValueError(f"position and wxyz must be 3 and 4 finite numbers, wxyz not zero, got {pose.tolist()}")
    if not 0 < fov < math.pi:
        raise ValueError(f"fov must be between 0 and pi, got {fov}")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise ValueError(f"width and height must be from 1 to {LARGEST_SIDE}, got {width} and {height}")
    w2c = torch.eye(4, dtype=torch.float64, device="cpu")
    w2c[:3, :3] = rotation_matrices(pose[3:] / pose[3:].norm(), unit=True).T  # the rows are the axes of the camera
    w2c[:3, 3] = -w2c[:3, :3] @ pose[:3]
    focal = height / (2 * math.tan(fov / 2))
    return io.View("live", width, height, focal, focal, w2c)


@torch.no_grad()
def render_frame(
    scene: Gaussians, view: io.View, footprint: str, background=(0.0, 0.0, 0.0), order: str = CENTER
) -> np.ndarray:
    """Renders a view on the device of the scene, in an `Effects.order` if the footprint can have it.

    Returns:
        (H, W, 3) uint8: the rasterizer's picture, clamped to [0, 1] and rounded to 8 bits.

    Raises:
        ValueError: As `resolve_footprint` and `GaussianRasterizer`.
    """
    effects = Effects(order=order if can_be_in(resolve_footprint(footprint), order) else CENTER)
    settings = view.settings(1.0, background, scene.sh_degree, footprint, device=scene.means.device, effects=effects)
    color, *_ = GaussianRasterizer(settings)(means2D=None, **scene.arguments())
    return color.clamp(0, 1).mul(255).round().to("cpu", torch.uint8).permute(1, 2, 0).contiguous().numpy()


class Cost(NamedTuple):
    """What a frame has taken."""

    pixels: int
    seconds: float


def moving_pixels(settled: Cost | None, moving: Cost | None) -> float:
    """Pixels that a frame may have while its camera moves, given the last frames at rest and in motion.

    Two frames tell what a frame takes whatever its size, to project and sort, and what each pixel adds. Pixels get what
    is left of `MOVING_SECONDS`, or a quarter of the rest, below which a smaller frame is hardly a faster one.
    """
    if settled is None or moving is None:
        return FIRST_MOVING_PIXELS
    if moving.pixels >= settled.pixels:
        return math.inf if moving.seconds <= 2 * MOVING_SECONDS else moving.pixels / 2
    per_pixel = max((settled.seconds - moving.seconds) / (settled.pixels - moving.pixels), 1e-12)
    fixed = max(moving.seconds - per_pixel * moving.pixels, 0.0)
    return max(MOVING_SECONDS - fixed, fixed / 4) / per_pixel


class Snapshot(NamedTuple):
    """A scene that nobody changes, and when it is complete."""

    scene: Gaussians
    ready: torch.cuda.Event | None
    """Recorded on the stream of whoever made the tensors; None on the CPU."""

    def wait(self) -> None:
        """Makes the current stream wait until the tensors are filled, and keeps their memory for it."""
        if self.ready is None:
            return
        stream = torch.cuda.current_stream(self.scene.means.device)
        stream.wait_event(self.ready)
        for tensor in self.scene:
            tensor.record_stream(stream)


@torch.no_grad()
def take_snapshot(scene: Gaussians | Callable[[], Gaussians], copy: bool) -> Snapshot:
    """What `LiveViewer.update` is given, checked, and where asked for copied."""
    given = scene() if callable(scene) else scene
    if not isinstance(given, Gaussians):
        raise TypeError(f"scene must be Gaussians or a function that returns them, got {type(given).__name__}")
    if len(given.means) == 0:
        raise ValueError("scene must have Gaussians, got none")
    taken = given.map(lambda field: field.detach().to(torch.float32, copy=copy).contiguous())
    ready = None
    if given.means.is_cuda:
        ready = torch.cuda.Event()
        ready.record(torch.cuda.current_stream(given.means.device))
    return Snapshot(taken, ready)
