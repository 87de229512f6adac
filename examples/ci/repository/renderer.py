"""The renderer of a repository that was written for CUDA and the rasterizer of 3DGS."""

import math

import torch

from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer


class Camera:
    """Looks along +z from (0, 0, -4), with a field of view of 45 degrees."""

    def __init__(self, width, height):
        self.width, self.height = width, height
        self.tan_y = math.tan(math.pi / 8)
        self.tan_x = self.tan_y * width / height
        near, far = 0.01, 100.0
        view = torch.eye(4)
        view[2, 3] = 4.0
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[1, 1] = 1 / self.tan_x, 1 / self.tan_y
        projection[2, 2], projection[2, 3] = far / (far - near), -far * near / (far - near)
        projection[3, 2] = 1.0
        self.view = view.T.contiguous().cuda()
        self.full = (projection @ view).T.contiguous().cuda()
        self.center = torch.tensor([0.0, 0.0, -4.0], device="cuda")


def render(camera, model, background):
    """The image (3, H, W), radii (P,), and the points whose gradient density control reads."""
    screen_points = torch.zeros_like(model.means, requires_grad=True, device="cuda")
    settings = GaussianRasterizationSettings(
        image_height=camera.height,
        image_width=camera.width,
        tanfovx=camera.tan_x,
        tanfovy=camera.tan_y,
        bg=background,
        scale_modifier=1.0,
        viewmatrix=camera.view,
        projmatrix=camera.full,
        sh_degree=0,
        campos=camera.center,
        prefiltered=False,
        debug=False,
    )
    image, radii = GaussianRasterizer(settings)(
        means3D=model.means,
        means2D=screen_points,
        opacities=model.opacities.sigmoid(),
        colors_precomp=model.colors.sigmoid(),
        scales=model.scales.exp(),
        rotations=torch.nn.functional.normalize(model.rotations),
    )
    return image, radii, screen_points
