"""Other algorithms that use the name diff_gaussian_rasterization: what gives them away, and what they would need."""

from __future__ import annotations

from collections.abc import Iterable

_GOF = "Gaussian Opacity Fields intersects rays with Gaussians in 3D"
_RADE = "RaDe-GS renders depth and normals of the plane in which a ray meets a Gaussian"
_SURFELS = "2DGS and its relatives render flat discs that are intersected with rays"
_STOP = "StopThePop sorts the Gaussians of every pixel anew"
_TAMING = "Taming 3DGS scores Gaussians by a loss of every pixel inside the rasterizer"
_SPEEDY = "Speedy-Splat scores Gaussians for pruning by second derivatives inside the rasterizer"
_ROTOR = "4D Gaussian Splatting with rotors slices Gaussians of space and time inside the rasterizer"

_ALGORITHMS = {
    "view2gaussian_precomp": _GOF,
    "integrate": _GOF,
    "require_coord": _RADE,
    "require_depth": _RADE,
    "transMat_precomp": _SURFELS,
    "render_geo": _SURFELS,
    "all_map": _SURFELS,
    "sort_settings": _STOP,
    "inv_viewprojmatrix": _STOP,
    "settings": _STOP,
    "ExtendedSettings": _STOP,
    "SortMode": _STOP,
    "GlobalSortOrder": _STOP,
    "pixel_weights": _TAMING,
    "scores": _SPEEDY,
    "timestamp": _ROTOR,
    "time_duration": _ROTOR,
    "rot_4d": _ROTOR,
}
"""What is only theirs: keywords of settings and of forward, methods of the rasterizer, names of the module."""


def refusal(name: str) -> str | None:
    """One sentence for a name that belongs to another algorithm; None for all other names."""
    algorithm = _ALGORITHMS.get(name)
    if algorithm is None:
        return None
    return f"{name} is not supported: {algorithm}, so it needs its own rasterizer in place of analytic_rasterizer"


def refuse(names: Iterable[str]) -> None:
    """Raises TypeError if one of the keywords belongs to another algorithm."""
    for name in names:
        if name in _ALGORITHMS:
            raise TypeError(refusal(name))
