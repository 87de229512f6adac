"""What a rendering can have beyond three colours of a fixed pinhole camera. What is not asked for costs nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from typing import Any, NamedTuple

import torch

from .. import _C
from ..cameras.lens import SPHERE, Lens
from ..checks import check_number
from .order import CENTER, check_order

MAX_SH_DEGREE = _C.MAX_SH_DEGREE
NEAR = _C.NEAR  # camera-space z up to which everything is culled
AUTO = "auto"


class GaussianStats(NamedTuple):
    """How much of each of the P Gaussians a picture shows.

    The weight of a Gaussian in a pixel is here the factor of its colour in the pixel: transmittance times alpha.

    Attributes:
        pixels: (P,) int32, number of pixels in which its weight is not zero.
        max_weight: (P,) float32, largest weight, 0 to 1.
        sum_weight: (P,) sum of weights over all pixels, in steps of 2^-32.
        pixels_in_front: (P,) int32, number of those pixels in which more than half of the light is left behind it.
        pixels_dominated: (P,) int32, number of pixels whose `Outputs.dominant_index` it is.
    """

    pixels: torch.Tensor
    max_weight: torch.Tensor
    sum_weight: torch.Tensor
    pixels_in_front: torch.Tensor
    pixels_dominated: torch.Tensor


class Outputs(NamedTuple):
    """What `Effects` asked for; None for the rest. The first three are differentiable in every input of the rasterizer.

    Attributes:
        alpha: (1, H, W) in 0 to 1: the share of the pixel that is covered.
        depth: (1, H, W) sum over Gaussians of weight times z, world units; divided by alpha (`normalized`) it is the
            mean depth of what is seen.
        inverse_depth: (1, H, W) sum over Gaussians of weight divided by z, 1 / world units.
        median_depth: (1, H, W) z of the Gaussian behind which less than half of the light is left, world units; 0 where
            half of the light or more gets through.
        dominant_index: (1, H, W) int32, the Gaussian of the largest weight, of equal ones the nearest; -1 for none.
        gaussian_stats: `GaussianStats`.
    """

    alpha: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    inverse_depth: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None
    dominant_index: torch.Tensor | None = None
    gaussian_stats: GaussianStats | None = None


OUTPUTS = Outputs._fields


def _equal(self: Any, other: object):
    """`__eq__` of a dataclass whose fields may hold tensors: those are compared by their values."""
    if not isinstance(other, type(self)):
        return NotImplemented
    return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))


def _same(a: Any, b: Any) -> bool:
    """Whether two numbers, tuples or tensors are equal. `==` of tensors has no truth value."""
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return a is b or (a.shape == b.shape and a.device == b.device and torch.equal(a, b))
    if (isinstance(a, torch.Tensor) and a.dim()) or (isinstance(b, torch.Tensor) and b.dim()):
        return False
    return bool(a == b)


@dataclass(frozen=True)
class Defocus:
    """A thin lens: what is not at its focus becomes a disc, taken as the Gaussian of the same variance.

    A point at depth z makes a disc of diameter f * aperture * |1/focus - 1/z| px, f the focal length in px; of
    f * aperture * |z - focus| px under an orthographic camera, where aperture is the opening of the cone.

    Attributes:
        aperture: Diameter of the lens, world units, not negative; a number, or a tensor with one, differentiable.
        focus: Depth that is sharp, world units, positive; a number, or a tensor with one, differentiable.

    Raises:
        TypeError: Not a number or a tensor.
        ValueError: A number outside of its domain, or a tensor with more than one.
    """

    aperture: float | torch.Tensor
    focus: float | torch.Tensor

    def __post_init__(self):
        check_number("aperture", self.aperture, at_least=0)
        check_number("focus", self.focus, above=0)


@dataclass(frozen=True)
class Motion:
    """What moves while the shutter is open becomes a streak, taken as the Gaussian of the same variance.

    The streak of a Gaussian is as long as its centre's velocity in the image times the exposure, and lies around
    where the pose of the settings, the middle of the exposure, puts it. Velocities that are not given are zero.

    Attributes:
        exposure: Time that the shutter is open, s, not negative; a number, or a tensor with one, differentiable.
        velocity: (3,) of the camera along its axes (x right, y down, z forward), world units / s.
        angular_velocity: (3,) of the camera around them, rad / s.
        screen_velocity: (2,) of the whole picture, px / s.

    Velocities may be tensors, or tuples of numbers and tensors with one; tensors are differentiable.

    Raises:
        TypeError: `exposure` is not a number or a tensor, or a velocity is not numbers.
        ValueError: A number outside of its domain, or a wrong shape.
    """

    exposure: float | torch.Tensor
    velocity: tuple | torch.Tensor | None = None
    angular_velocity: tuple | torch.Tensor | None = None
    screen_velocity: tuple | torch.Tensor | None = None

    def __post_init__(self):
        check_number("exposure", self.exposure, at_least=0)
        for name, length in (("velocity", 3), ("angular_velocity", 3), ("screen_velocity", 2)):
            value = getattr(self, name)
            if isinstance(value, torch.Tensor):
                fits = value.shape == (length,)
            elif value is not None and (isinstance(value, str) or not hasattr(value, "__len__")):
                raise TypeError(f"{name} must be a tuple or a tensor of {length} numbers, got {value!r}")
            else:
                fits = value is None or len(value) == length
                for number in value if value is not None and fits else ():
                    check_number(f"every number of {name}", number)
            if not fits:
                raise ValueError(f"{name} must have {length} finite numbers, got {value!r}")

    __eq__ = _equal

    def __hash__(self):
        # Not of the values: equal tensors have different hashes, and lists have none.
        return hash((Motion, *(getattr(self, f.name) is None for f in fields(self))))


@dataclass(frozen=True)
class Effects:
    """What a rendering has beyond three colours of a fixed camera. What is not asked for costs nothing.

    The first six ask for an output of the same name: with any of them the rasterizer returns (color, radii, `Outputs`),
    and `Outputs` says what they are.

    Attributes:
        alpha: How much of each pixel is covered, 1 - transmittance.
        depth: Expected depth: camera-space z of the Gaussians' centres, blended like a colour on a background of zero.
        inverse_depth: Likewise of 1/z.
        median_depth: z of the Gaussian behind which less than half of a pixel's light is left.
        dominant_index: The Gaussian that has the largest weight in a pixel.
        gaussian_stats: How much of every Gaussian is seen, for pruning.
        camera_gradients: Gradients with respect to viewmatrix, projmatrix, campos, tanfovx and tanfovy of the settings
            that are tensors and require one. Any of them that requires one switches it on by itself.
            `camera_settings` derives them from a pose and fx, fy, cx, cy.
        orthographic: No perspective. tanfovx and tanfovy are half the width and height of the picture in world
            units, and projmatrix must leave w at 1.
        off_center: Centre the clamp of x/z and y/z in the projection of covariances on the middle of the picture, by
            projmatrix. Without it the clamp is that of 3DGS, around the optical axis: right unless an edge of the
            picture is more than 1.3 half pictures away from the axis, as in a crop.
        near: Camera-space z up to which everything is culled, world units.
        far: Camera-space z from which on everything is culled.
        filter_3d: (P,) of `compute_3d_filter`: widens scales and lowers opacities (`apply_3d_filter`).
        lens: `Lens`, or None for a pinhole. Depths are then those of the model: z of `perspective` and `fov`, the
            distance from the camera of the others, by which splats are ordered too, and near and far are too.
        defocus: `Defocus`, or None for a pinhole.
        motion: `Motion`, or None for an instant.
        sh_degree: Highest degree of spherical harmonics to use, 0 to 4; None: that of the settings.
        order: In which order a pixel composites splats: "center", by the depth of their centres; "ray", by the depth at
            which its ray is densest in them, so that nothing pops when the camera moves; "ray:32", the same nearer to
            the exact order (`ORDERS`). With the last two at most 4 channels are blended, not every footprint can be
            used, and medians, dominant Gaussians and statistics cannot be made. Several times as slow.

    Raises:
        TypeError: A wrong type.
        ValueError: A wrong number or shape.
    """

    alpha: bool = False
    depth: bool = False
    inverse_depth: bool = False
    median_depth: bool = False
    dominant_index: bool = False
    gaussian_stats: bool = False
    camera_gradients: bool = False
    orthographic: bool = False
    off_center: bool = False
    near: float = NEAR
    far: float = math.inf
    filter_3d: torch.Tensor | None = field(default=None, hash=False)  # equal tensors have different hashes
    defocus: Defocus | None = None
    motion: Motion | None = None
    sh_degree: int | None = None
    lens: Lens | None = None
    order: str = CENTER

    __eq__ = _equal

    def __post_init__(self):
        for name in (*OUTPUTS, "camera_gradients", "orthographic", "off_center"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name} must be a bool, got {getattr(self, name)!r}")
        for name, kind in (("filter_3d", torch.Tensor), ("defocus", Defocus), ("motion", Motion), ("lens", Lens)):
            value = getattr(self, name)
            if not (value is None or isinstance(value, kind)):
                raise TypeError(f"{name} must be a {kind.__name__} or None, got {value!r}")
        if self.lens is not None and self.orthographic:
            raise ValueError("lens must be None for an orthographic camera")
        self._check_order()
        degree = self.sh_degree
        if isinstance(degree, bool) or not (degree is None or isinstance(degree, Integral)):
            raise TypeError(f"sh_degree must be a whole number or None, got {degree!r}")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise ValueError(f"sh_degree must be 0 to {MAX_SH_DEGREE}, got {self.sh_degree}")
        check_number("near", self.near, **({"at_least": 0} if self.orthographic else {"above": 0}))
        if isinstance(self.far, torch.Tensor) or self.far != math.inf:
            check_number("far", self.far)
        if not self.far > self.near:
            raise ValueError(f"far must be above near, {self.near}, got {self.far}")

    def _check_order(self) -> None:
        """Raises ValueError for an order that there is not, or that does not go with the rest."""
        check_order(self.order)
        if self.order == CENTER:
            return
        for name in ("median_depth", "dominant_index", "gaussian_stats"):
            if getattr(self, name):
                raise ValueError(f"{name} must be False with order {self.order!r}, got True")
        if self.lens is not None and self.lens.model == SPHERE:
            raise ValueError(f"lens must not be {SPHERE} with order {self.order!r}")

    @property
    def has_outputs(self) -> bool:
        """Whether there is something to return beside the colours."""
        return any(getattr(self, name) for name in OUTPUTS)

    def with_outputs_of(self, other: Effects) -> Effects:
        """The same with the outputs that `other` asks for, too."""
        return replace(self, **{name: True for name in OUTPUTS if getattr(other, name)})

    def with_camera_gradients(self) -> Effects:
        """The same with gradients with respect to the camera."""
        return self if self.camera_gradients else replace(self, camera_gradients=True)

    @property
    def changes_camera(self) -> bool:
        """Whether the projection needs the full camera (csrc/core/camera.h), not only the pinhole of 3DGS."""
        return (
            self.camera_gradients
            or self.orthographic
            or self.off_center
            or (self.near, self.far) != (NEAR, math.inf)
            or self.defocus is not None
            or self.motion is not None
            or self.lens is not None
        )

    def lens_members(self) -> dict:
        """The entries of the operator's argument `lens` that the effects set, by the names of `_C.LENS`.

        Numbers, lists of numbers, or tensors.
        """
        model = _C.CAMERA_MODELS.index("orthographic" if self.orthographic else "pinhole")
        members = {"focus": 1.0, "near": self.near, "far": self.far, "model": float(model)}
        if self.lens:
            members |= self.lens.members()
        if self.defocus:
            members |= {"aperture": self.defocus.aperture, "focus": self.defocus.focus}
        if self.motion:
            velocities = {
                "shift": self.motion.velocity,
                "turn": self.motion.angular_velocity,
                "screen": self.motion.screen_velocity,
            }
            members |= {k: _times(self.motion.exposure, v) for k, v in velocities.items() if v is not None}
        return members


def _is_integer_tensor(value) -> bool:
    return isinstance(value, torch.Tensor) and not value.is_floating_point()


def _times(exposure, velocity):
    """exposure * velocity: a tensor if one of the two is or holds a tensor, otherwise a list."""
    if not isinstance(velocity, torch.Tensor):
        tensors = [v for v in (exposure, *velocity) if isinstance(v, torch.Tensor)]
        if not tensors:
            return [exposure * v for v in velocity]
        to = {"dtype": torch.float64, "device": tensors[0].device}
        # Numbers as fills, for which the host waits for no device.
        numbers = (v.reshape(()).to(**to) if isinstance(v, torch.Tensor) else torch.full((), v, **to) for v in velocity)
        velocity = torch.stack(list(numbers))
    # Integers would round the other factor.
    exposure, velocity = (t.double() if _is_integer_tensor(t) else t for t in (exposure, velocity))
    return (exposure.to(velocity).reshape(()) if isinstance(exposure, torch.Tensor) else exposure) * velocity
