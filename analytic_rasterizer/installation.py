"""Whether `import diff_gaussian_rasterization` runs our module: other distributions install one of the same name."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

_NAMES = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_ms")
_MEND = (
    "to mend it, uninstall the other distribution and then install analytic_rasterizer again with "
    "--force-reinstall --no-deps"
)


def problem_of(name: str) -> str | None:
    """What is wrong with one of the modules, in one sentence; None: it is ours."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a stand-in that somebody put into sys.modules
        return None
    if spec is None or spec.origin is None:  # a folder without __init__.py has no origin
        return f"{name} is missing, probably because another distribution of that name was uninstalled: {_MEND}"
    try:
        is_ours = b"analytic_rasterizer" in Path(spec.origin).read_bytes()
    except OSError:  # not a file: in an archive, for example
        return None
    if is_ours:
        return None
    return f"{name} is not that of analytic_rasterizer but {spec.origin}, of another distribution: {_MEND}"


def warn_if_replaced() -> None:
    """Warns of every module that another distribution has replaced or removed. Takes a fraction of a millisecond."""
    for name in _NAMES:
        problem = problem_of(name)
        if problem is not None:
            warnings.warn(problem, stacklevel=3)
