"""The drop-in API of diff_gaussian_rasterization: settings, rasterizer, and what stands behind them."""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import torch

from . import (
    channels,
    ops,  # noqa: F401  (registers the fake kernels)
)
from .camera import make_lens
from .effects import AUTO, MAX_SH_DEGREE, NEAR, Effects, depths
from .filters import apply_3d_filter
from .footprints import Footprint, check_device, get_default_footprint, resolve_footprint
from .sh import used_sh_degree

_NOTHING = Effects()


class _Fields(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: torch.Tensor
    scale_modifier: float
    viewmatrix: torch.Tensor
    projmatrix: torch.Tensor
    sh_degree: int
    campos: torch.Tensor
    prefiltered: bool
    debug: bool


class GaussianRasterizationSettings(_Fields):
    """How to render: the 12 fields of 3DGS 2023, in its order, as a tuple; and the footprint and the effects.

    Args:
        image_height, image_width: Size of the image, px.
        tanfovx, tanfovy: Tangent of half the field of view.
        bg: (3,) background colour; (C,) of C channels; or (C, H, W), an image, differentiable.
        scale_modifier: Factor on all scales.
        viewmatrix: (4, 4) or (1, 4, 4) world to camera, transposed (for row vectors).
        projmatrix: (4, 4) or (1, 4, 4) world to clip space, transposed. The principal point is wherever
            it puts it.
        sh_degree: Degree of the spherical harmonics in use, 0 to 4.
        campos: (3,) camera centre, world units.
        prefiltered: Accepted for compatibility; culling does not depend on it.
        debug: Raise for a Gaussian that is not finite, has an opacity outside [0, 1] or a negative scale or
            variance, naming tensor, index and value; otherwise such a Gaussian is culled or taken as it is. On
            failure write the arguments to snapshot_fw.dump or snapshot_bw.dump and re-raise. On CUDA wait
            for every stage, so that the stage that failed is the one that raises, and check that the
            camera is finite, which otherwise is not looked at there.
        footprint: One of `FOOTPRINTS`, optionally with options (`"box:samples=8"`). None: the default at
            the time of rendering, see `set_default_footprint`.
        effects: What the rendering has beyond three colours of a pinhole, see `Effects`; None: nothing. "auto":
            harmonics only up to the degree that changes a colour by 1/255 (`needed_sh_degree`; found once for
            coefficients that stay the same tensor, and not at all while they are trained).
        **options: Options of the footprint, see `resolve_footprint`.

    Attributes:
        footprint: The settled `Footprint`, or None.
        effects: The `Effects`, "auto", or None.

    Raises:
        ValueError: Unknown footprint or option.
        TypeError: effects is neither.
    """

    # Also where a tuple method makes an instance without __new__.
    footprint: Footprint | None = None
    effects: Effects | str | None = None

    def __new__(
        cls, *args: Any, footprint: str | Footprint | None = None, effects: Effects | str | None = None, **kwargs: Any
    ):
        fields = {k: kwargs.pop(k) for k in _Fields._fields[len(args) :] if k in kwargs}
        self = super().__new__(cls, *args, **fields)
        if footprint is not None:
            self.footprint = resolve_footprint(str(footprint), **kwargs)
        elif kwargs:
            known = ", ".join((*cls._fields, "footprint", "effects"))
            raise TypeError(f"settings must be among: {known}; got {', '.join(kwargs)}")
        if effects is not None:
            if not isinstance(effects, Effects) and effects != AUTO:
                raise TypeError(f'effects must be an Effects or "auto", got {effects!r}')
            self.effects = effects
        return self

    def _replace(self, **kwargs: Any) -> GaussianRasterizationSettings:
        merged = {**self._asdict(), "footprint": self.footprint, "effects": self.effects, **kwargs}
        return type(self)(**merged)

    def __reduce__(self):
        footprint = None if self.footprint is None else str(self.footprint)
        return _unpickle_settings, (tuple(self), footprint, self.effects)

    def __repr__(self) -> str:
        fields = ", ".join(f"{k}={v!r}" for k, v in self._asdict().items())
        effects = "" if self.effects is None else f", effects={self.effects}"
        return f"{type(self).__name__}({fields}, footprint={str(self.footprint)!r}{effects})"


# Downstream code probes the signature to tell dialects apart: it must be 3DGS 2023's.
GaussianRasterizationSettings.__signature__ = inspect.signature(_Fields)


def _unpickle_settings(
    fields: tuple, footprint: str | None, effects: Effects | str | None = None
) -> GaussianRasterizationSettings:
    return GaussianRasterizationSettings(*fields, footprint=footprint, effects=effects)


def _check_tensors(device: torch.device | None, **tensors: Any) -> None:
    """Raises unless all are tensors, and on `device` if it is given."""
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if device is not None and tensor.device != device:
            raise ValueError(f"{name} must be on the device of means3D, {device}, got {tensor.device}")


def _optional(device: torch.device, **tensors: Any) -> list[torch.Tensor | None]:
    """The same for inputs that may be missing, which 3DGS passes as empty tensors on whatever device."""
    present = []
    for name, tensor in tensors.items():
        if isinstance(tensor, torch.Tensor) and tensor.dim() == 1 and tensor.numel() == 0:
            tensor = None
        if tensor is not None:
            _check_tensors(device, **{name: tensor})
        present.append(tensor)
    return present


def _settings_arguments(
    settings: GaussianRasterizationSettings, means3D: torch.Tensor, shs: torch.Tensor | None
) -> tuple:
    """What the ops take after the Gaussians."""
    s, effects = settings, settings.effects
    _check_tensors(means3D.device, bg=s.bg, viewmatrix=s.viewmatrix, projmatrix=s.projmatrix, campos=s.campos)
    footprint = s.footprint or get_default_footprint()
    camera, tangents, lens, degree = (s.viewmatrix, s.projmatrix, s.campos), (s.tanfovx, s.tanfovy), None, s.sh_degree
    if effects is not None:
        degree = used_sh_degree(effects, int(degree), shs)
    full = effects if isinstance(effects, Effects) else _NOTHING
    if degree >= MAX_SH_DEGREE or (full is not _NOTHING and full.changes_camera):
        lens = make_lens(full, s, means3D)
        if full.camera_gradients:
            tangents = (1.0, 1.0)  # the lens has them
        else:
            camera = tuple(t.detach() for t in camera)
    return (
        s.bg, *camera, lens, int(s.image_height), int(s.image_width), *(float(t) for t in tangents),
        float(s.scale_modifier), int(degree), footprint.key, footprint.option,
    )  # fmt: skip


def _filtered(settings: GaussianRasterizationSettings, opacities, scales, cov3D_precomp) -> tuple:
    """Opacities and scales with the 3D filter of the effects."""
    effects = settings.effects
    if not isinstance(effects, Effects) or effects.filter_3d is None:
        return opacities, scales
    if scales is None:
        raise ValueError(
            f"filter_3d needs scales and rotations, got {'neither' if cov3D_precomp is None else 'cov3D_precomp'}"
        )
    # The scale modifier is not the filter's: pictures are sampled as they are.
    scales, opacities = apply_3d_filter(scales, opacities, effects.filter_3d / settings.scale_modifier)
    return opacities, scales


def rasterize_gaussians(
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    sh: torch.Tensor | None,
    colors_precomp: torch.Tensor | None,
    opacities: torch.Tensor,
    scales: torch.Tensor | None,
    rotations: torch.Tensor | None,
    cov3Ds_precomp: torch.Tensor | None,
    raster_settings: GaussianRasterizationSettings,
) -> tuple[torch.Tensor, ...]:
    """Renders Gaussians. The functional form of `GaussianRasterizer.forward`, which says more."""
    _check_tensors(None, means3D=means3D)
    device = means3D.device
    check_device(device)
    _check_tensors(device, opacities=opacities)
    means2D, shs, colors_precomp, scales, rotations, cov3D_precomp = _optional(
        device,
        means2D=means2D,
        shs=sh,
        colors_precomp=colors_precomp,
        scales=scales,
        rotations=rotations,
        cov3D_precomp=cov3Ds_precomp,
    )
    debug, effects = bool(raster_settings.debug), raster_settings.effects
    opacities, scales = _filtered(raster_settings, opacities, scales, cov3D_precomp)
    gaussians = (means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
    settings = _settings_arguments(raster_settings, means3D, shs)
    asked = effects if isinstance(effects, Effects) else _NOTHING
    if not channels.is_plain(asked, colors_precomp, raster_settings.bg):
        if debug:
            _check_gaussians(*gaussians)  # of all channels; the op sees three
        rasterize = _DebugRasterize.apply if debug else _rasterize
        color, radii, outputs = channels.render(rasterize, gaussians, settings, asked, debug)
        return (color, radii, outputs) if asked.has_outputs else (color, radii)
    of_camera = settings[1:5] if settings[4] is not None else ()
    keep = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (*gaussians, *of_camera))
    arguments = (*gaussians, *settings, keep, False, debug)
    if debug:
        return _DebugRasterize.apply(*arguments)[:2]
    return torch.ops.analytic_rasterizer.rasterize(*arguments)[:2]


def _rasterize(*arguments) -> tuple[torch.Tensor, ...]:
    """The op's outputs, alpha among them if it is asked for."""
    *outputs, alpha = torch.ops.analytic_rasterizer.rasterize(*arguments)
    return (*outputs, *alpha)


def _check_gaussians(
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    opacities: torch.Tensor,
    shs: torch.Tensor | None,
    colors_precomp: torch.Tensor | None,
    scales: torch.Tensor | None,
    rotations: torch.Tensor | None,
    cov3D_precomp: torch.Tensor | None,
) -> None:
    """Raises ValueError for the first value that no Gaussian should have. Without debug its Gaussian is culled."""
    tensors = {"means3D": means3D, "opacities": opacities, "shs": shs, "colors_precomp": colors_precomp}
    tensors |= {"scales": scales, "rotations": rotations, "cov3D_precomp": cov3D_precomp}
    tensors = {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None}
    for name, tensor in tensors.items():
        _check_values(name, tensor, torch.isfinite(tensor), "be finite")
    _check_values("opacities", opacities, (opacities >= 0) & (opacities <= 1), "be in [0, 1]")
    if scales is not None:
        _check_values("scales", scales, scales >= 0, "not be negative")
    elif cov3D_precomp is not None and cov3D_precomp.shape[1:] == (6,):  # else the op says what shape it must have
        valid = cov3D_precomp >= 0
        valid[:, [1, 2, 4]] = True
        _check_values("cov3D_precomp", cov3D_precomp, valid, "not have negative variances")


def _check_values(name: str, tensor: torch.Tensor, valid: torch.Tensor, expectation: str) -> None:
    if not valid.all():
        index = tuple(torch.nonzero(~valid)[0].tolist())
        raise ValueError(f"{name} must {expectation}, got {tensor[index].item()} at {index}")


class _DebugRasterize(torch.autograd.Function):
    """The op and its gradient, writing their arguments to a file where they fail, as 3DGS does."""

    @staticmethod
    def forward(ctx, *arguments):
        try:
            _check_gaussians(*arguments[:8])
            output = torch.ops.analytic_rasterizer.rasterize(*arguments)
        except Exception:
            _write_snapshot("snapshot_fw.dump", arguments)
            raise
        ctx.set_materialize_grads(False)
        tensors, (*ctx.settings, _, _, ctx.debug) = arguments[:13], arguments[13:]
        *output, alpha = output
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*tensors, *output[2:])
        return (*output, *alpha)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, dL_dcolor, *others):
        none = [None] * len(ctx.needs_input_grad)
        dL_dalpha = others[13] if len(others) > 13 else None
        if dL_dcolor is None and dL_dalpha is None:
            return tuple(none)
        if dL_dcolor is None:
            dL_dcolor = dL_dalpha.new_zeros(3, *dL_dalpha.shape)
        tensors, saved = ctx.saved_tensors[:13], ctx.saved_tensors[13:]
        of_camera = tensors[9:] if tensors[12] is not None else (None,) * 4
        inputs = (*tensors[:8], *of_camera)
        wanted = (*ctx.needs_input_grad[:8], *ctx.needs_input_grad[9:13])
        needs = [need and t is not None for need, t in zip(wanted, inputs)]
        arguments = (dL_dcolor, dL_dalpha, *tensors, *ctx.settings, *saved, needs, ctx.debug)
        try:
            *grads, of_camera = torch.ops.analytic_rasterizer.rasterize_vjp(*arguments)
        except Exception:
            _write_snapshot("snapshot_bw.dump", arguments)
            raise
        grads += of_camera or [None] * 4
        grads = [g.view_as(t) if need else None for g, t, need in zip(grads, inputs, needs)]
        return (*grads[:8], None, *grads[8:], *none[13:])


def _write_snapshot(path: str, arguments: tuple) -> None:
    copies = tuple(a.detach().cpu() if isinstance(a, torch.Tensor) else a for a in arguments)
    torch.save(copies, path)


class GaussianRasterizer(torch.nn.Module):
    """Renders 3D Gaussians with the settings it holds."""

    def __init__(self, raster_settings: GaussianRasterizationSettings):
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: torch.Tensor) -> torch.Tensor:
        """Which positions lie in front of the near plane, camera-space z > 0.2 or as the effects have it.

        Args:
            positions: (P, 3) world units.

        Returns:
            (P,) bool.

        Raises:
            TypeError: Not a tensor, or not of the dtype of the settings' viewmatrix.
            ValueError: Wrong shape.
        """
        _check_tensors(None, positions=positions)
        if positions.dim() != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions must have shape (P, 3), got {tuple(positions.shape)}")
        view = self.raster_settings.viewmatrix.reshape(4, 4)
        if positions.dtype != view.dtype:
            raise TypeError(f"positions must have dtype {view.dtype}, got {positions.dtype}")
        effects = self.raster_settings.effects
        near = effects.near if isinstance(effects, Effects) else NEAR
        with torch.no_grad():
            return depths(positions, view) > near

    def forward(
        self,
        means3D: torch.Tensor,
        means2D: torch.Tensor | None,
        opacities: torch.Tensor,
        shs: torch.Tensor | None = None,
        colors_precomp: torch.Tensor | None = None,
        scales: torch.Tensor | None = None,
        rotations: torch.Tensor | None = None,
        cov3D_precomp: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """Renders an image. Differentiable in all eight inputs.

        All floating tensors share one dtype (float32; float64 on the CPU) and device. Missing inputs
        are None or empty tensors. On CUDA the work is queued on the current stream and nothing waits for
        it once 32 frames of an image size have been rendered.

        Args:
            means3D: (P, 3) centres, world units.
            means2D: (P, 3) or (P, 4) whose values are ignored, or None. Its gradient's first two columns
                are dL/d(projected mean) per (0.5 W, 0.5 H) px, the third is zero, and columns 2 and 3 of
                a (P, 4) input are sums over pixels of the absolute values instead.
            opacities: (P, 1) or (P,).
            shs: (P, M, 3) spherical harmonics, M >= (sh_degree + 1)^2; or colors_precomp.
            colors_precomp: (P, 3) RGB, or (P, C) features of 1 to 512 channels.
            scales: (P, 3) standard deviations, world units, with rotations; or cov3D_precomp.
            rotations: (P, 4) quaternions (w, x, y, z) of any length; zero is the identity.
            cov3D_precomp: (P, 6) covariances (xx, xy, xz, yy, yz, zz).

        Returns:
            color: (3, H, W) image; (C, H, W) of C channels.
            radii: (P,) int32, 3 standard deviations of the projected Gaussian in px, rounded up; 0 for
                a Gaussian that was culled.
            outputs: `Outputs`, only where the settings ask for effects.

        Raises:
            TypeError: Not a tensor, or a wrong dtype.
            ValueError: Wrong shape, device or value. The message names the argument, what was expected
                and what came.
            RuntimeError: CUDA tensors, and an extension without CUDA; or an error of CUDA.
            torch.OutOfMemoryError: No room for splats, pairs or gradients on the device.
        """
        return rasterize_gaussians(
            means3D,
            means2D,
            shs,
            colors_precomp,
            opacities,
            scales,
            rotations,
            cov3D_precomp,
            self.raster_settings,
        )


class Stages(NamedTuple):
    """What the stages of one rendering produced.

    Attributes:
        color: (3, H, W) image.
        radii: (P,) int32, as `GaussianRasterizer` returns.
        ids: (V,) int32, the Gaussian of each splat, ascending.
        depths: (V,) camera-space z, world units.
        means2d: (V, 2) px.
        pairs: (N,) int32, the splat of each (tile, splat) pair, by tile, then front to back.
        tile_offsets: (tiles + 1,) int64, first pair of each 16x16 tile, tiles row by row.
        seconds: Time per stage: "project", "bin", "blend".
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
    """Renders without gradient, keeping and timing what each stage makes. For inspection.

    Arguments and errors are those of `GaussianRasterizer.forward`.
    """
    _check_tensors(None, means3D=means3D)
    device = means3D.device
    check_device(device)
    _check_tensors(device, opacities=opacities)
    shs, colors_precomp, scales, rotations, cov3D_precomp = _optional(
        device, shs=shs, colors_precomp=colors_precomp, scales=scales, rotations=rotations, cov3D_precomp=cov3D_precomp
    )
    opacities, scales = _filtered(settings, opacities, scales, cov3D_precomp)
    *tensors, seconds = torch.ops.analytic_rasterizer.rasterize_stages(
        means3D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp,
        *_settings_arguments(settings, means3D, shs),
    )  # fmt: skip
    return Stages(*tensors, dict(zip(("project", "bin", "blend"), seconds.tolist())))
