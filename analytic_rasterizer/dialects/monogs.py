"""MonoGS: (color, radii, depth, opacity, n_touched), with gradients to a small motion of the camera.

Repositories: muskie82/MonoGS, NoPoSplat. Depth is blended like a colour on zero, opacity is alpha.
`n_touched` counts the pixels in which a Gaussian is seen and more than half of the light is left behind it.
"""

from __future__ import annotations

import torch

from ..cameras.rotations import product
from ..checks import check_tensors
from ..footprints import DILATED
from ..render.autocast import widened
from ..render.effects import Effects
from ._base import FIELDS, forward_like
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._further import adds, function_that_adds

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class _Moved(torch.autograd.Function):
    """The camera as it is, with the gradient of exp(tangent) @ world_to_camera at tangent = 0; see `ar.moved`.

    rho moves along the camera's axes, theta turns around them: V = exp((rho, theta)) V_0. The derivative of V with
    respect to a coordinate is G V, G its generator, so its gradient is the inner product of G with dL_dV V^T. The
    camera's centre moves by -R^T rho. Matrices are stored transposed.
    """

    @staticmethod
    def forward(ctx, theta, rho, view, proj, campos, proj_raw):
        ctx.save_for_backward(view, proj_raw)
        ctx.shapes = theta.shape, rho.shape
        return view.view_as(view), proj.view_as(proj), campos.view_as(campos)

    @staticmethod
    def backward(ctx, dL_dview, dL_dproj, dL_dcampos):
        view, proj_raw = (matrix.reshape(4, 4) for matrix in ctx.saved_tensors)
        through_view = dL_dview.reshape(4, 4) + product(dL_dproj.reshape(4, 4), proj_raw.T)
        m = product(through_view.T, view)  # dL_dV V^T
        dL_drho = m[:3, 3] - product(dL_dcampos.reshape(1, 3), view[:3, :3])[0]
        dL_dtheta = torch.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
        theta_shape, rho_shape = ctx.shapes
        return dL_dtheta.reshape(theta_shape), dL_drho.reshape(rho_shape), dL_dview, dL_dproj, dL_dcampos, None


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, with `projmatrix_raw` (4, 4), camera to clip space, transposed, after projmatrix."""

    dialect = "monogs"
    repositories = ("MonoGS", "NoPoSplat")
    fields = (*FIELDS[:8], "projmatrix_raw", *FIELDS[8:])
    inferred_from = ("projmatrix_raw",)
    filter = DILATED
    outputs = Effects(depth=True, alpha=True, gaussian_stats=True)

    @adds(theta="cov3D_precomp", rho="theta")
    def render(self, theta=None, rho=None, **gaussians) -> tuple:
        """As 3DGS 2023, with the camera's motion.

        Args:
            theta: Three numbers of any shape, the turn around the camera's axes, rad. The value is taken to be zero.
            rho: Likewise the way along them, world units.
        """
        settings = self
        if theta is not None or rho is not None:
            settings = self._moved(theta, rho)
        return super(GaussianRasterizationSettings, settings).render(**gaussians)

    def _moved(self, theta: torch.Tensor | None, rho: torch.Tensor | None) -> GaussianRasterizationSettings:
        """These settings with gradients to theta and rho.

        Raises:
            TypeError: One of them is no tensor.
            ValueError: One of them does not hold three numbers.
        """
        zero = self.campos.new_zeros(3)
        theta, rho = (zero if t is None else t for t in (theta, rho))
        for name, tensor in (("theta", theta), ("rho", rho)):
            check_tensors(None, **{name: tensor})
            if tensor.numel() != 3:
                raise ValueError(f"{name} must hold 3 numbers, got shape {tuple(tensor.shape)}")
        camera = map(widened, (self.viewmatrix, self.projmatrix, self.campos, self.projmatrix_raw))
        view, proj, campos = _Moved.apply(theta, rho, *camera)
        return self._replace(viewmatrix=view, projmatrix=proj, campos=campos)

    def returned(self, color, radii, outputs):
        return color, radii, outputs.depth, outputs.alpha, outputs.gaussian_stats.pixels_in_front


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians; `forward` takes `theta` and `rho`."""

    forward = forward_like(GaussianRasterizationSettings.render)


rasterize_gaussians = function_that_adds(__name__, theta="cov3Ds_precomp", rho="theta")
