"""From what users give to the arguments of the operators: checked, named, and completed by settings and effects."""

from __future__ import annotations

import math
from typing import Any

import torch

from .. import _C
from ..checks import check_tensors, one_number, whole_number
from ..filters import apply_3d_filter
from ..footprints import check_device
from ..ops import Op
from ..sh import used_sh_degree
from .autocast import widened
from .effects import MAX_SH_DEGREE, Effects
from .order import key_of
from .seam import has_seam
from .settings import GaussianRasterizationSettings, check_settings

_NOTHING = Effects()
_prepare_lens = Op("prepare_lens")
_MAY_BE_TENSORS = ("tanfovx", "tanfovy", "aperture", "focus", "shift", "turn", "screen", "distortion")


def gaussian_arguments(
    settings: GaussianRasterizationSettings, means3D: torch.Tensor, opacities: torch.Tensor, **optional: Any
) -> dict[str, Any]:
    """The Gaussians by the names of the ops, with the 3D filter of the effects.

    Args:
        settings: Whose effects may hold a 3D filter.
        means3D, opacities: Tensors.
        **optional: Inputs that may be missing: None, or as 3DGS passes them an empty tensor on whatever device.

    Raises:
        TypeError: Something is no tensor, or `settings` is something else.
        ValueError: A tensor is on another device than means3D, or the filter has no scales to widen.
        RuntimeError: CUDA tensors, and an extension without CUDA.
    """
    check_settings(settings)
    check_tensors(None, means3D=means3D)
    device = means3D.device
    check_device(device)
    for name, tensor in optional.items():
        if isinstance(tensor, torch.Tensor) and tensor.dim() == 1 and tensor.numel() == 0:
            optional[name] = None
    check_tensors(device, opacities=opacities, **{name: t for name, t in optional.items() if t is not None})
    effects = settings.effects
    if isinstance(effects, Effects) and effects.filter_3d is not None:
        if optional["scales"] is None:
            given = "neither" if optional["cov3D_precomp"] is None else "cov3D_precomp"
            raise ValueError(f"filter_3d needs scales and rotations, got {given}")
        # The scale modifier does not widen the filter: it is a property of the training pictures.
        filter_3d = effects.filter_3d / one_number("scale_modifier", settings.scale_modifier)
        optional["scales"], opacities = apply_3d_filter(optional["scales"], opacities, filter_3d)
    return {"means3D": means3D, "opacities": opacities, **optional}


def camera_arguments(
    settings: GaussianRasterizationSettings,
    means3D: torch.Tensor,
    shs: torch.Tensor | None,
    full: bool = False,
    with_seam: bool = False,
) -> dict[str, Any]:
    """The camera, the degree of the harmonics and the footprint by the names of the ops.

    A plain camera, which is all that 3DGS has, comes without a `lens`; `full` asks for one all the same. A matrix, a
    camera centre or a tangent that requires a gradient makes a full camera too, for only that has one. `with_seam`:
    the caller shows what lies across the seam of an equirectangular picture at both borders (seam.py); others refuse
    this lens.

    Raises:
        TypeError, ValueError: A matrix is no tensor or on another device; the size or the degree is no whole number; a
            tangent or the scale modifier is no number; the scale modifier requires a gradient; an equirectangular lens.
    """
    s, effects = settings, settings.effects
    if has_seam(s) and not with_seam:
        raise ValueError(
            "lens must not be equirectangular here, got one: GaussianRasterizer and project, list_tiles, blend have it"
        )
    if isinstance(s.scale_modifier, torch.Tensor) and s.scale_modifier.requires_grad and torch.is_grad_enabled():
        raise ValueError(
            "scale_modifier must not require a gradient, it gets none: multiply the scales by it, or pass "
            "scale_modifier.detach()"
        )
    view, proj, campos = s.viewmatrix, s.projmatrix, s.campos
    check_tensors(means3D.device, viewmatrix=view, projmatrix=proj, campos=campos)
    footprint = s.footprint_in_use()
    degree, lens, tanfovx, tanfovy = whole_number("sh_degree", s.sh_degree), None, s.tanfovx, s.tanfovy
    if effects is not None:
        degree = used_sh_degree(effects, degree, shs)
    effects = effects if isinstance(effects, Effects) else _NOTHING
    wanted = view.requires_grad or proj.requires_grad or campos.requires_grad
    wanted = wanted or any(isinstance(t, torch.Tensor) and t.requires_grad for t in (tanfovx, tanfovy))
    if wanted and torch.is_grad_enabled():
        effects = effects.with_camera_gradients()
    if full or degree >= MAX_SH_DEGREE or (effects is not _NOTHING and effects.changes_camera):
        lens = lens_argument(effects, s, means3D)
        tanfovx = tanfovy = 1.0  # the lens has them
    return {
        "viewmatrix": view,
        "projmatrix": proj,
        "campos": campos,
        "lens": lens,
        "image_height": whole_number("image_height", s.image_height),
        "image_width": whole_number("image_width", s.image_width),
        "tanfovx": one_number("tanfovx", tanfovx),
        "tanfovy": one_number("tanfovy", tanfovy),
        "scale_modifier": one_number("scale_modifier", s.scale_modifier),
        "sh_degree": degree,
        "footprint": key_of(footprint, effects.order),
        "option": footprint.option,
    }


def lens_argument(effects: Effects, settings: GaussianRasterizationSettings, like: torch.Tensor) -> torch.Tensor:
    """The argument `lens` of the ops: the members of `Lens` in csrc/core/lens.h, zero where nothing sets them.

    Args:
        effects: What the projection has beyond a pinhole.
        like: A tensor whose dtype and device the result takes.
    """
    tensors, numbers, members = {}, [], effects.lens_members()
    like, tangents = widened(like), {"tanfovx": settings.tanfovx, "tanfovy": settings.tanfovy}
    for name, tangent in tangents.items():
        _check_tangent(name, tangent)
        if isinstance(tangent, torch.Tensor):
            tensors[name], tangents[name] = tangent.to(like), 1.0
    members["tan_half_fov"] = [*map(float, tangents.values())]
    for name, size in _C.LENS:
        member = members.get(name)
        if isinstance(member, torch.Tensor):
            tensors[name], member = member.to(like), None
        numbers += [0.0] * size if member is None else member if isinstance(member, list) else [member]
    view, proj = settings.viewmatrix, settings.projmatrix
    if not effects.camera_gradients:
        view, proj = view.detach(), proj.detach()
    (lens,) = _prepare_lens(
        viewmatrix=widened(view),
        projmatrix=widened(proj),
        **{name: tensors.get(name) for name in _MAY_BE_TENSORS},
        numbers=numbers,
        height=whole_number("image_height", settings.image_height),
        centered=effects.off_center,
    )
    return lens


def _check_tangent(name: str, tangent: float | torch.Tensor) -> None:
    """Raises for what is no tangent of half a field of view. The value of a tensor is examined on the CPU only."""
    if isinstance(tangent, torch.Tensor):
        if tangent.numel() != 1:
            raise TypeError(f"{name} must be a number, got {tangent!r}")
        if tangent.device.type != "cpu" or torch.compiler.is_compiling():
            return
        tangent = tangent.detach()
    number = one_number(name, tangent)
    if not 0 < number < math.inf:
        raise ValueError(f"{name} must be positive and finite, got {number}")
