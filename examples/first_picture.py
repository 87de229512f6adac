"""The smallest program: three Gaussians, one camera, one picture, one gradient step. Runs on the CPU in a second.

Writes first_picture.png to the current folder.
"""

import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io

means = torch.tensor([[0.0, 0.0, 4.0], [0.6, 0.2, 5.0], [-0.5, -0.3, 6.0]], requires_grad=True)
scene = {
    "opacities": torch.tensor([0.9, 0.7, 0.8]),
    "colors_precomp": torch.eye(3),  # red, green, blue
    "scales": torch.full((3, 3), 0.3),
    "rotations": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1),
}
settings = ar.camera_settings(torch.eye(4), width=320, height=240, fx=300.0, fy=300.0, footprint="moment", samples=4)
color, radii = ar.GaussianRasterizer(settings)(means3D=means, means2D=None, **scene)
color.sum().backward()

assert color.shape == (3, 240, 320) and color.isfinite().all() and means.grad.isfinite().all()
print(f"analytic_rasterizer {ar.__version__}: {ar.instruction_set()}, CUDA {'yes' if ar._C.has_cuda else 'no'}")
print(f"the picture spans [{color.min():.3f}, {color.max():.3f}], the radii are {radii.tolist()} px")

io.save_image("first_picture.png", color)
print("see first_picture.png")
