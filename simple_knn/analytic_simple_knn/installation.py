"""Why the compiled module cannot be imported, in a sentence that says how to mend it."""

import importlib.machinery
import pathlib
import re

import torch

_INSTALL_AGAIN = "`pip install --force-reinstall --no-deps path/to/analytic_rasterizer/simple_knn`"


def why_not_loaded(error: ImportError) -> str:
    """Of the import that raised `error`."""
    folder = pathlib.Path(__file__).resolve().parent
    files = [folder / ("_C" + suffix) for suffix in importlib.machinery.EXTENSION_SUFFIXES]
    files = [file for file in files if file.exists()]
    if not files:
        others = [file.name for file in sorted(folder.glob("_C.*"))]
        because = (
            f" for this version of Python, only {others[0]}" if others else ", as a clone that was not built in place"
        )
        return (
            f"analytic_simple_knn was imported from {folder}, which has no compiled module{because}: start Python in "
            f"another folder than {folder.parent}, after {_INSTALL_AGAIN}"
        )
    found = re.search(rb"analytic_simple_knn was built for torch ([^\0]+)", files[0].read_bytes())
    built_for = f"was built for torch {found[1].decode()} and " if found else ""
    return (
        f"analytic_simple_knn {built_for}cannot be loaded with torch {torch.__version__} ({error}): install it again, "
        f"{_INSTALL_AGAIN}"
    )
