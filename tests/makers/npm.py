"""Programs of npm that tests compare with. `make test` and `make npm` install them where npm is."""

import os
import shutil

import pytest
from places import ROOT

MODULES = ROOT / "build" / "npm" / "node_modules"


def program(name):
    """The path of a program, in build/npm or the PATH; skips where there is none, or no node."""
    found = shutil.which(name, path=os.pathsep.join([str(MODULES / ".bin"), os.environ.get("PATH", "")]))
    if found is None or shutil.which("node") is None:
        pytest.skip(f"needs node, and npm's {name}: make npm")
    return found
