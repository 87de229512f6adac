"""For commands that show a scene: finds its views and its background, and says on stderr what was chosen and why."""

from __future__ import annotations

import sys

from .. import io
from ..io import FoundScene, View
from ..io.appearance import OrderChoice


def say(*lines: str) -> None:
    """Prints lines on stderr: stdout is for results. To be called when nothing can be wrong with the arguments any
    more: an error is one line."""
    for line in lines:
        print(line, file=sys.stderr, flush=True)


def settle_views(args, found: FoundScene, required: bool = True) -> tuple[list[View], list[str]]:
    """The views to show a scene from, and a line that says what was found around SCENE, or none.

    Sets `args.background` where it was not given.

    Args:
        args: With scene, views, size and background.
        found: The scene.
        required: Whether it is an error that there are no views.
    """
    views, said = [], []
    if required or args.views is not None or found.cameras is not None:
        views = found.load_views(args.views, args.size)
        if args.views is None:
            said.append(f"{len(views)} view{'s' * (len(views) != 1)} of {found.cameras}, {sizes_in_words(views)}")
        if found.size_reason and (args.views is None or found.is_cameras(args.views)):
            said.append(f"the size of the training ({found.size_reason})")
    if args.background is None:
        args.background = io.BLACK
        if found.background is not None:
            args.background, source = found.background
            said.append(f"background {color_in_words(args.background)} ({source})")
    if str(found.path) != args.scene:
        said.insert(0, str(found.path))
    return views, [f"from {args.scene}: {'; '.join(said)}"] if said else []


def order_in_words(choice: OrderChoice) -> list[str]:
    """Why splats are in this order, in a line; none where that needs no word."""
    return [f"order {choice.order}: {choice.reason}"] if choice.reason else []


def sizes_in_words(views: list[View]) -> str:
    """Such as "800x600", or "800x600 to 1920x1080"."""
    sizes = sorted({(view.width, view.height) for view in views})
    return " to ".join(f"{width}x{height}" for width, height in dict.fromkeys((sizes[0], sizes[-1])))


def color_in_words(color: tuple[float, float, float]) -> str:
    named = {io.BLACK: "black", io.WHITE: "white"}
    return named.get(tuple(color), ",".join(f"{value:g}" for value in color))
