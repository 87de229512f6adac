"""Which wheel fits a torch, and what can be wrong with an installation, in sentences that say how to mend it.

The compiled extension may be missing, or may have been built for another torch. And another distribution may have
replaced our module diff_gaussian_rasterization with its own.
"""

from __future__ import annotations

import importlib.machinery
import importlib.metadata
import importlib.util
import platform
import re
import sys
import warnings
from pathlib import Path

import torch

_INSTALL_AGAIN = "`pip install --force-reinstall --no-deps path/to/analytic_rasterizer`"
_BUILT_FOR = "analytic_rasterizer was built for torch "  # with the version behind it, in the file of the extension


def wheel_folder(torch_version: str, cuda: str | None) -> str:
    """The folder of the wheels for a torch, by its minor version and that of CUDA: pt213cpu, pt211cu130.

    Args:
        torch_version: As in `torch.__version__`, such as 2.13.0+cpu.
        cuda: As in `torch.version.cuda`, such as 13.0; None for a torch or a build without CUDA.
    """
    major, minor = torch_version.split(".")[:2]
    return f"pt{major}{minor}" + (f"cu{cuda.replace('.', '')}" if cuda else "cpu")


def _way_out() -> str:
    fitting = wheel_folder(torch.__version__, torch.version.cuda)
    return f"install the wheel of {fitting} (docs/install.md), or build it for this torch, {_INSTALL_AGAIN}"


def about(version: str, built_for: str, has_cuda: bool, has_openmp: bool) -> str:
    """Lines that say what is installed, and which wheels fit the torch that is there.

    Args:
        version: Of this package.
        built_for: What the extension says, `_C.BUILT_FOR`.
        has_cuda: Whether the extension has the CUDA path, `_C.has_cuda`.
        has_openmp: Whether its CPU path has threads, `_C.has_openmp`.
    """
    cpu = "the CPU" if has_openmp else "one thread of the CPU (its compiler had no OpenMP)"
    devices = f"{cpu} and CUDA" if has_cuda else cpu
    cuda = f"CUDA {torch.version.cuda}" if torch.version.cuda else "no CUDA"
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU is visible"
    fitting = wheel_folder(torch.__version__, torch.version.cuda)
    return "\n".join(
        (
            f"analytic_rasterizer {version}, built for torch {built_for.removeprefix(_BUILT_FOR)}, for {devices}",
            f"torch {torch.__version__} with {cuda}, Python {platform.python_version()}, {device}",
            "the wheels that fit this torch, where INDEX is the folder or the address of the wheels:",
            f"    pip install --index-url INDEX/{fitting} analytic-rasterizer",
        )
    )


def _extensions_in(folder: Path) -> tuple[list[Path], list[Path]]:
    """The files of the compiled extension that this Python can load, and those of other versions of Python."""
    names = {"_C" + suffix for suffix in importlib.machinery.EXTENSION_SUFFIXES}
    files = sorted([*folder.glob("_C.*so"), *folder.glob("_C.*pyd")])
    return [f for f in files if f.name in names], [f for f in files if f.name not in names]


def why_not_loaded(error: ImportError) -> str:
    """Why the extension could not be imported, which raised `error`."""
    folder = Path(__file__).resolve().parent
    files, others = _extensions_in(folder)
    if not files:
        return _without_extension(folder, others)
    found = re.search(_BUILT_FOR.encode() + rb"([^\0]+)", files[0].read_bytes())
    if found is None or found[1].decode() == torch.__version__:  # of an earlier version, or damaged
        return (
            f"{files[0]} cannot be loaded with torch {torch.__version__} ({error}): install it again, {_INSTALL_AGAIN}"
        )
    return (
        f"analytic_rasterizer was built for torch {found[1].decode()} and cannot be loaded with torch "
        f"{torch.__version__}, which is installed now ({error}): {_way_out()}"
    )


def _without_extension(folder: Path, others: list[Path]) -> str:
    places = [Path(path).resolve() / folder.name for path in sys.path]
    installed = next((place for place in places if place != folder and _extensions_in(place)[0]), None)
    because = ", as a clone that was not built in place"
    if others:
        because = f" for Python {platform.python_version()}, only {others[0].name}"
    if installed is not None:
        way_out = f"start Python in another folder than {folder.parent}, so that the one in {installed.parent} is found"
    else:
        way_out = f"build it there, `pip install -e {folder.parent}`, or install it and start Python in another folder"
    return f"analytic_rasterizer was imported from {folder}, which has no compiled extension{because}: {way_out}"


def warn_if_built_for_another(built_for: str) -> None:
    """Warns where the extension could be loaded, but with another torch than it was built for, which may crash later.

    Args:
        built_for: What the extension says, `_C.BUILT_FOR`.
    """
    built, there = (version.split(".")[:2] for version in (built_for.removeprefix(_BUILT_FOR), torch.__version__))
    if built != there:
        warnings.warn(
            f"{built_for}, and torch {torch.__version__} is installed, so that calls may crash: {_way_out()}",
            stacklevel=3,
        )


_NAMES = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_ms")


def _how_to_mend(name: str) -> str:
    """The commands, with the names that pip knows other distributions of this module by."""
    owners = importlib.metadata.packages_distributions().get(name, ())
    others = sorted({owner for owner in owners if owner and owner != "analytic_rasterizer"})
    first = f"`pip uninstall -y {' '.join(others)}` and then " if others else ""
    return f"to mend it, run {first}{_INSTALL_AGAIN}"


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
