"""Whether `import diff_gaussian_rasterization` runs our module: other distributions install one of the same name."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import warnings
from pathlib import Path

_NAMES = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_ms")


def _how_to_mend(name: str) -> str:
    """The commands, with the names that pip knows other distributions of this module by."""
    owners = importlib.metadata.packages_distributions().get(name, ())
    others = sorted({owner for owner in owners if owner and owner != "analytic_rasterizer"})
    first = f"`pip uninstall -y {' '.join(others)}` and then " if others else ""
    return f"to mend it, run {first}`pip install --force-reinstall --no-deps path/to/analytic_rasterizer`"


def problem_of(name: str) -> str | None:
    """What is wrong with one of the modules, in one sentence; None: it is ours."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a stand-in that somebody put into sys.modules
        return None
    if spec is None or spec.origin is None:  # a folder without __init__.py has no origin
        return (
            f"{name} is missing, probably because another distribution of that name was uninstalled: "
            f"{_how_to_mend(name)}"
        )
    try:
        is_ours = b"analytic_rasterizer" in Path(spec.origin).read_bytes()
    except OSError:  # not a file: in an archive, for example
        return None
    if is_ours:
        return None
    return f"{name} is not that of analytic_rasterizer but another at {spec.origin}: {_how_to_mend(name)}"


def warn_if_replaced() -> None:
    """Warns of every module that another distribution has replaced or removed. Takes a fraction of a millisecond."""
    for name in _NAMES:
        problem = problem_of(name)
        if problem is not None:
            warnings.warn(problem, stacklevel=3)
