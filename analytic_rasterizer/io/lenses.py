"""Lenses by the names that COLMAP, nerfstudio and our own files of views have for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..cameras.lens import Lens
from .errors import SceneError

SIMPLE_PINHOLE, PINHOLE, FULL_OPENCV = "SIMPLE_PINHOLE", "PINHOLE", "FULL_OPENCV"
REFUSED = ("SIMPLE_DIVISION", "DIVISION", "EUCM")  # COLMAP's other models

# Of COLMAP's models: how many focal lengths there are, and the lens by the parameters after the principal point. Their
# meaning and order: https://colmap.github.io/cameras.html.
_OF_COLMAP: dict[str, tuple[int, Callable[[Sequence[float]], Lens | None]]] = {
    SIMPLE_PINHOLE: (1, lambda k: None),
    PINHOLE: (2, lambda k: None),
    "SIMPLE_RADIAL": (1, lambda k: Lens.perspective(k)),
    "RADIAL": (1, lambda k: Lens.perspective(k)),
    "OPENCV": (2, lambda k: Lens.perspective(k[:2], k[2:])),
    FULL_OPENCV: (2, lambda k: Lens.perspective((*k[:2], *k[4:]), k[2:4])),
    "SIMPLE_FISHEYE": (1, lambda k: Lens.fisheye()),
    "FISHEYE": (2, lambda k: Lens.fisheye()),
    "SIMPLE_RADIAL_FISHEYE": (1, lambda k: Lens.fisheye(k)),
    "RADIAL_FISHEYE": (1, lambda k: Lens.fisheye(k)),
    "OPENCV_FISHEYE": (2, lambda k: Lens.fisheye(k)),
    "THIN_PRISM_FISHEYE": (2, lambda k: Lens.fisheye((*k[:2], *k[4:6]), k[2:4], (k[6], 0.0, k[7]))),
    "RAD_TAN_THIN_PRISM_FISHEYE": (2, lambda k: Lens.rad_tan_fisheye(k[:6], k[6:8], k[8:])),
    "FOV": (2, lambda k: Lens.fov(k[0]) if k[0] else None),
}
SPHERICAL = "EQUIRECTANGULAR"  # whose parameters are width and height of the sphere's picture, px
NAMES = (*_OF_COLMAP, SPHERICAL)
# What an entry of a transforms file may say of the lens; nothing, or zeros, for that of its model.
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_OTHER_WORDS = ("distortion_params", "is_fisheye")


def is_plain(lens: Lens | None) -> bool:
    """Whether the lens is that of a pinhole."""
    return lens is None or (lens.model == "perspective" and not any(lens.coefficients))


def lens_of_colmap(model: str, parameters: Sequence[float], where: str) -> tuple[dict[str, float], Lens | None]:
    """fx, fy, cx and cy as `View` has them, px, and the lens of a camera of COLMAP; None for a pinhole.

    Args:
        model: A name of COLMAP.
        parameters: In COLMAP's order.
        where: Begins messages.

    Raises:
        SceneError: A model that is not of `NAMES`; parameters that are not finite, or no lens.
    """
    if model == SPHERICAL:
        if not all(math.isfinite(number) and number > 0 for number in parameters):
            raise SceneError(f"{where} must have a positive size")
        return sphere_of(*parameters), Lens.equirectangular()
    if model not in _OF_COLMAP:
        raise SceneError(
            f"{where} is {model}; rendered are {', '.join(NAMES)}: undistort the pictures first, with COLMAP's "
            "image_undistorter for example"
        )
    count, make = _OF_COLMAP[model]
    focal, (cx, cy), coefficients = parameters[:count], parameters[count : count + 2], parameters[count + 2 :]
    if not all(map(math.isfinite, (*focal, cx, cy))) or min(focal) <= 0:
        raise SceneError(f"{where} must have a positive size and focal length")
    lens = _made(lambda: make(coefficients), f"{where} ({model})")
    return {"fx": focal[0], "fy": focal[-1], "cx": cx, "cy": cy}, lens


def sphere_of(width: float, height: float) -> dict[str, float]:
    """fx, fy, cx and cy of a picture of the whole sphere, px."""
    return {"fx": width / (2 * math.pi), "fy": height / math.pi, "cx": width / 2, "cy": height / 2}


def lens_of_transforms(entry: Mapping[str, Any], where: str) -> Lens | None:
    """The lens of an entry of a nerfstudio or instant-ngp file, with what all entries share; None for a pinhole.

    Raises SceneError, which begins with `where`.
    """
    said = {name: entry[name] for name in (*_COEFFICIENTS, *_OTHER_WORDS) if _says_something(entry.get(name))}
    model = model_name(entry) or ("OPENCV_FISHEYE" if said.get("is_fisheye") is True else "OPENCV")
    if model == "OPENCV_FISHEYE":
        said.pop("is_fisheye", None)
    if model == SPHERICAL:
        if said:
            raise SceneError(f"{where}: {SPHERICAL} must have no coefficients, got {', '.join(said)}")
        return Lens.equirectangular()
    if model not in NAMES:
        raise SceneError(f"{where}: camera_model must be one of {', '.join(NAMES)}, got {model!r}")
    # COLMAP's FULL_OPENCV has k4, k5, k6 as divisors. nerfstudio's OPENCV has k4 on the polynomial of k1, k2, k3.
    known = {"OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"), FULL_OPENCV: _COEFFICIENTS}
    names = known.get(model, ("k1", "k2", "k3", "p1", "p2"))
    for name in (name for name in said if name not in names):
        way_out = "undistort the pictures first"
        if (model, name) == ("OPENCV", "k4"):
            way_out = (
                "nerfstudio has it on the radius's 8th power, which OpenCV's lens does not have: "
                f"{way_out}, or fit {FULL_OPENCV}"
            )
        raise SceneError(
            f"{where}: a lens of {model} must have no coefficients but {', '.join(names)}, got {name} = {said[name]}; "
            f"{way_out}"
        )
    if model == "OPENCV_FISHEYE":
        return _made(lambda: Lens.fisheye([said.get(name, 0.0) for name in names]), where)
    if model not in (PINHOLE, SIMPLE_PINHOLE, "SIMPLE_RADIAL", "RADIAL", "OPENCV", FULL_OPENCV):
        raise SceneError(f"{where}: camera_model {model} is not one of nerfstudio's")
    radial, tangential = ([said.get(name, 0.0) for name in _COEFFICIENTS[part]] for part in (slice(6), slice(6, 8)))
    return _made(lambda: Lens.perspective(radial, tangential), where)


def model_name(entry: Mapping[str, Any]) -> Any:
    """The camera_model of an entry, in capitals; None where there is none."""
    model = entry.get("camera_model")
    return model.upper() if isinstance(model, str) else model


def _says_something(value) -> bool:
    return any(value if isinstance(value, list) else [value])


def lens_to_json(lens: Lens) -> dict[str, Any]:
    """An entry `lens` of a file of views: the model, and its coefficients in the order of csrc/core/camera/."""
    coefficients = list(lens.numbers())
    while coefficients and coefficients[-1] == 0:
        coefficients.pop()
    return {"model": lens.model, "coefficients": coefficients}


def lens_from_json(data: Any, where: str) -> Lens:
    """What `lens_to_json` wrote. Raises SceneError, which begins with `where`."""
    if not isinstance(data, dict) or not isinstance(data.get("coefficients"), list):
        raise SceneError(f"{where} must be an object with a model and a list of coefficients, got {data!r:.80}")
    return _made(lambda: Lens(data.get("model", ""), data["coefficients"]), where, keep_plain=True)


def _made(make: Callable[[], Lens | None], where: str, keep_plain: bool = False) -> Lens | None:
    try:
        lens = make()
        if lens is not None and not is_plain(lens):
            lens.fold  # noqa: B018 - raises if the lens is no map at its axis
    except (ValueError, TypeError) as error:
        raise SceneError(f"{where}: {error}") from None
    return None if is_plain(lens) and not keep_plain else lens
