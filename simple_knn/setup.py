"""Builds the extension against the torch of the environment that pip installs into.

CUDA is built when torch was built with CUDA and a toolkit is found; no GPU need be visible.
ANALYTIC_RASTERIZER_CUDA=0 leaves it out, ANALYTIC_RASTERIZER_CUDA=1 or FORCE_CUDA=1 insists on it.
TORCH_CUDA_ARCH_LIST chooses the architectures; without it, those of the visible GPUs or, where there is
none, a list that covers what the toolkit supports.

Refuses to be installed where another distribution provides simple_knn.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent

# Answers with what Python sees where pip installs to: its path, and the file that provides simple_knn._C.
PROBE = """
import importlib.util, json, sys
try:
    found = importlib.util.find_spec("simple_knn._C")
    provider = found and found.origin
except ModuleNotFoundError:
    provider = None
except Exception as error:
    provider = f"simple_knn, which fails with {error!r}"
print("\\n" + json.dumps({"path": sys.path, "provider": provider}))
"""


def probe_environment() -> dict:
    """PROBE's answer. pip isolates a build by environment variables alone, which -E ignores."""
    # Not in the current folder, which Python would search first: there is a simple_knn in it.
    text = subprocess.check_output([sys.executable, "-E", "-c", PROBE], cwd=sys.prefix, text=True)
    return json.loads(text.splitlines()[-1])


ENVIRONMENT = probe_environment()

# In pip's isolated build torch is found where it will be used.
sys.path += [path for path in ENVIRONMENT["path"] if path not in sys.path]
try:
    import torch
    from torch.utils.cpp_extension import CUDA_HOME, BuildExtension, CppExtension, CUDAExtension
except ImportError:
    sys.exit(
        "analytic_simple_knn needs torch >= 2.4 to build and found none: install torch first, and if "
        "your installer hides it (uv, python -m build), use --no-build-isolation."
    )


def is_ours(provider: str) -> bool:
    """Whether the file is simple_knn/_C.py of this distribution, perhaps of another version."""
    path = Path(provider)
    return path.suffix == ".py" and "analytic_simple_knn" in path.read_text()


def wants_cuda() -> bool:
    choice = os.environ.get("ANALYTIC_RASTERIZER_CUDA", "")
    if choice not in ("", "0", "1"):
        sys.exit(f"ANALYTIC_RASTERIZER_CUDA must be 0 or 1, got {choice!r}")
    forced = choice == "1" or (choice == "" and os.environ.get("FORCE_CUDA") == "1")
    possible = torch.version.cuda is not None and CUDA_HOME is not None
    if forced and not possible:
        missing = "torch built with CUDA" if torch.version.cuda is None else "toolkit (CUDA_HOME)"
        sys.exit(f"analytic_simple_knn was told to build CUDA but found no {missing}")
    return forced or (possible and choice != "0")


def default_architectures() -> str:
    """Machine code for what this toolkit's users have, and PTX for what comes after. By nvcc's version, not torch's."""
    text = subprocess.check_output([str(Path(CUDA_HOME) / "bin" / "nvcc"), "--version"], text=True)
    version = tuple(int(v) for v in re.search(r"release (\d+)\.(\d+)", text).groups())
    known = ["7.5", "8.0", "8.6"]
    known += ["8.9", "9.0"] if version >= (11, 8) else []
    known += ["10.0", "12.0"] if version >= (12, 8) else []
    return ";".join(known) + "+PTX"


WITH_CUDA = wants_cuda()
if WITH_CUDA and not torch.cuda.is_available():
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", default_architectures())

SOURCES = ["csrc/binding.cpp", "csrc/cpu.cpp"]
SOURCES += ["csrc/cuda.cu"] if WITH_CUDA else []

# No contraction of a product and a sum into one operation:
# both devices must round alike. Nothing but the module's entry is visible from outside.
COMPILE_ARGS = ["-O3", "-g0", "-fopenmp", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
COMPILE_ARGS += ["-fvisibility=hidden", "-fvisibility-inlines-hidden"]
# libgomp by name only: the loader takes the copy that torch has already loaded.
LINK_ARGS = ["-fopenmp", "-Wl,--strip-all"]
NVCC_ARGS = ["-O3", "--fmad=false", "--expt-relaxed-constexpr", "-Xfatbin", "-compress-all"]
NVCC_ARGS += ["-Xcompiler", "-fno-gnu-unique,-fvisibility=hidden"]


class BuildPython(build_py):
    """A part of every installation, but not of `build_ext --inplace`, which installs nothing."""

    def run(self):
        provider = ENVIRONMENT["provider"]
        if provider is not None and not is_ours(provider):
            sys.exit(
                f"analytic_simple_knn provides simple_knn, which this environment already has ({provider}): keep "
                "that one, or uninstall it first (pip uninstall simple_knn)."
            )
        super().run()


class BuildExtensions(BuildExtension):
    """Builds on every core unless MAX_JOBS says otherwise."""

    def build_extensions(self):
        os.environ.setdefault("MAX_JOBS", str(os.cpu_count() or 1))
        super().build_extensions()


setup(
    ext_modules=[
        (CUDAExtension if WITH_CUDA else CppExtension)(
            "analytic_simple_knn._C",
            SOURCES,
            include_dirs=[str(ROOT / "csrc")],
            define_macros=[
                ("SIMPLE_KNN_TORCH", torch.__version__),
                *([("SIMPLE_KNN_WITH_CUDA", None)] if WITH_CUDA else []),
            ],
            extra_compile_args={"cxx": COMPILE_ARGS, "nvcc": NVCC_ARGS},
            extra_link_args=LINK_ARGS,
        )
    ],
    cmdclass={"build_ext": BuildExtensions, "build_py": BuildPython},
)
