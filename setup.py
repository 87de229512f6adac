"""Builds the C++ extension against the torch of the environment that pip installs into."""

import os
import sys
import sysconfig
from pathlib import Path

from setuptools import setup

# pip builds in an isolated environment that does not see the host's packages but keeps sys.prefix:
# the host's torch is found by adding its folder, for as long as setup.py runs.
try:
    import torch
except ImportError:
    sys.path += [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    try:
        import torch  # noqa: F401
    except ImportError:
        sys.exit(
            "analytic_rasterizer needs torch >= 2.4 to build and found none: install torch first, and if "
            "your installer hides it (uv, python -m build), use --no-build-isolation."
        )

from torch.utils.cpp_extension import BuildExtension, CppExtension

ROOT = Path(__file__).parent
SOURCES = sorted(str(p.relative_to(ROOT)) for d in ("cpu", "torch") for p in ROOT.glob(f"csrc/{d}/*.cpp"))

# No -std: torch sets the standard that its headers need. No contraction: forward and backward must
# round alike (csrc/core/lanes.h), and bits must not depend on the compiler's choices.
COMPILE_ARGS = ["-O3", "-fopenmp", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi"]


class Build(BuildExtension):
    """Builds on every core unless MAX_JOBS says otherwise."""

    def finalize_options(self):
        super().finalize_options()
        if self.editable_mode or self.inplace:
            # One place for objects, so that a rebuild compiles only what changed.
            self.build_temp = str(ROOT / "build" / f"temp-{sys.implementation.cache_tag}")

    def build_extensions(self):
        os.environ.setdefault("MAX_JOBS", str(os.cpu_count() or 1))
        super().build_extensions()


setup(
    ext_modules=[
        CppExtension(
            "analytic_rasterizer._C",
            SOURCES,
            include_dirs=[str(ROOT / "csrc")],
            extra_compile_args=COMPILE_ARGS,
            # libgomp by name only: the loader takes the copy that torch has already loaded.
            extra_link_args=["-fopenmp"],
        )
    ],
    cmdclass={"build_ext": Build},
)
