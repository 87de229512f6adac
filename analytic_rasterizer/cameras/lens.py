"""Lenses: cameras whose photographs are not those of a pinhole (`Effects.lens`, csrc/core/camera/)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .. import _C
from ..checks import check_number

SIZE = dict(_C.LENS)["distortion"]
# By model: how many coefficients there are at most, radial, tangential and thin prism ones, and where each kind begins.
_PARTS = {
    "perspective": ((6, 0), (2, 6), (4, 8)),
    "fisheye": ((4, 0), (2, 6), (4, 8)),
    "rad_tan_fisheye": ((6, 0), (2, 6), (4, 8)),
}
# And the coefficients that a model does not have, by their places in words.
_ABSENT = {"fisheye": {"4 and 5": slice(4, 6)}, "fov": {"from 1 on": slice(1, SIZE)}}
SPHERE = "equirectangular"
MODELS = (*_PARTS, "fov", SPHERE)
WIDE = ("fisheye", "rad_tan_fisheye")  # models that see beyond 90 degrees from the axis, about the axis
_ANGLES = 4096  # at which a guess of a direction is found
_NEWTON_STEPS, _LONGEST_STEP = 30, 0.2  # rad


@dataclass(frozen=True, eq=False)
class Lens:
    """How a lens bends what a pinhole would see. Focal lengths and principal point are those of the settings.

    The classmethods make one from the names of OpenCV and COLMAP. A Gaussian's mean goes through the exact map, its
    covariance through its exact Jacobian there. Gaussians beyond the angle at which the map folds back are culled.

    Attributes:
        model: One of `perspective`, `fisheye`, `rad_tan_fisheye`, `fov`, `equirectangular`.
        coefficients: (12,) numbers in the order of csrc/core/camera/, or a tensor, differentiable. `equirectangular`
            has none. A tensor on CUDA is not examined: with numbers that make no map, nothing is seen.
        reach: Angle from the axis, rad, beyond which the Jacobian is that of a ray at this angle; None: 1.3 times the
            largest (of its tangent, for `perspective` and `fov`) that the picture sees. Of `equirectangular` it is a
            latitude, below pi/2; None: half a pixel from the poles, as far as the nearest row of pixel centres.

    Raises:
        TypeError: Coefficients or reach are no numbers.
        ValueError: An unknown model, or coefficients that it does not have, or numbers that are not finite.
    """

    model: str
    coefficients: Sequence[float] | torch.Tensor
    reach: float | None = None

    def __post_init__(self):
        if self.model not in MODELS:
            raise ValueError(f"model must be one of {', '.join(MODELS)}, got {self.model!r}")
        given = self.coefficients
        if isinstance(given, torch.Tensor):
            if given.shape != (SIZE,):
                raise ValueError(f"coefficients must have shape ({SIZE},), got {tuple(given.shape)}")
        else:
            numbers = _numbers("coefficients", given, SIZE)
            object.__setattr__(self, "coefficients", numbers + (0.0,) * (SIZE - len(numbers)))
            if self.model == "fov" and not 0 < self.coefficients[0] < math.pi:
                raise ValueError(f"w of a fov lens must be above 0 and below pi, got {self.coefficients[0]}")
            for where, none in _ABSENT.get(self.model, {}).items():
                if any(self.coefficients[none]):
                    raise ValueError(f"coefficients {where} of a {self.model} lens must be zero, got {given}")
        if self.model == SPHERE and (isinstance(given, torch.Tensor) or any(self.coefficients)):
            raise ValueError(f"coefficients of an equirectangular lens must be zero, got {given}")
        if self.reach is not None:
            if isinstance(self.reach, torch.Tensor):
                raise TypeError(f"reach must be a number, got {self.reach!r}")
            check_number("reach", self.reach, above=0)
            if self.reach > math.pi:
                raise ValueError(f"reach must be at most pi, got {self.reach}")
        if self.model == SPHERE and self.reach is not None and not self.reach < math.pi / 2:
            raise ValueError(f"reach of an equirectangular lens must be below pi/2, got {self.reach}")

    @classmethod
    def perspective(cls, radial=(), tangential=(), thin_prism=()) -> Lens:
        """OpenCV's lens, of COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV too.

        Args:
            radial: Up to six numbers k1 to k6; k4, k5 and k6 divide.
            tangential: p1, p2.
            thin_prism: Up to four numbers s1 to s4.

        Raises:
            TypeError, ValueError: Numbers as in `Lens`.
        """
        return cls("perspective", _arranged("perspective", radial, tangential, thin_prism))

    @classmethod
    def fisheye(cls, radial=(), tangential=(), thin_prism=()) -> Lens:
        """OpenCV's fisheye, of COLMAP's SIMPLE_FISHEYE to THIN_PRISM_FISHEYE too: equidistant, then distorted.

        Args:
            radial: Up to four numbers k1 to k4, factors of the angle's powers 3, 5, 7 and 9.
            tangential: p1, p2.
            thin_prism: Up to four numbers s1 to s4; COLMAP's sx1 and sy1 are s1 and s3.

        Raises:
            TypeError, ValueError: Numbers as in `Lens`.
        """
        return cls("fisheye", _arranged("fisheye", radial, tangential, thin_prism))

    @classmethod
    def rad_tan_fisheye(cls, radial=(), tangential=(), thin_prism=()) -> Lens:
        """COLMAP's RAD_TAN_THIN_PRISM_FISHEYE: tangential and thin prism terms of the point after the radial ones.

        Args:
            radial: Up to six numbers k0 to k5.
            tangential: p0, p1.
            thin_prism: Up to four numbers s0 to s3.

        Raises:
            TypeError, ValueError: Numbers as in `Lens`.
        """
        return cls("rad_tan_fisheye", _arranged("rad_tan_fisheye", radial, tangential, thin_prism))

    @classmethod
    def fov(cls, w: float) -> Lens:
        """COLMAP's FOV: the distance in the picture is atan(2 r tan(w/2)) / w, r that of a pinhole.

        Raises:
            TypeError, ValueError: w is no number above 0 and below pi.
        """
        return cls("fov", (w,))

    @classmethod
    def equirectangular(cls) -> Lens:
        """The sphere, or a part of it: columns are longitudes atan2(x, z), rows are latitudes asin(y / |p|).

        A picture of w x h px shows the whole sphere with fx = w / (2 pi) and fy = h / pi. Its left and right borders
        are the same seam: what lies across one shows at both.
        """
        return cls(SPHERE, ())

    @property
    def orders_by_distance(self) -> bool:
        """Whether depths are distances from the camera, and not camera-space z."""
        return self.model in (*WIDE, SPHERE)

    def depths(self, points: torch.Tensor) -> torch.Tensor:
        """(N,) depths, as of `Effects.lens`, of points (N, 3) in the camera's frame, world units.

        Of the dtype and device of the points, differentiable.
        """
        return points.norm(dim=1) if self.orders_by_distance else points[:, 2]

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where the lens shows points, in units of the focal lengths, from the principal point. Waits for a device.

        Args:
            points: (N, 3) in the camera's frame: x right, y down, z forward.

        Returns:
            positions: (N, 2) float64 on the CPU; NaN beyond `fold`, where the lens shows nothing, and for points that
                are not finite or at the camera.
            derivatives: (N, 2, 3) of the positions by the points, likewise.

        Raises:
            TypeError: The points are no tensor.
            ValueError: They do not have the shape (N, 3).
        """
        points = _rows("points", points, 3)
        size = points.abs().amax(1, keepdim=True)  # only the direction counts: squares of large points overflow
        rays = points / size
        positions, derivatives = _C.lens_points(self.model, list(self.numbers()), rays)
        hidden = ~(torch.atan2(rays[:, :2].norm(dim=1), rays[:, 2]) <= self.fold)
        if hidden.any():
            positions[hidden], derivatives[hidden] = math.nan, math.nan
        return positions, derivatives / size[:, None]

    def unproject(self, positions: torch.Tensor) -> torch.Tensor:
        """(N, 3) unit vectors in the camera's frame that the lens shows at `positions` (N, 2).

        By Newton's method, but for `equirectangular`, which has a formula.

        Units as of `project`; float64, on the CPU. NaN where no direction is found.

        Raises:
            TypeError, ValueError: Positions as the points of `project`.
        """
        positions = _rows("positions", positions, 2)
        if self.model == SPHERE:
            longitude, latitude = positions.unbind(1)
            rays = torch.stack([latitude.cos() * longitude.sin(), latitude.sin(), latitude.cos() * longitude.cos()], 1)
            shown = longitude.isfinite() & (latitude.abs() <= math.pi / 2)
            return torch.where(shown[:, None], rays, math.nan)
        # The unknown is the angle from the axis times the unit vector across it. The first guess is the angle that the
        # lens shows at this distance along x.
        angles = torch.linspace(0, self.fold, _ANGLES, dtype=torch.float64)
        shown = self.project(torch.stack([angles.sin(), torch.zeros_like(angles), angles.cos()], 1))[0]
        shown = shown.norm(dim=1).nan_to_num(math.inf).cummax(0).values
        distance = positions.norm(dim=1)
        found = angles[torch.searchsorted(shown, distance).clamp_max(len(angles) - 1)]
        turned = positions * (found / distance.clamp_min(1e-300))[:, None]
        values = list(self.numbers())
        for _ in range(_NEWTON_STEPS):
            rays, slopes = _turned_rays(turned)
            seen, derivatives = _C.lens_points(self.model, values, rays)
            step = torch.linalg.solve_ex(derivatives @ slopes, (positions - seen)[:, :, None])[0][:, :, 0]
            # Not past the axis, nor farther than the lens bends in a step.
            turned = turned + step * (_LONGEST_STEP / step.norm(dim=1, keepdim=True)).clamp_max(1)
        rays, _ = _turned_rays(turned)
        seen = self.project(rays)[0]
        wrong = ~((seen - positions).norm(dim=1) <= 1e-9 * (1 + distance))
        return torch.where(wrong[:, None], math.nan, rays)

    def with_reach(self, tangents: Sequence[float], center: Sequence[float], height: int | None = None) -> Lens:
        """The same with `reach` for a picture, unless it has one.

        Args:
            tangents: tanfovx and tanfovy of the settings; numbers or tensors.
            center: x/z and y/z of a pinhole at the middle of the picture; numbers or tensors.
            height: Of the picture, px; `equirectangular` needs it.

        Waits for the device of tensors.
        """
        if self.reach is not None:
            return self
        tan_x, tan_y, x, y = (v.item() if isinstance(v, torch.Tensor) else float(v) for v in (*tangents, *center))
        reach = _C.lens_reach(self.model, self.numbers(), tan_x, tan_y, x, y, height or 0)
        return Lens(self.model, self.coefficients, reach)

    @property
    def fold(self) -> float:
        """The angle from the axis at which the map folds back, rad, or where the model ends. Reads the coefficients."""
        return _C.lens_fold(self.model, self.numbers())

    def members(self) -> dict:
        """The entries of a lens for the operators, by the names of `_C.LENS`; `reach` is 0 where it is not known."""
        given = self.coefficients
        return {
            "model": float(_C.CAMERA_MODELS.index(self.model)),
            "distortion": given if isinstance(given, torch.Tensor) else list(given),
            "reach": 0.0 if self.reach is None else self.reach,
        }

    def numbers(self) -> tuple[float, ...]:
        """The twelve coefficients. Waits for the device of a tensor."""
        given = self.coefficients
        return tuple(given.detach().double().tolist()) if isinstance(given, torch.Tensor) else given

    def __eq__(self, other: object):
        if not isinstance(other, Lens):
            return NotImplemented
        same = self.coefficients is other.coefficients or self.numbers() == other.numbers()
        return same and (self.model, self.reach) == (other.model, other.reach)

    def __hash__(self):
        return hash((self.model, self.reach))  # tensors that are equal have different hashes


def _rows(name: str, given: torch.Tensor, width: int) -> torch.Tensor:
    if not isinstance(given, torch.Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(given).__name__}")
    if given.dim() != 2 or given.shape[1] != width:
        raise ValueError(f"{name} must have shape (N, {width}), got {tuple(given.shape)}")
    return given.detach().to("cpu", torch.float64).contiguous()


def _turned_rays(turned: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit vectors (N, 3) at the angle |turned| (N, 2) from the axis, and their derivatives (N, 3, 2)."""
    angle = turned.norm(dim=1)
    sinc = torch.sinc(angle / math.pi)
    # d sinc(a) / da / a, whose series is used near the axis.
    small = angle < 1e-4
    safe = torch.where(small, 1.0, angle)
    slope = torch.where(small, -1 / 3, (safe.cos() - sinc) / safe**2)
    x, y = turned.unbind(1)
    rays = torch.stack([sinc * x, sinc * y, angle.cos()], 1)
    rows = [[sinc + slope * x * x, slope * x * y], [slope * x * y, sinc + slope * y * y], [-sinc * x, -sinc * y]]
    return rays, torch.stack([torch.stack(row, 1) for row in rows], 1)


def _numbers(name: str, given, most: int) -> tuple[float, ...]:
    if isinstance(given, (str, torch.Tensor)) or not hasattr(given, "__len__"):
        raise TypeError(f"{name} must be a sequence of numbers, got {given!r}")
    if len(given) > most:
        raise ValueError(f"{name} must have at most {most} numbers, got {len(given)}")
    for number in given:
        if isinstance(number, torch.Tensor):  # whose gradient would be lost
            raise TypeError(f"{name} must hold numbers, or coefficients be one tensor, got {number!r}")
        check_number(f"every number of {name}", number)
    return tuple(float(number) for number in given)


def _arranged(model: str, radial, tangential, thin_prism) -> tuple[float, ...]:
    to = [0.0] * SIZE
    given = {"radial": radial, "tangential": tangential, "thin_prism": thin_prism}
    for (name, values), (most, first) in zip(given.items(), _PARTS[model]):
        numbers = _numbers(name, values, most)
        to[first : first + len(numbers)] = numbers
    return tuple(to)
