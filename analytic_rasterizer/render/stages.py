"""The three stages of a rendering, each on its own: `project`, `list_tiles`, `blend`.

`GaussianRasterizer` runs the three in one operator. Call them one by one to render several pictures from one
projection, several cameras at once, or splats that come from elsewhere. All run on the CPU (float32, float64) and on
CUDA (float32).

    splats = ar.project(settings, means3D, opacities, scales=scales, rotations=rotations)
    lists = ar.list_tiles(splats)
    image, alpha = ar.blend(splats, lists, features[splats.gaussian_ids])
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch

from .. import _C
from ..checks import check_tensors
from ..ops import Op
from .arguments import camera_arguments, gaussian_arguments
from .effects import Effects
from .outputs import before_background, depths, split_background
from .seam import turns_of, with_copies
from .settings import GaussianRasterizationSettings, check_settings


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians: a row for every Gaussian that a camera may see, camera after camera, Gaussians ascending.

    In an equirectangular picture a Gaussian has a row for every place at which it may show: two at the seam, up to
    six near a pole.

    N is the number of rows, C that of cameras. The first five members are differentiable in what `project` was given.

    Attributes:
        means2d: (N, 2) px; pixel centres are at integers.
        cov2d: (N, 3) projected covariances (xx, xy, yy), px^2, to which the footprint has added nothing yet. Gradients
            with respect to it include those through the determinant; that of xy is with respect to the one number that
            fills both off-diagonal places.
        opacities: (N,) multiplied by the amplitude of defocus and motion blur.
        depths: (N,) camera-space z, or with some lenses the distance from the camera (`Effects.lens`), world units.
        colors: (N, 3) RGB where `project` had shs or colors_precomp, else (0, 3).
        radii: (N,) int32, px, as `GaussianRasterizer` returns; positive.
        gaussian_ids: (N,) int32, the row of each splat's Gaussian in what `project` was given.
        camera_ids: (N,) int32, 0 to C - 1.
        row_splits: (C + 1,) int64 on the CPU: the rows of camera c are row_splits[c] to row_splits[c + 1].
        dets: (N,) determinants of cov2d, px^4, which would cancel if they were computed from its entries.
        width, height: Size of the images, px.
        footprint, option: Key and number of the footprint, see `Footprint`. The key says the order too.
        slopes: (N, 2) by how much the depth at which a ray meets the splat grows per px, world units; None unless the
            order is along rays (`Effects.order`).
    """

    means2d: torch.Tensor
    cov2d: torch.Tensor
    opacities: torch.Tensor
    depths: torch.Tensor
    colors: torch.Tensor
    radii: torch.Tensor
    gaussian_ids: torch.Tensor
    camera_ids: torch.Tensor
    row_splits: torch.Tensor
    dets: torch.Tensor
    width: int
    height: int
    footprint: str
    option: float
    slopes: torch.Tensor | None = None

    @property
    def cameras(self) -> int:
        """Number of cameras, C."""
        return len(self.row_splits) - 1

    @property
    def size(self) -> dict[str, Any]:
        """Image size and footprint, by the names of the operators' arguments."""
        return {
            "image_height": self.height,
            "image_width": self.width,
            "footprint": self.footprint,
            "option": self.option,
        }

    def split(self) -> list[Splats]:
        """The splats of every camera by themselves, each as a batch of one camera. Differentiable."""
        if self.cameras == 1:
            return [self]
        sizes = self.row_splits.diff().tolist()
        rows = {name: getattr(self, name).split(sizes) for name in ROWS if name not in ("colors", "row_splits")}
        rows["colors"] = (
            self.colors.split(sizes) if len(self.colors) == len(self.means2d) else [self.colors] * len(sizes)
        )
        rows["camera_ids"] = [torch.zeros_like(ids) for ids in rows["camera_ids"]]
        rows["slopes"] = [None] * len(sizes) if self.slopes is None else self.slopes.split(sizes)
        rows["row_splits"] = [torch.tensor([0, size], device="cpu") for size in sizes]
        return [replace(self, **dict(zip(rows, of_camera))) for of_camera in zip(*rows.values())]


ROWS = tuple(field.name for field in fields(Splats))[:10]
"""Members of `Splats` in the order in which the operator `project` returns them."""
_project, _bin, _blend = map(Op, ("project", "bin", "blend"))


@dataclass(frozen=True)
class TileLists:
    """Which splats may show in every tile, front to back. `list_tiles` makes it for `blend`.

    On CUDA tiles share lists in the rare frame that has more pairs of a splat and a tile than there was room for: those
    where `counts[0]` is larger than the length of `pairs`. `render_stages` has a list for each tile in every case.

    Attributes:
        tensors: The lists, camera after camera, in a form of the device's own (ListTensors in csrc/torch/backend.h).
        cameras: Number of cameras.
    """

    tensors: tuple[torch.Tensor, ...]
    cameras: int

    def of_camera(self, camera: int = 0) -> dict[str, torch.Tensor]:
        """The lists of one camera, by the names of ListTensors.

        Raises:
            IndexError: There is no such camera.
        """
        if not 0 <= camera < self.cameras:
            raise IndexError(f"camera must be 0 to {self.cameras - 1}, got {camera}")
        first = camera * len(_C.LISTS)
        return dict(zip(_C.LISTS, self.tensors[first : first + len(_C.LISTS)]))


def project(
    settings: GaussianRasterizationSettings | Sequence[GaussianRasterizationSettings],
    means3D: torch.Tensor,
    opacities: torch.Tensor,
    *,
    shs: torch.Tensor | None = None,
    colors_precomp: torch.Tensor | None = None,
    scales: torch.Tensor | None = None,
    rotations: torch.Tensor | None = None,
    cov3D_precomp: torch.Tensor | None = None,
) -> Splats:
    """Projects Gaussians into one or several cameras.

    Differentiable in all tensors, and with `Effects(camera_gradients=True)` in the cameras. The gradient with respect
    to scales and rotations passes through cov2d, whose entries are rounded. For a needle, much longer than it is wide,
    that loses digits which `GaussianRasterizer` keeps. The host waits for the device, which counts the rows.

    Args:
        settings: Of the camera, or of each of several. They must agree in image size, scale modifier, degree of the
            harmonics, footprint and 3D filter; background and debug are not read. Outputs of their effects are not
            made.
        means3D: (P, 3) centres, world units.
        opacities: (P, 1) or (P,).
        shs: (P, M, 3) spherical harmonics, or colors_precomp (P, 3), for `Splats.colors`; or neither.
        scales: (P, 3) standard deviations, world units, with rotations (P, 4) (w, x, y, z); or cov3D_precomp (P, 6).

    Returns:
        `Splats` of all cameras.

    Raises:
        TypeError: Not a tensor, a wrong dtype, or settings of another class.
        ValueError: Wrong shape, device or value, or settings that disagree.
        RuntimeError: CUDA tensors, and an extension without CUDA.

    Source: [EWA, Eq. 29-31]; docs/internals/numerics.md.
    """
    # Settings of another class may be a tuple, too: their fields are no cameras.
    several = isinstance(settings, Iterable) and not hasattr(settings, "viewmatrix")
    cameras = list(settings) if several else [settings]
    if not cameras:
        raise ValueError("settings must hold at least one camera, got none")
    splats, turns = project_once(
        cameras,
        means3D,
        opacities,
        shs=shs,
        colors_precomp=colors_precomp,
        scales=scales,
        rotations=rotations,
        cov3D_precomp=cov3D_precomp,
    )
    return splats if turns is None else with_copies(splats, turns)[0]


def project_once(
    cameras: Sequence[GaussianRasterizationSettings], means3D: torch.Tensor, opacities: torch.Tensor, **optional: Any
) -> tuple[Splats, torch.Tensor | None]:
    """As `project`, with one row for a Gaussian in a camera, and what `turns_of` returns."""
    gaussians, batch = project_arguments(cameras, means3D, opacities, **optional)
    turns = turns_of(cameras, means3D)
    made = dict(zip(_project.results, _project(**gaussians, **batch)))
    rows = dict(zip(ROWS, made.values()))
    slopes = made["slopes"] if _C.RAY_MARK in batch["footprint"] else None
    if not rows["colors"].shape[1]:
        rows["colors"] = rows["colors"].new_empty(0, 3)
    size = {"width": batch["image_width"], "height": batch["image_height"]}
    return Splats(**rows, **size, footprint=batch["footprint"], option=batch["option"], slopes=slopes), turns


def project_arguments(
    cameras: Sequence[GaussianRasterizationSettings], means3D: torch.Tensor, opacities: torch.Tensor, **optional: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of the op `project`, and of others that take the same, for one camera or more: the Gaussians, and the
    cameras with the footprint.

    Raises:
        TypeError, ValueError, RuntimeError: As `project`.
    """
    for number, camera in enumerate(cameras):
        check_settings(camera)
        if not _same_filter(camera, cameras[0]):
            raise ValueError(f"settings must agree in filter_3d, but camera {number} has another one than camera 0")
    gaussians = gaussian_arguments(cameras[0], means3D, opacities, **optional)
    shs = optional["shs"]
    arguments = [camera_arguments(camera, means3D, shs, with_seam=True) for camera in cameras]
    if any(a["lens"] is not None for a in arguments):
        arguments = [camera_arguments(camera, means3D, shs, full=True, with_seam=True) for camera in cameras]
    common = ("image_height", "image_width", "scale_modifier", "sh_degree", "footprint", "option")
    shared = {name: arguments[0][name] for name in common}
    for number, a in enumerate(arguments):
        for name in common:
            if a[name] != shared[name]:
                raise ValueError(f"settings must agree in {name}, got {shared[name]} and {a[name]} of camera {number}")
    batch = {name: [a[name] for a in arguments] for name in ("tanfovx", "tanfovy")}
    for name, size in (("viewmatrix", (4, 4)), ("projmatrix", (4, 4)), ("campos", (3,)), ("lens", (-1,))):
        given = [a[name] for a in arguments]
        if given[0] is None:
            batch[name] = None
        elif len(given) == 1:
            batch[name] = given[0].reshape(1, *size)
        else:
            batch[name] = torch.stack([t.reshape(size) for t in given])
    return gaussians, batch | shared


def _same_filter(a: GaussianRasterizationSettings, b: GaussianRasterizationSettings) -> bool:
    """Whether both widen the Gaussians by the same 3D filter, or neither does."""
    one, other = (s.effects.filter_3d if isinstance(s.effects, Effects) else None for s in (a, b))
    if one is other or one is None or other is None:
        return one is other
    return one.device == other.device and one.shape == other.shape and torch.equal(one, other)


def list_tiles(splats: Splats, *, keep: bool = True) -> TileLists:
    """Lists the splats of every tile, in the order of depth. Without gradient. Splats of equal depth keep their order.

    Args:
        splats: What `project` returned.
        keep: Whether to make what the backward pass of `blend` needs, too.

    Returns:
        `TileLists` of all cameras.
    """
    s = splats
    (tensors,) = _bin(
        means2d=s.means2d.detach(),
        cov2d=s.cov2d.detach(),
        dets=s.dets,
        opacities=s.opacities.detach(),
        depths=s.depths.detach(),
        row_splits=s.row_splits,
        keep=keep,
        slopes=s.slopes,
        **s.size,
    )
    return TileLists(tuple(tensors), s.cameras)


def blend(
    splats: Splats,
    lists: TileLists,
    features: torch.Tensor | None = None,
    background: torch.Tensor | None = None,
    *,
    means2d_abs: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blends features of splats, front to back, into an image per camera: all channels in one pass.

    Differentiable in means2d, cov2d and opacities of the splats, in features and in background.

    Args:
        splats: The splats from which `lists` were made.
        lists: What `list_tiles` returned, with keep=True where a gradient is wanted.
        features: (N, K) a row per splat, K from 1 to 512; None: the splats' colours. A feature that is not finite
            spreads to the pixels of its splat.
        background: (K,) for all cameras or (C, K); None: zero.
        means2d_abs: (N, 2), a tensor that requires a gradient. Its values are ignored, and its gradient is the sum over
            pixels of the absolute values of dL/dmeans2d, which density control reads.

    Returns:
        image: (C, K, H, W).
        alpha: (C, 1, H, W), 1 - transmittance, in 0 to 1.

    Raises:
        TypeError: Not a tensor, or a wrong dtype.
        ValueError: Wrong shape or device, or lists of other splats.
    """
    s = splats
    features = s.colors if features is None else features
    check_tensors(s.means2d.device, features=features)
    if features.dim() != 2:
        raise ValueError(f"features must have shape ({len(s.means2d)}, K), got {tuple(features.shape)}")
    shape = s.cameras, features.shape[1]
    if background is None:
        background = features.new_zeros(shape)
    else:
        check_tensors(s.means2d.device, background=background)
        if background.shape not in (shape, shape[1:]):
            raise ValueError(f"background must have shape {shape[1:]} or {shape}, got {tuple(background.shape)}")
        background = background.expand(shape)
    if means2d_abs is not None:
        check_tensors(s.means2d.device, means2d_abs=means2d_abs)
    image, alpha, _ = _blend(
        means2d=s.means2d,
        cov2d=s.cov2d,
        opacities=s.opacities,
        features=features,
        background=background,
        means2d_abs=means2d_abs,
        dets=s.dets,
        row_splits=s.row_splits,
        lists=list(lists.tensors),
        **s.size,
    )
    return image, alpha[:, None]


class Stages(NamedTuple):
    """What the stages of one rendering produced.

    Attributes:
        color: (3, H, W) image.
        radii: (P,) int32, as `GaussianRasterizer` returns.
        ids: (V,) int32, the Gaussian of each of the V splats, ascending.
        depths: (V,) camera-space z, world units.
        means2d: (V, 2) px.
        pairs: (N,) int32, the splat of each of the N (tile, splat) pairs, by tile, then front to back.
        tile_offsets: (tiles + 1,) int64, first pair of each tile, tiles row by row. Tiles have 16x16 px. On CUDA those
            of `moment` have 8x8, except with one cell in images of 4096 or more tiles of 8x8 px, where they have 16x16,
            and with 16 cells in smaller ones, where they have 4x4; those of `box` with 16 samples have 4x4, and
            with 4 in images of fewer than 4096 tiles of 16x16 px 8x8.
        seconds: Time of each stage, s: "project", "list_tiles", "blend".
    """

    color: torch.Tensor
    radii: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    means2d: torch.Tensor
    pairs: torch.Tensor
    tile_offsets: torch.Tensor
    seconds: dict[str, float]


@torch.no_grad()
def render_stages(
    settings: GaussianRasterizationSettings,
    means3D: torch.Tensor,
    opacities: torch.Tensor,
    shs: torch.Tensor | None = None,
    colors_precomp: torch.Tensor | None = None,
    scales: torch.Tensor | None = None,
    rotations: torch.Tensor | None = None,
    cov3D_precomp: torch.Tensor | None = None,
) -> Stages:
    """Renders without gradient, keeping and timing what each stage makes. For inspection; waits for the device.

    Outputs that the effects of the settings ask for are not made.

    Arguments and errors are those of `GaussianRasterizer.forward`.
    """
    gaussians = gaussian_arguments(
        settings,
        means3D,
        opacities,
        means2D=None,
        shs=shs,
        colors_precomp=colors_precomp,
        scales=scales,
        rotations=rotations,
        cov3D_precomp=cov3D_precomp,
    )
    camera = camera_arguments(settings, means3D, shs)
    check_tensors(means3D.device, bg=settings.bg)
    size = camera["image_height"], camera["image_width"]
    bg, bg_image = split_background(settings.bg, gaussians["colors_precomp"], size)
    color, images, radii, _, saved, seconds = torch.ops.analytic_rasterizer.rasterize_timed(
        **gaussians, **camera, bg=bg, alpha=bg_image is not None
    )
    if bg_image is not None:
        color = before_background(color, images[0][None], bg_image)
    lists = dict(zip(_C.LISTS, saved))
    ids, splats, pairs = lists["ids"], lists["splats"], lists["pairs"]
    if means3D.is_cuda:  # every Gaussian has a row; here only those that are kept
        kept = radii > 0
        ids = kept.nonzero()[:, 0].int()
        places = kept.cumsum(0) - 1
        splats, pairs = splats[kept], places[pairs[: lists["tile_offsets"][-1], 0].long()].int()
    z = depths(means3D, settings.viewmatrix, settings.effects)[ids.long()]
    times = dict(zip(("project", "list_tiles", "blend"), seconds.tolist()))
    means2d = splats[:, :2].clone()
    return Stages(color, radii, ids, z, means2d, pairs, lists["tile_offsets"], times)
