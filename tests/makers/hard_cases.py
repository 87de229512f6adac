"""The hard cases as data, and how large an error each of them may have.

A case is a scene that breaks textbook formulas, or a camera that does. docs/internals/testing.md has a row for
each; tests/kernels/test_stability.py renders each with every footprint; benchmarks/stability.py measures.

Tolerances. The rasterizer promises to be as good as its inputs are exact: what it computes in a
precision of unit roundoff eps is what exact arithmetic gives for inputs, and per-pixel terms, that are off
by a few eps. So the tolerance of every output is

    OPERATIONS * (S + eps A),

S the largest change of that output, in float64, when each input is perturbed by eps of its size
(`perturbed`) and each pixel's gradient by eps of itself, A its largest entry: S / eps is the condition
number of that output. OPERATIONS = 100 counts the roundings on the longest path from an input to a
gradient: about 40 in the projection, 20 in the weight, 5 in the compositing, 35 on the way back; each acts like
one more perturbation of that kind. Gradients are measured Gaussian by Gaussian, relative to the largest entry
of that Gaussian alone, so that no large gradient hides a small one. Deep stacks add three roundings per
layer (`Case.layers`).

Two limits are wider, because the formula is:

  - `analytic` takes exp(-f(t)) - exp(f(t)) of the position t = d/sigma in a splat, which is known to eps. In splats
    wider than the image its gradients are good to 8 eps sigma / (width of the image).
  - `analytic` with the paper's gradient divides by the difference of the eigenvalues. Where a case has round splats
    (`Case.round`) its gradients by shape and position are unbounded: finite is all that is asked.

A mean's gradient along the line of sight is what the splat's shift and its growth add up to, which cancel far
outside the image: A is the larger of those (`shift_terms`).

Where a comparison with a threshold (alpha >= 1/255, alpha <= 0.99, T >= 1e-4) may fall differently in two
precisions, the image has a step and no derivative. Such pixels are found with opacities moved by
`Case.margin` either way: where the second difference of the image exceeds what is smooth, the pixel is left out
of the gradients and may differ in the image by one flipped contribution.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from scenes import AxisCamera, Camera, ParallelCamera, rand

from analytic_rasterizer import Defocus, Effects, Motion

OPERATIONS = 100
PERTURBATIONS = 3
EPS = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}

# 40 px at the depth 1, in both directions.
CAMERA = AxisCamera(image_width=40, image_height=24, tanfovx=0.5, tanfovy=0.3, bg=(0.2, 0.5, 0.9))
FOCAL = 40.0


@dataclass(frozen=True)
class Case:
    """One row of docs/internals/testing.md."""

    name: str
    title: str
    build: Callable[[], tuple]  # -> (camera, scene in float64)
    layers: int = 0  # splats of a stack: roundings that add up
    round: bool = False  # has splats of equal eigenvalues
    margin: float = 1e-3  # relative distance from a threshold within which rounding may decide
    reference: bool = False  # also against tests/makers/reference.py, in float64
    effects: Effects | None = None  # of a full camera, by all of which there are gradients too


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def splats(means, sigmas, angles=0.0, opacity=0.7, depths=2.0, camera=CAMERA, degree=0):
    """Gaussians that project about to these splats: means [px], sigmas (n, 2) [px] along the axes at `angles`.

    The third deviation is the smaller of the two, along the line of sight of the image's centre.
    """
    means, sigmas = (torch.as_tensor(v, dtype=torch.float64).reshape(-1, 2) for v in (means, sigmas))
    n = max(len(means), len(sigmas))
    means, sigmas = means.expand(n, 2), sigmas.expand(n, 2)
    angles, opacity, depths = (
        torch.as_tensor(v, dtype=torch.float64).reshape(-1).expand(n) for v in (angles, opacity, depths)
    )
    size = tensor(camera.image_width, camera.image_height)
    focal = size / (2 * tensor(camera.tanfovx, camera.tanfovy))
    slope = (means - (size - 1) / 2) / focal
    scale = depths[:, None] / focal[0]
    zero = torch.zeros(n, dtype=torch.float64)
    g = torch.Generator().manual_seed(3)
    shs = rand(g, n, (degree + 1) ** 2, 3, low=-0.7, high=0.9)
    return {
        "means3D": torch.cat([slope * depths[:, None], depths[:, None]], -1),
        "means2D": torch.zeros(n, 3, dtype=torch.float64),
        "opacities": opacity[:, None].clone(),
        "shs": shs,
        "scales": torch.cat([sigmas, sigmas.amin(-1, keepdim=True)], -1) * scale,
        "rotations": torch.stack([torch.cos(angles / 2), zero, zero, torch.sin(angles / 2)], -1),
    }


def joined(*scenes):
    return {name: torch.cat([s[name] for s in scenes]) for name in scenes[0]}


def flat(scene):
    """The same Gaussians by covariance and colour."""
    import reference

    full = reference.covariance_3d(scene["scales"], scene["rotations"], 1.0)
    rows, columns = torch.triu_indices(3, 3)
    g = torch.Generator().manual_seed(4)
    return {
        **{k: scene[k] for k in ("means3D", "means2D", "opacities")},
        "colors_precomp": rand(g, len(full), 3),
        "cov3D_precomp": full[:, rows, columns].contiguous(),
    }


SPOTS = [[8.3, 6.1], [20.0, 12.0], [31.7, 16.4], [12.5, 17.5], [27.2, 5.9]]


def axis_aligned():
    return CAMERA, splats(SPOTS, [[3, 1], [1, 3], [0.3, 0.1], [0.1, 0.3], [5, 0.5]], depths=[2, 2.1, 2.2, 2.3, 2.4])


def isotropic():
    return CAMERA, splats(SPOTS, [[0.05] * 2, [0.2] * 2, [1] * 2, [3] * 2, [9] * 2], depths=[2, 2.1, 2.2, 2.3, 2.4])


def nearly_isotropic():
    sigma = tensor(0.2, 0.5, 1, 3, 9)[:, None] * tensor(1, 1 + 1e-7)
    return CAMERA, splats(SPOTS, sigma, [0.3, 1.1, 2.0, 2.9, 0.7], depths=[2, 2.1, 2.2, 2.3, 2.4])


def needles(ratio):
    """Through the image at five angles, longer and shorter than it."""

    def build():
        long = tensor(30, 300, 3, 30, 1000)
        return CAMERA, splats(
            SPOTS, torch.stack([long, long / ratio], -1), [0.0, 0.4, 1.2, math.pi / 2, 2.5], 0.9,
            [2, 2.1, 2.2, 2.3, 2.4],
        )  # fmt: skip

    return build


def needles_by_covariance(ratio):
    def build():
        camera, scene = needles(ratio)()
        return camera, flat(scene)

    return build


def sized(sigma, opacity=0.7):
    """A round and an oblong one near the centre, in front of an ordinary one."""

    def build():
        hard = splats([[19.4, 11.7], [22.3, 12.6]], [[sigma, sigma], [2 * sigma, sigma]], [0.0, 0.6], opacity, [2, 2.2])
        return CAMERA, joined(hard, splats([[21.0, 11.0]], [[4, 3]], 0.4, 0.6, 3.0))

    return build


def filling():
    return CAMERA, splats([[19.5, 11.5], [-30, 50], [90, 5]], [[60, 40], [80, 50], [100, 90]], [0.1, 0.9, 2.0], 0.6,
                          [2, 2.5, 3])  # fmt: skip


def near_plane():
    """At the near plane and just beyond, in front of it, at the camera and behind."""
    scene = splats(SPOTS * 2, [[2, 1.5]] * 10, 0.5, 0.6, [0.2001, 0.21, 0.3, 0.5, 1.0, 0.1999, 0.1, 1e-6, -1e-3, -2.0])
    scene["means3D"][7] = 0.0
    return CAMERA, scene


def frustum_clamp():
    """Beyond 1.3 tan(fov), beside it on both sides, large enough to be seen."""
    limit = 1.3 * tensor(0.5, 0.3)
    slopes = torch.stack([limit * 1.001, limit * 0.999, -limit * 1.3, limit * tensor(1.5, 0.2), limit * tensor(0, -2)])
    means = slopes * FOCAL + tensor(19.5, 11.5)
    return CAMERA, splats(means, [[12, 9], [11, 9], [16, 12], [18, 10], [12, 11]], [0.2, 0.8, 1.4, 0.1, 2.2], 0.8,
                          [2, 2.1, 2.2, 2.3, 2.4])  # fmt: skip


def far_outside():
    """1e2 to 1e7 px outside, some reaching in."""
    means = [[-100, 10], [1e4, 12], [20, -1e5], [1e7, 1e7], [-1e3, -1e3]]
    sigma = [[60, 50], [1e4, 8e3], [1, 1], [1e7, 8e6], [800, 700]]
    return CAMERA, splats(means, sigma, [0.0, 0.3, 0.0, 0.8, 2.3], 0.9, [2, 2.1, 2.2, 2.3, 2.4])


def scales_of(value):
    """All scales, one scale and two scales of this value, and an ordinary Gaussian."""

    def build():
        scene = splats(SPOTS, [[2.0, 1.5]] * 5, 0.5, 0.7, [2, 2.1, 2.2, 2.3, 2.4])
        scene["scales"][0] = value
        scene["scales"][1, 0] = value
        scene["scales"][2, 1:] = value
        scene["scales"][3, 2] = value
        return CAMERA, scene

    return build


def quaternions():
    """From 1e-40 to 1e15 times a unit one, and the zero one."""
    scene = splats(SPOTS * 2, [[3, 1]] * 10, torch.arange(10.0) * 0.3, 0.5, torch.linspace(2, 3, 10))
    length = tensor(1e-40, 1e-23, 1e-10, 1e-3, 0.5, 2, 1e3, 1e10, 1e15, 0)
    scene["rotations"] = (scene["rotations"] + tensor(0.0, 0.3, -0.2, 0.0)) * length[:, None]
    return CAMERA, scene


def opacities(values):
    def build():
        scene = splats(SPOTS[: len(values)], [[3, 2]] * len(values), 0.4, 0.5, torch.linspace(2, 3, len(values)))
        scene["opacities"] = torch.tensor(values, dtype=torch.float64)[:, None]
        return CAMERA, scene

    return build


def capped():
    """Wide and opaque: alpha is at the cap over many pixels, two deep."""
    return CAMERA, splats([[19, 11], [21, 12], [18, 13]], [[30, 20], [25, 30], [20, 20]], 0.3, [0.995, 0.999, 0.6],
                          [2, 2.5, 3])  # fmt: skip


def stack(opacity, layers=10_000):
    """On 3 x 2 pixels, wider than the image, so that all layers are alike in all of them."""

    def build():
        camera = replace(CAMERA, image_width=3, image_height=2, tanfovx=0.5, tanfovy=1 / 3)
        g = torch.Generator().manual_seed(7)
        o = opacity(layers)
        means = tensor(1, 0.5) + rand(g, layers, 2, low=-0.4, high=0.4)
        sigma = rand(g, layers, 2, low=20.0, high=40.0)
        return camera, splats(means, sigma, rand(g, layers, high=3.0), o, torch.linspace(1.0, 3.0, layers), camera)

    return build


def equal_depths():
    return CAMERA, splats([[19, 11], [21, 12], [20, 13], [18, 12]], [[4, 3]] * 4, [0, 1, 2, 3], [0.9, 0.6, 0.8, 0.7],
                          2.0)  # fmt: skip


def tile_borders():
    """Means on tile edges, half pixels and corners of the image; 40 x 24 is 2.5 x 1.5 tiles."""
    means = [[15.5, 15.5], [16, 16], [15, 16], [-0.5, -0.5], [39.5, 23.5], [31.5, 7.5], [32.0, 8.0]]
    return CAMERA, splats(means, [[0.4, 0.4], [0.3, 0.2], [1, 1], [2, 2], [1.5, 0.6], [0.1, 0.1], [6, 5]], 0.0, 0.8,
                          torch.linspace(2, 3, 7))  # fmt: skip


def shaped(width, height):
    def build():
        camera = replace(CAMERA, image_width=width, image_height=height, tanfovx=width / 80, tanfovy=height / 80)
        middle = tensor((width - 1) / 2, (height - 1) / 2)
        means = middle + tensor([0.2, -0.1], [2.3, 1.1], [-3.0, 0.4], [-(width - 1) / 2, 0], [(width - 1) / 2, 0.3])
        return camera, splats(means, [[3, 2], [1, 0.4], [9, 7], [0.5, 0.5], [2, 4]], 0.6, 0.7,
                              torch.linspace(2, 3, 5), camera)  # fmt: skip

    return build


def clamped_colours():
    """Spherical harmonics of degree 3 that make colours negative, zero and large."""
    scene = splats(SPOTS, [[3, 2]] * 5, 0.7, 0.6, torch.linspace(2, 3, 5), degree=3)
    scene["shs"][0, 0] = -3.0
    scene["shs"][1, 0] = tensor(-1.8, 0.0, 5.0)
    scene["shs"][1, 1:] = 0.0
    scene["shs"][2] *= 1e3
    return replace(CAMERA, sh_degree=3), scene


def background():
    return replace(CAMERA, bg=(-1e3, 1e6, 40.0)), axis_aligned()[1]


def far_from_origin():
    """1e6 from the world's origin, seen by a camera beside it."""
    at = tensor(1e6, -1e6, 5e5)
    eye = at + tensor(0.5, 0.25, -64)
    camera = Camera(image_width=40, image_height=24, tanfovx=0.5, tanfovy=0.3, bg=(0.2, 0.5, 0.9), sh_degree=1,
                    eye=tuple(eye.tolist()), target=tuple(at.tolist()))  # fmt: skip
    scene = splats(SPOTS, [[3, 2]] * 5, 0.7, 0.6, 64.0, degree=1)
    g = torch.Generator().manual_seed(8)
    scene["means3D"] = at + rand(g, 5, 3, low=-16.0, high=16.0)
    return camera, scene


def mixed_opacities(n):
    g = torch.Generator().manual_seed(9)
    o = rand(g, n, low=0.004, high=0.02)
    o[::97] = 0.3
    return o


# --- a full camera: blur, other planes, other projections ------------------------------------------

VELOCITIES = ("velocity", "angular_velocity", "screen_velocity")
DEPTHS = [2, 2.1, 2.2, 2.3, 2.4]
DIAGONAL = (math.cos(0.4), math.sin(0.4))


def streak(length, direction=DIAGONAL):
    """Of so many px, of the whole picture."""
    return Motion(1.0, screen_velocity=tuple(length * v for v in direction))


def travel(length):
    """A streak of so many px at the depth 2, by way of the camera."""
    return Motion(1.0, velocity=(*(length * 2 / FOCAL * v for v in DIAGONAL), 0.0))


def spun_needles(ratio):
    """Along a streak at 0.4 rad, across it, at 1e-3 rad from it and between. Those that it crosses are 0.1 px wide:
    of narrower ones nothing would be left."""

    def build():
        long = tensor(30, 1000, 30, 0.1 * ratio, 300)
        narrow = torch.where(long < 50, long / ratio, 0.1)
        return CAMERA, splats(SPOTS, torch.stack([long, narrow], -1), [0.4, 0.4 + math.pi / 2, 0.401, 0.4, 1.2], 0.95,
                              DEPTHS)  # fmt: skip

    return build


def spun_needles_by_covariance(ratio):
    def build():
        camera, scene = spun_needles(ratio)()
        return camera, flat(scene)

    return build


def wide(sigma):
    """Far wider than the image and the streak: what is left of their gradients is of the order of its square."""

    def build():
        hard = splats([[19.4, 11.7], [22.3, 12.6]], [[sigma, sigma], [2 * sigma, sigma]], [0.0, 0.6], 0.7, [2, 2.2])
        return CAMERA, joined(hard, splats([[21.0, 11.0]], [[40, 30]], 0.4, 0.6, 3.0))

    return build


def in_focus():
    """At the focus to the bit, beside it by as little as float32 knows, and away from it."""
    depths = tensor(2, 2 * (1 + 2.0**-22), 2 * (1 - 1e-4), 2.1, 1.5)
    return CAMERA, splats(SPOTS, [[3, 1], [1, 1], [0.1, 0.3], [3, 3], [5, 0.5]], [0.0, 0.0, 0.4, 0.0, 1.1], 0.7, depths)


def depths_of(*depths):
    def build():
        return CAMERA, splats(SPOTS[: len(depths)], [[3, 2]] * len(depths), 0.5, 0.8, depths)

    return build


def cropped():
    """The principal point ten half-widths left of the picture, and as far above."""
    camera = replace(CAMERA, shift=(-10 * 20, -10 * 12))
    means = torch.tensor([*SPOTS, [-30.0, 5.0], [60.0, 40.0]], dtype=torch.float64) - tensor(*camera.shift)
    return camera, splats(means, [[3, 2], [1, 1], [0.3, 0.2], [6, 4], [9, 0.5], [25, 9], [30, 20]], 0.5, 0.7,
                          torch.linspace(2, 3, 7))  # fmt: skip


class ParallelAxisCamera(ParallelCamera, AxisCamera):
    """FOCAL px per world unit at any depth, if its numbers are those of CAMERA."""


def parallel():
    """From just in front of the camera, and at it, to far away."""
    camera = ParallelAxisCamera(**{name: getattr(CAMERA, name) for name in CAMERA.__dataclass_fields__})
    scene = splats(SPOTS, [[3, 2], [1, 1], [4, 0.4], [3, 1], [6, 5]], [0.0, 0.4, 1.2, 0.0, 2.0], 0.7, 1.0)
    scene["means3D"][:, 2] = tensor(1e-30, 0.0, 1e-6, 1.0, 1e4)
    return camera, scene


FULL_CASES = [
    Case("blur_isotropic", "isotropic covariance, defocus", isotropic, round=True,
         effects=Effects(defocus=Defocus(0.3, 1.0)), reference=True),
    Case("blur_axis_aligned", "isotropic and axis-aligned covariance, streak along an axis",
         lambda: (CAMERA, joined(axis_aligned()[1], isotropic()[1])), effects=Effects(motion=streak(9, (1, 0))),
         reference=True),
    *[
        Case(f"blur_needle_{label}", f"needle of ratio {label} along and across a streak of 6 px",
             spun_needles(float(label)), margin=1e-2, effects=Effects(motion=travel(6)),
             reference=label == "1e2")
        for label in ("1e2", "1e4")
    ],
    Case("blur_needle_defocus", "needle of ratio 1e4, streak and defocus", spun_needles(1e4), margin=1e-2,
         effects=Effects(motion=travel(6), defocus=Defocus(0.02, 1.0)), reference=True),
    Case("blur_needle_cov3d", "needle of ratio 1e2 given as cov3D_precomp, streak and defocus",
         spun_needles_by_covariance(1e2), margin=1e-2, effects=Effects(motion=travel(6), defocus=Defocus(0.02, 1.0)),
         reference=True),
    Case("streak_1e-6", "streak of 1e-6 px", axis_aligned, effects=Effects(motion=streak(1e-6)), reference=True),
    Case("streak_1e3", "streak of 1e3 px", filling, effects=Effects(motion=streak(1e3)), reference=True),
    Case("blur_wide_1e6", "standard deviation 1e6 px, streak of 1e2 px", wide(1e6), round=True, margin=1e-2,
         effects=Effects(motion=streak(1e2)), reference=True),
    Case("blur_tiny", "standard deviation 1e-6 px, streak and defocus", sized(1e-6), round=True,
         effects=Effects(motion=streak(6), defocus=Defocus(0.1, 1.0)), reference=True),
    Case("in_focus", "in focus, to the bit and nearly", in_focus, round=True,
         effects=Effects(defocus=Defocus(1.0, 2.0)), reference=True),
    Case("aperture_huge", "aperture of 1e6, one plane in focus", in_focus, round=True,
         effects=Effects(defocus=Defocus(1e6, 2.0)), reference=True),
    Case("focus_near", "focus at the near plane", depths_of(0.2000001, 0.21, 0.3, 1, 5),
         effects=Effects(defocus=Defocus(0.02, 0.2)), reference=True),
    Case("planes", "just in front of and beyond near and far", depths_of(1, 1 + 2.0**-23, 3 - 2.0**-22, 3, 4),
         effects=Effects(near=1.0, far=3.0), reference=True),
    Case("orthographic", "orthographic, z from 0 to 1e4", parallel,
         effects=Effects(orthographic=True, near=0.0, motion=travel(3)), reference=True),
    Case("crop", "principal point ten half pictures outside", cropped,
         effects=Effects(off_center=True, motion=travel(6)), reference=True),
]  # fmt: skip

CASES = [
    Case("axis_aligned", "axis-aligned covariance", axis_aligned, reference=True),
    Case("isotropic", "isotropic covariance", isotropic, round=True, reference=True),
    Case("nearly_isotropic", "eigenvalues equal to 2e-7 relative", nearly_isotropic, round=True, reference=True),
    *[
        Case(
            f"needle_{label}",
            f"needle of ratio {label}, five angles",
            needles(ratio),
            margin=margin,
            reference=label == "1e3",
        )
        for label, ratio, margin in (("1e3", 1e3, 1e-2), ("1e6", 1e6, 1e-2))
    ],
    *[
        Case(
            f"needle_cov3d_{label}",
            f"needle of ratio {label} given as cov3D_precomp",
            needles_by_covariance(float(label)),
            margin=1e-2,
            reference=label != "1e6",
        )
        for label in ("1e2", "1e3", "1e6")
    ],
    *[
        Case(f"sigma_{label}", f"standard deviation {label} px", sized(float(label)), round=True, reference=True)
        for label in ("1e-6", "1e-3", "0.03", "1e2", "1e4", "1e6")
    ],
    Case("filling", "Gaussians filling the screen", filling, reference=True),
    Case("near_plane", "means at and behind the near plane", near_plane, reference=True),
    Case("frustum_clamp", "means at and beyond the frustum clamp", frustum_clamp, reference=True),
    Case("far_outside", "means 1e2 to 1e7 px outside the image", far_outside, margin=1e-2, reference=True),
    *[
        Case(f"scale_{label}", f"scales of {label}", scales_of(float(label)), reference=label in ("1e-40", "1e-20"))
        for label in ("0", "1e-40", "1e-20", "1e30", "3e38")
    ],
    Case("quaternions", "quaternions of length 1e-40 to 1e15, and zero", quaternions),
    Case("opacity_0_1", "opacities 0 and 1", opacities([0.0, 1.0, 1e-40, 1 - 2**-24, 0.5]), reference=True),
    Case("opacity_outside", "opacities outside [0, 1]", opacities([-1.0, 1.5, 1e5, -1e30, 0.5]), reference=True),
    Case("capped", "alpha at the cap of 0.99", capped, reference=True),
    Case("stack_opaque", "10,000 opaque layers", stack(lambda n: torch.full((n,), 0.93)), layers=4),
    Case("stack_faint", "10,000 nearly transparent layers", stack(lambda n: torch.full((n,), 0.005)), layers=2350),
    Case("stack_mixed", "10,000 layers, mixed", stack(mixed_opacities), layers=2350),
    Case("equal_depths", "equal depths", equal_depths, reference=True),
    Case("tile_borders", "tile borders and half-pixel offsets", tile_borders, reference=True),
    Case("image_1xN", "image of 300 x 1", shaped(300, 1), reference=True),
    Case("image_Nx1", "image of 1 x 300", shaped(1, 300), reference=True),
    Case("image_1x1", "image of 1 x 1", shaped(1, 1), reference=True),
    Case("image_ragged", "image of 33 x 17: no multiple of the tile", shaped(33, 17), reference=True),
    Case("sh_clamp", "colours that clamp at zero", clamped_colours, reference=True),
    Case("background", "background far from 0 to 1", background, reference=True),
    Case("far_from_origin", "world coordinates of 1e6", far_from_origin, reference=True),
    *FULL_CASES,
]


def perturbed(scene, eps, generator):
    """Every input off by eps of its size, sign at random.

    Scales, opacities and colours entry by entry; means, quaternions and covariances as vectors, as their
    entries are mixed by rotations.
    """
    out = {}
    for name, value in scene.items():
        size = value.abs()
        if name in ("means3D", "rotations", "cov3D_precomp"):
            size = size.amax(-1, keepdim=True).expand_as(value)
        sign = torch.randint(0, 2, value.shape, generator=generator).double() * 2 - 1
        out[name] = value if name == "means2D" else value + eps * sign * size
    return out


# --- measuring ----------------------------------------------------------------------------------


def settings_of(camera, dtype, like, variant, device="cpu", effects=None):
    """Settings in `dtype` whose numbers are rounded to `like`."""
    import analytic_rasterizer as ar

    fields = camera.fields(like)
    fields = {k: v.to(device, dtype) if torch.is_tensor(v) else v for k, v in fields.items()}
    if effects is not None:

        def number(value):
            return None if value is None else torch.as_tensor(value, dtype=like).to(device, dtype)

        fields |= {k: number(fields[k]) for k in ("tanfovx", "tanfovy")}
        lens, motion = effects.defocus, effects.motion
        if lens is not None:
            lens = Defocus(number(lens.aperture), number(lens.focus))
        if motion is not None:
            motion = Motion(motion.exposure, *(number(getattr(motion, name)) for name in VELOCITIES))
        effects = replace(effects, defocus=lens, motion=motion, camera_gradients=True)
    return ar.GaussianRasterizationSettings(**fields, footprint=variant[0], **variant[1], effects=effects)


def rows(tensor):
    """Largest absolute entry of each Gaussian (P,)."""
    return tensor.reshape(len(tensor), -1).abs().amax(-1)


def run(settings, scene, loss):
    """(image, radii, gradients) in float64 on the CPU."""
    import scenes

    import analytic_rasterizer as ar

    leaves = scenes.leaves(scene)
    settings, camera = with_camera_leaves(settings)
    color, radii = ar.GaussianRasterizer(settings)(**leaves)
    (color * loss.to(color)).sum().backward()
    grads = {name: leaf.grad.double().cpu() for name, leaf in leaves.items()}
    grads |= {name: leaf.grad.double().cpu().reshape(1, -1) for name, leaf in camera.items() if leaf.grad is not None}
    return color.detach().double().cpu(), radii.cpu(), grads


def with_camera_leaves(settings):
    """The same settings with leaves in place of all that a full camera has gradients by, and those leaves."""
    effects = settings.effects
    if effects is None:
        return settings, {}
    fields = {k: getattr(settings, k) for k in ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")}
    lens = {k: getattr(effects.defocus, k) for k in ("aperture", "focus")} if effects.defocus else {}
    moved = {k: getattr(effects.motion, k) for k in VELOCITIES} if effects.motion else {}
    made = [
        {k: v.detach().clone().requires_grad_() for k, v in some.items() if v is not None}
        for some in (fields, lens, moved)
    ]
    effects = replace(
        effects,
        defocus=Defocus(**made[1]) if lens else None,
        motion=Motion(effects.motion.exposure, **made[2]) if moved else None,
    )
    return settings._replace(**made[0], effects=effects), made[0] | made[1] | made[2]


@dataclass
class Report:
    """Errors of one case, footprint, device and dtype. By tensor, Gaussian by Gaussian; `image` by pixel."""

    name: str
    finite: bool
    unclear: float  # share of pixels at a threshold, or in a tile that takes another number of samples
    error: dict
    tolerance: dict
    size: dict  # of the gradients themselves
    image_error: float  # in clear pixels, relative to the largest colour, or 1

    def failures(self):
        return [k for k in self.error if not (self.error[k] <= self.tolerance[k]).all()]

    def describe(self):
        lines = [f"{self.name}: {self.unclear:.1%} of the pixels at a threshold, finite: {self.finite}"]
        for k in self.failures() or self.error:
            error, tolerance = self.error[k].flatten(), self.tolerance[k].expand_as(self.error[k]).flatten()
            i = int((error / tolerance.clamp_min(1e-300)).argmax())
            size = self.size[k].flatten()[i] if k in self.size else 1.0
            lines.append(f"{k}[{i}]: error {error[i]:.1e}, tolerance {tolerance[i]:.1e}, size {size:.1e}")
        return "\n".join(lines)

    def relative(self, name):
        """Largest error of a tensor's gradient, relative to the largest entry of the same Gaussian; of the image,
        see image_error."""
        if name == "image":
            return self.image_error
        seen = self.size[name] > 0
        return (self.error[name][seen] / self.size[name][seen]).max().item() if seen.any() else 0.0


def measure(case, variant, device, dtype=torch.float32):
    """Renders a case in `dtype` and compares with float64 on the CPU, for the same float32 numbers."""
    import scenes

    camera, scene = case.build()
    like = torch.float32
    ours = scenes.cast({name: value.to(like) for name, value in scene.items()}, dtype, device)
    exact = {name: value.to(like).double() for name, value in scene.items()}
    a = settings_of(camera, dtype, like, variant, device, case.effects)
    b = settings_of(camera, torch.float64, like, variant, effects=case.effects)
    g = torch.Generator().manual_seed(1)
    clear = clear_pixels(b, exact, case.margin)
    loss = rand(g, 3, camera.image_height, camera.image_width, low=-1.0) * clear
    color, _, grads = run(a, ours, loss)
    expected, _, wanted = run(b, exact, loss)
    finite = all(bool(torch.isfinite(t).all()) for t in (color, expected, *grads.values(), *wanted.values()))

    moved = {name: torch.zeros(len(value), dtype=torch.float64) for name, value in wanted.items()}
    moved_image = torch.zeros((), dtype=torch.float64)
    for _ in range(PERTURBATIONS):
        sign = torch.randint(0, 2, loss.shape, generator=g) * 2 - 1
        near, _, near_grads = run(b, perturbed(exact, EPS[like], g), loss * (1 + EPS[like] * sign))
        if clear.any():
            moved_image = torch.maximum(moved_image, (near - expected).abs()[:, clear].max())
        for name in moved:
            moved[name] = torch.maximum(moved[name], rows(near_grads[name] - wanted[name]))
    size = {name: rows(value) for name, value in wanted.items()}
    terms = dict(size, means3D=torch.maximum(size["means3D"], shift_terms(b, exact, wanted)))
    eps = EPS[like]
    operations = OPERATIONS + 3 * case.layers
    image_size = max(1.0, expected.abs().max().item())
    tolerance = {name: operations * (moved[name] + eps * terms[name]) for name in moved}
    error = {name: rows(grads[name] - wanted[name]) for name in wanted}
    # A flipped contribution: 1/255 of the difference of two colours, if not a splat stopped at T = 1e-4.
    in_pixels = torch.where(clear, operations * (moved_image + eps * image_size), 2 / 255 * image_size)
    tolerance["image"], error["image"] = in_pixels, (color - expected).abs().amax(0)
    image_error = (error["image"][clear].max().item() if clear.any() else 0.0) / image_size
    if variant[0] == "analytic":
        spread = sigma_px(exact) / camera.image_width
        for name in size:  # a camera's gradient is a sum over all Gaussians
            of_each = spread if name in exact else spread.max()
            tolerance[name] = tolerance[name] + 8 * eps * of_each * size[name]
    if variant[1].get("frame_gradient") == "paper" and case.round:
        for name in ("means3D", "scales", "rotations"):
            del error[name], tolerance[name]
    name = f"{case.name}, {variant}, {device}, {dtype}"
    unclear = 1 - clear.double().mean().item()
    return Report(name, finite, unclear, error, tolerance, size, image_error)


def sigma_px(scene):
    """Largest standard deviation (P,) [px], about, for cameras of `FOCAL`."""
    variances = scene["scales"] ** 2 if "scales" in scene else scene["cov3D_precomp"][:, [0, 3, 5]]
    return variances.amax(-1).sqrt() * FOCAL / scene["means3D"][:, 2].abs().clamp_min(0.2)


def clear_pixels(settings, scene, margin):
    """Pixels (H, W) where no alpha and no transmittance is within `margin` of a threshold, relative.

    Where none is, the image is a smooth function of a common factor on the opacities, and its second
    difference of the order of margin^2; a step or a kink leaves at least 1e-4 of a colour times margin.
    """
    import analytic_rasterizer as ar

    rasterizer = ar.GaussianRasterizer(settings)
    with torch.no_grad():
        down, here, up = (
            rasterizer(**dict(scene, opacities=scene["opacities"] * f))[0] for f in (1 - margin, 1, 1 + margin)
        )
    size = max(1.0, here.abs().max().item())
    return (up + down - 2 * here).abs().amax(0) <= 10 * margin**2 * size


def shift_terms(settings, scene, grads):
    """Size (P,) of what a mean's gradient is a sum of: far outside the image its shift and the splat's growth, as
    the mean comes nearer, cancel."""
    homogeneous = torch.cat([scene["means3D"], torch.ones(len(scene["means3D"]), 1, dtype=torch.float64)], -1)
    clip = homogeneous @ settings.projmatrix.double()
    depth = clip[:, 3].abs().clamp_min(0.2)
    ndc = (clip[:, :2] / depth[:, None]).abs().amax(-1)
    return rows(grads["means2D"]) * (1 + ndc) / depth
