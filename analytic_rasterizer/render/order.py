"""In which order a pixel composites splats: by the depth of their centres, as 3DGS does, or along the pixel's ray.

The order along rays is defined in csrc/core/order.h. It is for `Effects.order`, and for what commands call `--order`.
"""

from __future__ import annotations

from .. import _C
from ..footprints import Footprint, footprint_variants, resolve_footprint, stated

CENTER, RAY, RAY_WIDE = "center", "ray", "ray:32"
WINDOWS = {CENTER: 0, RAY: 24, RAY_WIDE: 32}
"""Of every order, how many splats a pixel sorts at a time; 0: none."""
ORDERS = tuple(WINDOWS)
"""What `Effects.order` may be."""


def check_order(order: str) -> None:
    """Raises TypeError unless it is a string, and ValueError unless it is one of `ORDERS`."""
    if not isinstance(order, str) or order not in ORDERS:
        error = ValueError if isinstance(order, str) else TypeError
        raise error(f"order must be one of {', '.join(ORDERS)}, got {order!r}")


def footprints_along_rays() -> tuple[str, ...]:
    """The footprints that can be ordered along rays, as `footprint_variants` has them."""
    return tuple(name for name in footprint_variants() if stated(resolve_footprint(name))["along_rays"])


def can_be_in(footprint: Footprint, order: str) -> bool:
    """Whether a footprint can be combined with an order."""
    return order == CENTER or stated(footprint)["along_rays"]


def key_of(footprint: Footprint, order: str) -> str:
    """The argument `footprint` of the operators.

    Raises:
        ValueError: The footprint cannot be combined with this order.
    """
    if not can_be_in(footprint, order):
        known = ", ".join(footprints_along_rays())
        raise ValueError(f"footprint must be one of {known} with order {order!r}, got {footprint}")
    return footprint.key if order == CENTER else f"{footprint.key}{_C.RAY_MARK}{WINDOWS[order]}"
