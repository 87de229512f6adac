"""What is said of photographs that have a lens."""

from __future__ import annotations

from .extent import shown_share
from .layouts import Photograph
from .undistortion import window_of

FOLDED = 0.98  # of a picture: a lens that shows less folds back inside it, and not just in its corners


def lens_models(items: list[Photograph]) -> str:
    """The models of the lenses that photographs have, in words."""
    return ", ".join(sorted({item.view.lens.model for item in items if item.view.lens is not None}))


def about_lenses(distorted: list[Photograph], number: int) -> str:
    """Which photographs have a lens, in a sentence."""
    which = f"{len(distorted)} of {number} photographs have a lens ({lens_models(distorted)})"
    return f"{which}, with which they are rendered"


def about_folds(distorted: list[Photograph]) -> list[str]:
    """What is to be said of photographs whose lens folds back inside the picture, in at most one sentence: nothing is
    drawn beyond the fold, and nothing can be learned there."""
    shares = {item.files[1]: shown_share(item.view) for item in distorted}
    folded = {path: share for path, share in shares.items() if share < FOLDED}
    if not folded:
        return []
    path, least = min(folded.items(), key=lambda entry: entry[1])
    return [
        f"the lens of {len(folded)} photographs folds back inside the picture, and shows {least:.0%} of {path.name}, "
        "so that nothing is learned in the rest: its coefficients are wrong there, so calibrate again, or mask the rest"
    ]


def about_lost_area(distorted: list[Photograph], number: int) -> str:
    """What is done with photographs that are undistorted, in a sentence."""
    lost = [1 - window_of(item.view).kept for item in distorted]
    low, high = (f"{100 * share:.1f}" for share in (min(lost), max(lost)))
    return (
        f"{len(distorted)} of {number} photographs ({lens_models(distorted)}) are resampled to pinholes, for tests "
        f"too, and lose {low if low == high else f'{low} to {high}'}% of their area at the border (--lens undistort)"
    )
