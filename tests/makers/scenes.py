"""Small deterministic scenes and cameras, and the list of footprints under test."""

import math
from dataclasses import dataclass, replace

import torch

from analytic_rasterizer import FOOTPRINTS
from analytic_rasterizer.footprints import REFERENCE_FOOTPRINTS

# Option values that change the code path. A footprint that is not listed is tested with its default.
OPTIONS = {
    "point": [{}, {"dilation": 0.0}],
    "mip": [{}, {"variance": 0.25}],
    "analytic": [{"frame_gradient": "frozen"}, {"frame_gradient": "paper"}],
    "box": [{"samples": samples} for samples in (1, 4, 16)],
    "moment": [{"samples": samples} for samples in (1, 4, 16)],
}
# Every registered footprint with these: a new one is tested without a change here.
VARIANTS = [(footprint, options) for footprint in FOOTPRINTS for options in OPTIONS.get(footprint, [{}])]
# For tests of whole images: every footprint that is meant for rendering, with every option that changes the code path.
# The weights of reference footprints are tested as everybody's; they render on one slow path.
RENDERED = [variant for variant in VARIANTS if variant[0] not in REFERENCE_FOOTPRINTS]
# One of each footprint, for tests where the options do not matter.
KINDS = [
    (footprint, {"samples": 4} if footprint in ("box", "moment") else {})
    for footprint in FOOTPRINTS
    if footprint not in REFERENCE_FOOTPRINTS
]
# One of each path through the rasterizer, for tests where the formula of the weight does not matter: one sample per
# pixel with a conic and with eigenvectors, several samples, samples that move.
PATHS = [("cumulant", {}), ("analytic", {}), ("box", {"samples": 4}), ("moment", {"samples": 4})]


def name_of(variant):
    """Test id of a (footprint, options) pair."""
    footprint, options = variant
    return "-".join([footprint, *[str(value) for value in options.values()]])


@dataclass(frozen=True)
class Camera:
    """The twelve 3DGS settings in float64, with the principal point shifted by `shift` pixels."""

    image_height: int = 37
    image_width: int = 45
    tanfovx: float = 0.6
    tanfovy: float = 0.5
    bg: tuple = (0.0, 0.0, 0.0)
    scale_modifier: float = 1.0
    sh_degree: int = 0
    shift: tuple = (0.0, 0.0)
    eye: tuple = (0.3, -0.2, -4.0)
    target: tuple = (0.0, 0.0, 0.0)

    def world_to_camera(self):
        """w2c (4, 4): camera looks along +z (OpenCV axes)."""
        eye = torch.tensor(self.eye, dtype=torch.float64)
        forward = torch.nn.functional.normalize(torch.tensor(self.target, dtype=torch.float64) - eye, dim=0)
        # Tilted, so that no axis of the camera is an axis of the world.
        up = torch.tensor([0.2, -1.0, 0.1], dtype=torch.float64)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
        return matrix

    def perspective(self, near=0.01, far=100.0):
        """3DGS projection (4, 4) for column vectors, principal point moved by `shift` px."""
        matrix = torch.zeros(4, 4, dtype=torch.float64)
        matrix[0, 0], matrix[1, 1] = 1 / self.tanfovx, 1 / self.tanfovy
        matrix[0, 2] = 2 * self.shift[0] / self.image_width
        matrix[1, 2] = 2 * self.shift[1] / self.image_height
        matrix[2, 2], matrix[2, 3] = far / (far - near), -far * near / (far - near)
        matrix[3, 2] = 1.0
        return matrix

    def fields(self, dtype=torch.float64, device="cpu"):
        """The twelve settings as a dict, matrices in row-vector form."""
        view = self.world_to_camera()
        fields = {
            "image_height": self.image_height,
            "image_width": self.image_width,
            "tanfovx": self.tanfovx,
            "tanfovy": self.tanfovy,
            "bg": torch.tensor(self.bg, dtype=dtype),
            "scale_modifier": self.scale_modifier,
            "viewmatrix": view.T.contiguous().to(dtype),
            "projmatrix": (self.perspective() @ view).T.contiguous().to(dtype),
            "sh_degree": self.sh_degree,
            "campos": torch.tensor(self.eye, dtype=dtype),
            "prefiltered": False,
            "debug": False,
        }
        return to(fields, device)

    def settings(self, dtype=torch.float64, device="cpu", variant=None, **more):
        """ar.GaussianRasterizationSettings of this camera, of a (footprint, options) pair or of what `more` says."""
        import analytic_rasterizer as ar

        if variant is not None:
            more |= {"footprint": variant[0], **variant[1]}
        return ar.GaussianRasterizationSettings(**self.fields(dtype, device), **more)

    def render(self, scene, variant=None, **more):
        """What the rasterizer returns of a scene in this camera, on its device and in its dtype."""
        import analytic_rasterizer as ar

        means = scene["means3D"]
        return ar.GaussianRasterizer(self.settings(means.dtype, means.device, variant, **more))(**scene)

    def shifted(self, x, y):
        """The same camera with every splat moved by (x, y) px in the image."""
        return replace(self, shift=(self.shift[0] + x, self.shift[1] + y))

    def facing_z(self):
        """The same intrinsics at the origin, looking along +z with x right and y down."""
        return AxisCamera(**{name: getattr(self, name) for name in self.__dataclass_fields__})


class AxisCamera(Camera):
    """A camera at the origin whose axes are the world's."""

    def world_to_camera(self):
        return torch.eye(4, dtype=torch.float64)

    def fields(self, dtype=torch.float64, device="cpu"):
        return super().fields(dtype, device) | {"campos": torch.zeros(3, dtype=dtype, device=device)}


class ParallelCamera(Camera):
    """Orthographic: tanfovx and tanfovy are half the width and height of the picture in world units."""

    def perspective(self, near=0.01, far=100.0):
        matrix = torch.diag(torch.tensor([1 / self.tanfovx, 1 / self.tanfovy, 1 / far, 1], dtype=torch.float64))
        matrix[0, 3], matrix[1, 3] = 2 * self.shift[0] / self.image_width, 2 * self.shift[1] / self.image_height
        return matrix


def rand(generator, *shape, low=0.0, high=1.0):
    """Uniform float64 numbers."""
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def random_scene(seed, count=40, degree=0, opacity=(0.05, 0.98), sigma=(0.01, 0.5), spread=1.5):
    """Gaussians around the origin, as keyword inputs (SH and scales/rotations).

    Scales are log-uniform in `sigma` [world units]; at the default camera one unit is about 10 px.
    Quaternions are not normalised.
    """
    g = torch.Generator().manual_seed(seed)
    low, high = math.log(sigma[0]), math.log(sigma[1])
    return {
        "means3D": rand(g, count, 3, low=-spread, high=spread),
        "means2D": torch.zeros(count, 3, dtype=torch.float64),
        "opacities": rand(g, count, 1, low=opacity[0], high=opacity[1]),
        "shs": rand(g, count, (degree + 1) ** 2, 3, low=-0.7, high=0.9),
        "scales": torch.exp(rand(g, count, 3, low=low, high=high)),
        "rotations": rand(g, count, 4, low=-1.0, high=1.0) * 1.7,
    }


def smooth_scene(seed, count=6, degree=0):
    """Large faint splats that cover the whole image: every alpha stays inside (1/255, 0.99).

    Finite differences are valid here; tests assert the margin through the reference.
    """
    scene = random_scene(seed, count, degree, opacity=(0.15, 0.6), sigma=(1.2, 2.5), spread=0.7)
    return scene


def with_precomputed(scene, seed=0, scale_modifier=1.0):
    """The same Gaussians with colors_precomp and cov3D_precomp in place of shs and scales."""
    import reference

    g = torch.Generator().manual_seed(seed)
    out = {k: v for k, v in scene.items() if k not in ("shs", "scales", "rotations")}
    full = reference.covariance_3d(scene["scales"], scene["rotations"], scale_modifier)
    rows, columns = torch.triu_indices(3, 3)
    out["cov3D_precomp"] = full[:, rows, columns].contiguous()
    out["colors_precomp"] = rand(g, len(full), 3)
    return out


def probe(image, seed=2, low=-1.0):
    """Fixed weights of an image's numbers, which make a loss of it: a wrong pixel shows in its gradients."""
    return rand(torch.Generator().manual_seed(seed), *image.shape, low=low).to(image)


def without(scene, *names):
    """The scene but for some of its inputs, such as the means2D that stages do not take."""
    return {name: value for name, value in scene.items() if name not in names}


def splat_scene(camera, means2d, cov2d, opacities, depths, colors=None):
    """Gaussians that project to exactly these splats under an AxisCamera.

    Their covariance has no extent along z, so the projection Jacobian's third column multiplies
    zero and cov2d = (focal / z)^2 * cov3d_xy wherever the splat is. means2d (P, 2) px, cov2d (P, 3)
    or (3,) px^2, opacities and depths (P,), as tensors or lists.
    """
    means2d, cov2d, opacities, depths = (
        torch.as_tensor(value, dtype=torch.float64) for value in (means2d, cov2d, opacities, depths)
    )
    cov2d = cov2d.expand(len(means2d), 3)
    size = torch.tensor([camera.image_width, camera.image_height], dtype=torch.float64)
    tangent = torch.tensor([camera.tanfovx, camera.tanfovy], dtype=torch.float64)
    focal = size / (2 * tangent)
    slope = ((2 * means2d + 1 - 2 * torch.tensor(camera.shift, dtype=torch.float64)) / size - 1) * tangent
    scale = depths[:, None] / focal
    count = len(means2d)
    cov3d = torch.zeros(count, 6, dtype=torch.float64)
    cov3d[:, 0] = cov2d[:, 0] * scale[:, 0] ** 2
    cov3d[:, 1] = cov2d[:, 1] * scale[:, 0] * scale[:, 1]
    cov3d[:, 3] = cov2d[:, 2] * scale[:, 1] ** 2
    return {
        "means3D": torch.cat([slope * depths[:, None], depths[:, None]], -1),
        "means2D": torch.zeros(count, 3, dtype=torch.float64),
        "opacities": opacities.reshape(-1, 1),
        "colors_precomp": torch.ones(count, 3, dtype=torch.float64) if colors is None else colors,
        "cov3D_precomp": cov3d,
    }


def balls(means, scale, opacity=1.0, colors=None):
    """Gaussians (P, 3) of one size in float64, white where there are no colours (P, 3)."""
    ones = torch.ones(len(means), 3, dtype=torch.float64)
    return {
        "means3D": means,
        "scales": scale * ones,
        "rotations": torch.tensor([[1.0, 0, 0, 0]] * len(means), dtype=torch.float64),
        "opacities": opacity * ones[:, :1],
        "colors_precomp": ones if colors is None else colors,
    }


def random_cov2d(generator, count, sigma, ratio=(1.0, 100.0)):
    """Covariances (count, 3) [px^2]: smaller deviation and anisotropy log-uniform, any rotation."""
    small = torch.exp(rand(generator, count, low=math.log(sigma[0]), high=math.log(sigma[1])))
    large = small * torch.exp(rand(generator, count, low=math.log(ratio[0]), high=math.log(ratio[1])))
    return covariance_2d(large, small, rand(generator, count, high=math.pi))


def covariance_2d(s1, s2, angle):
    """(..., 3) with deviation s1 along (cos, sin) of angle and s2 across."""
    c, s = torch.cos(angle), torch.sin(angle)
    a, b = s1**2, s2**2
    return torch.stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c], -1)


def random_offsets(generator, cov2d, reach=3.0):
    """Offsets (count, 2) [px] uniform in the `reach`-sigma ellipse of Sigma + I/12."""
    count = len(cov2d)
    radius = reach * torch.sqrt(rand(generator, count))
    angle = rand(generator, count, high=2 * math.pi)
    xx, xy, yy = (cov2d + torch.tensor([1 / 12, 0, 1 / 12])).unbind(-1)
    l11 = torch.sqrt(xx)
    l21 = xy / l11
    l22 = torch.sqrt(yy - l21**2)
    p, q = radius * torch.cos(angle), radius * torch.sin(angle)
    return torch.stack([l11 * p, l21 * p + l22 * q], -1)


def cast(scene, dtype, device="cpu"):
    """The scene in another dtype, on another device."""
    return to({name: value.to(dtype) for name, value in scene.items()}, device)


def to(named, device):
    """A dict of inputs or settings with its tensors on another device."""
    return {name: value.to(device) if torch.is_tensor(value) else value for name, value in named.items()}


def settings_to(settings, device):
    """ar.GaussianRasterizationSettings with their tensors on another device."""
    return settings._replace(**to(settings._asdict(), device))


def of_view(view, variant, size=None, dtype=torch.float64):
    """Settings of a stored view with harmonics of degree 3, in px of its own or of another (width, height)."""
    width, height = size or (view["width"], view["height"])
    tangents = {
        f"tanfov{axis}": view[side] / (2 * view[f"f{axis}"]) for axis, side in (("x", "width"), ("y", "height"))
    }
    camera = Camera(image_width=width, image_height=height, sh_degree=3, **tangents)
    w2c = torch.tensor(view["w2c"], dtype=torch.float64).reshape(4, 4)
    matrices = {"viewmatrix": w2c.T, "projmatrix": (camera.perspective() @ w2c).T}
    matrices["campos"] = torch.linalg.inv(w2c)[:3, 3]
    exact = {name: value.to(dtype).contiguous() for name, value in matrices.items()}
    return camera.settings(dtype, "cpu", variant)._replace(**exact)


def leaves(scene):
    """Detached copies that require gradients."""
    return {name: value.detach().clone().requires_grad_() for name, value in scene.items()}
