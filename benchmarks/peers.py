"""Other rasterizers that are installed, as cases to time beside ours: `speed.py --against` and `table.py --against`.

A peer is named by what follows --against, separated by commas:

    gsplat, gsplat_antialiased   gsplat's `rasterization`, in either of its modes, not packed, as its trainer calls it
    module:NAME[=FOOTPRINT]      a module with the interface of 3DGS's diff_gaussian_rasterization; FOOTPRINT is ours
                                 that computes the same, point if it is left out
    NAME                         short for module:NAME

Most rasterizers of the second kind are called diff_gaussian_rasterization, which is also a name of this package, and
only one of them can be installed under it. Install the other one under a name of its own: in its sources rename the
folder diff_gaussian_rasterization, and the name where setup.py lists packages and extension.

Every peer's picture is compared with ours of the same footprint, so that a peer that renders something else is noticed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from types import ModuleType

import torch

from analytic_rasterizer import _C, io
from analytic_rasterizer.analysis.timing import Case
from analytic_rasterizer.gaussians import Gaussians

FURTHER = {"antialiasing": False, "kernel_size": 0.1}
"""Settings that forks of 3DGS 2023 have besides, and what they get; `subpixel_offset` is zero."""


class GsplatCase(Case):
    """A view as gsplat renders it. Raises ImportError without gsplat."""

    needs_cuda = True
    like, mode = "point", "classic"

    def __init__(self, scene: Gaussians, view: io.View):
        super().__init__(scene, view, self.like)
        self.rasterization = importlib.import_module("gsplat").rasterization
        del self.inputs["means2D"]  # its function has no such argument
        cx, cy = view.middle
        intrinsics = [[view.fx, 0.0, cx], [0.0, view.fy, cy], [0.0, 0.0, 1.0]]
        self.fixed = {
            "viewmats": view.w2c.to(scene.means)[None],
            "Ks": torch.tensor(intrinsics).to(scene.means)[None],
            "width": view.width,
            "height": view.height,
            "sh_degree": scene.sh_degree,
            "near_plane": _C.NEAR,
            "rasterize_mode": self.mode,
            "packed": False,
        }

    def image(self, means3D, opacities, shs, scales, rotations, means2D=None) -> torch.Tensor:
        images, *_ = self.rasterization(means3D, rotations, scales, opacities[:, 0], shs, **self.fixed)
        return images[0].permute(2, 0, 1)


class GsplatAntialiasedCase(GsplatCase):
    like, mode = "mip:variance=0.3", "antialiased"


class ModuleCase(Case):
    """A view as a module with the interface of 3DGS renders it."""

    needs_cuda = True

    def __init__(self, scene: Gaussians, view: io.View, module: ModuleType, like: str):
        super().__init__(scene, view, like)
        self.like = like
        offsets = torch.zeros(view.height, view.width, 2, device=scene.means.device)
        known = {**self.settings._asdict(), **FURTHER, "subpixel_offset": offsets}
        wanted = module.GaussianRasterizationSettings._fields
        if unknown := set(wanted) - set(known):
            raise ValueError(f"{module.__name__} has settings that are not known here: {', '.join(sorted(unknown))}")
        settings = module.GaussianRasterizationSettings(**{name: known[name] for name in wanted})
        self.rasterizer = module.GaussianRasterizer(settings)

    def image(self, means2D=None, **gaussians) -> torch.Tensor:
        if means2D is None:
            means2D = torch.zeros_like(gaussians["means3D"])
        return self.rasterizer(means2D=means2D, **gaussians)[0]


PEERS = {"gsplat": GsplatCase, "gsplat_antialiased": GsplatAntialiasedCase}

Peer = Callable[[Gaussians, io.View], Case]


def find_peers(names: list[str], device: str) -> dict[str, Peer]:
    """Those of the peers that are installed and run on the device; prints which are left out, and why.

    Ends the program for a module that is no peer.
    """
    found = {}
    for name in names:
        try:
            peer = _find(name)
        except ImportError as error:
            print(f"{name}: left out, for it is not installed ({error})")
            continue
        if device == "cpu" and (peer.func if isinstance(peer, partial) else peer).needs_cuda:
            print(f"{name}: left out, for it needs CUDA")
            continue
        found[name] = peer
    return found


def _find(name: str) -> Peer:
    if name in PEERS:
        importlib.import_module("gsplat")
        return PEERS[name]
    module_name, _, like = name.removeprefix("module:").partition("=")
    module = importlib.import_module(module_name)
    rasterizer = getattr(module, "GaussianRasterizer", None)
    if rasterizer is None:
        raise SystemExit(f"--against {name}: {module_name} has no GaussianRasterizer, so it is no peer (see peers.py)")
    if rasterizer.__module__.startswith("analytic_rasterizer"):
        raise SystemExit(f"--against {name}: this is this package; install the peer under another name (see peers.py)")
    return partial(ModuleCase, module=module, like=like or "point")


def mean_difference(case: Case, scene: Gaussians, view: io.View) -> float:
    """Of a peer's picture from ours with the footprint it stands for: mean of |difference|, colours from 0 to 1."""
    return (case.forward() - Case(scene, view, case.like).forward()).abs().mean().item()
