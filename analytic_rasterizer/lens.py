"""What effects ask of the projection, as the op takes it."""

from __future__ import annotations

import torch
from torch.utils.weak import WeakTensorKeyDictionary

from .effects import AUTO, Defocus, Effects, Motion
from .harmonics import needed_sh_degree

_needed_degrees = WeakTensorKeyDictionary()  # of coefficients: their version, the degree asked for, the one found


def used_sh_degree(effects: Effects | str, degree: int, shs: torch.Tensor | None) -> int:
    """How many degrees of harmonics to use of those that the settings ask for.

    With `AUTO` as many as make a difference (`needed_sh_degree`): found once for a tensor and its version, which
    waits for the device. Coefficients that are being trained, or made in inference mode, are used as they are.
    """
    if effects != AUTO:
        return degree if effects.sh_degree is None else min(degree, effects.sh_degree)
    if shs is None or shs.dim() != 3 or (shs.requires_grad and torch.is_grad_enabled()):
        return degree
    used = shs[:, : (degree + 1) ** 2]
    if used.shape[1] < (degree + 1) ** 2 or shs.is_inference():  # the latter has no version to tell it by
        return degree
    known = _needed_degrees.get(shs)
    if known is None or known[:2] != (shs._version, degree):
        known = _needed_degrees[shs] = (shs._version, degree, needed_sh_degree(used))
    return known[2]


def make_lens(effects: Effects, settings, like: torch.Tensor) -> torch.Tensor:
    """The op's argument `lens`, of the dtype and device of `like`: the numbers of `Lens` in csrc/core/lens.h."""
    tangents = (settings.tanfovx, settings.tanfovy)
    if not effects.camera_gradients:
        tangents = (float(t) for t in tangents)
    center = (0.0, 0.0)
    if effects.off_center:
        center = (view_center(settings.viewmatrix, settings.projmatrix, effects.camera_gradients),)
    defocus, motion = effects.defocus or Defocus(0.0, 1.0), effects.motion or Motion(0.0)
    moved = [
        _times(motion.exposure, value, length)
        for value, length in ((motion.velocity, 3), (motion.angular_velocity, 3), (motion.screen_velocity, 2))
    ]
    numbers = (
        *tangents, *center, defocus.aperture, defocus.focus, *moved, effects.near, effects.far,
        float(effects.orthographic),
    )  # fmt: skip
    # Numbers side by side travel together; the last three are never tensors.
    parts, floats = [], []
    for number in numbers:
        if isinstance(number, torch.Tensor):
            parts += [_copied(floats, like)] if floats else []
            parts.append(number.to(like).reshape(-1))
            floats = []
        else:
            floats += number if isinstance(number, list) else [float(number)]
    last = _copied(floats, like)
    return torch.cat([*parts, last]) if parts else last


def _copied(numbers: list[float], like: torch.Tensor) -> torch.Tensor:
    """On the device of `like`. From pinned memory, or the host would wait for all work before."""
    if like.is_cuda and torch.cuda.is_current_stream_capturing():
        # A replay would copy from memory that has long been used for something else.
        raise RuntimeError("effects of the camera cannot be captured in a CUDA graph")
    host = torch.tensor(numbers, dtype=like.dtype, pin_memory=like.is_cuda)
    return host.to(like.device, non_blocking=True)


def _times(exposure, velocity, length: int):
    """Their product: a list of numbers, or a tensor where one of them is."""
    if velocity is None:
        return [0.0] * length
    if isinstance(exposure, torch.Tensor) and not isinstance(velocity, torch.Tensor):
        velocity = exposure.new_tensor(velocity)
    if isinstance(velocity, torch.Tensor):
        exposure = exposure.to(velocity).reshape(()) if isinstance(exposure, torch.Tensor) else exposure
        return exposure * velocity
    return [exposure * v for v in velocity]


def view_center(view: torch.Tensor, proj: torch.Tensor, with_gradient: bool) -> torch.Tensor:
    """(2,) x/z and y/z in the middle of the picture: where clip_x = p_xx x + p_xz z is zero."""
    view, proj = view.reshape(4, 4)[:3, :3], proj.reshape(4, 4)[:3, :2]  # columns, of the world's coordinates
    if not with_gradient:
        view, proj = view.detach(), proj.detach()
    p = view.T @ proj / (view**2).sum(0)[:, None]
    return -p[2] / p.diagonal()
