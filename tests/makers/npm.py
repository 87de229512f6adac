"""Programs of npm that tests compare with. `make test` and `make npm` install them where npm is."""

import os
import shutil
import subprocess

import pytest
from places import ROOT

MODULES = ROOT / "build" / "npm" / "node_modules"


def splat_transform():
    """convert(source, target, *options) -> target, by PlayCanvas' program; skips where it is missing, or node."""
    name = "splat-transform"
    program = shutil.which(name, path=os.pathsep.join([str(MODULES / ".bin"), os.environ.get("PATH", "")]))
    if program is None or shutil.which("node") is None:
        pytest.skip(f"needs node, and npm's {name}: make npm")

    def convert(source, target, *options):
        command = [program, "--quiet", "--overwrite", "--gpu", "cpu", *options, source, target]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return target

    return convert
