"""Builds the extension against the torch of the environment that pip installs into.

CUDA is built when torch was built with CUDA and a toolkit is found; no GPU need be visible.
ANALYTIC_RASTERIZER_CUDA=0 leaves it out, ANALYTIC_RASTERIZER_CUDA=1 or FORCE_CUDA=1 insists on it.
TORCH_CUDA_ARCH_LIST chooses the architectures; without it, those of the visible GPUs or, where there is
none, a list that covers what the toolkit supports.
ANALYTIC_RASTERIZER_SANITIZE=1 builds the CPU path under AddressSanitizer and UndefinedBehaviorSanitizer, for
`make test-python-sanitized`: Python must be started with the sanitizer's library preloaded.
"""

import contextlib
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from setuptools import setup

# pip builds in an isolated environment that does not see the host's packages but keeps sys.prefix:
# the host's torch is found by adding its folder, for as long as setup.py runs.
try:
    import torch
except ImportError:
    sys.path += [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    try:
        import torch
    except ImportError:
        sys.exit(
            "analytic_rasterizer needs torch >= 2.4 to build and found none: install torch first, and if "
            "your installer hides it (uv, python -m build), use --no-build-isolation."
        )

from torch.utils.cpp_extension import CUDA_HOME, BuildExtension, CppExtension, CUDAExtension

ROOT = Path(__file__).parent


def description_and_links() -> tuple[str, dict[str, str]]:
    """README and the addresses of the project, by the variable `repository` of pyproject.toml.

    Links of README to files of the repository become links to the address, or text where there is no address.
    """
    address = re.search(r'^repository = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.M)[1].rstrip("/")

    def replaced(link: re.Match) -> str:
        image, text, file = link.groups()
        if not address:
            return text
        return f"{image}[{text}]({address}/{'raw' if image else 'blob'}/main/{file})"

    readme = re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]+)\)", replaced, (ROOT / "README.md").read_text())
    names = {"Repository": "", "Issues": "/issues", "Changelog": "/blob/main/CHANGELOG.md"}
    return readme, {name: address + path for name, path in names.items() if address}


def torch_requirement() -> str:
    """An extension fits the minor version of torch that it is built with. Sources can be built with many."""
    if "sdist" in sys.argv:
        return "torch>=2.4"
    return f"torch=={'.'.join(torch.__version__.split('.')[:2])}.*"


def wants_cuda() -> bool:
    choice = os.environ.get("ANALYTIC_RASTERIZER_CUDA", "")
    if choice not in ("", "0", "1"):
        sys.exit(f"ANALYTIC_RASTERIZER_CUDA must be 0 or 1, got {choice!r}")
    forced = choice == "1" or (choice == "" and os.environ.get("FORCE_CUDA") == "1")
    possible = torch.version.cuda is not None and CUDA_HOME is not None
    if forced and not possible:
        missing = "torch built with CUDA" if torch.version.cuda is None else "toolkit (CUDA_HOME)"
        sys.exit(f"analytic_rasterizer was told to build CUDA but found no {missing}")
    return forced or (possible and choice != "0")


def default_architectures() -> str:
    """Machine code for what this toolkit's users have, and PTX for what comes after. By nvcc's version, not torch's.

    Devices of 8.6 and 8.9 run the code of 8.0.
    """
    text = subprocess.check_output([str(Path(CUDA_HOME) / "bin" / "nvcc"), "--version"], text=True)
    version = tuple(int(v) for v in re.search(r"release (\d+)\.(\d+)", text).groups())
    known = ["7.5", "8.0"]
    known += ["9.0"] if version >= (11, 8) else []
    known += ["10.0", "12.0"] if version >= (12, 8) else []
    return ";".join(known) + "+PTX"


WITH_CUDA = wants_cuda()
if WITH_CUDA and not torch.cuda.is_available():
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", default_architectures())

SOURCES = [str(p.relative_to(ROOT)) for d in ("cpu", "torch") for p in sorted(ROOT.glob(f"csrc/{d}/*.cpp"))]
if WITH_CUDA:
    # Those that take longest begin first, so that no core waits for them at the end.
    slow = ["moment/blend_vjp", "moment/blend", "still/blend", "still/blend_vjp", "forward", "backward"]
    kernels = {str(p.relative_to(ROOT)) for p in ROOT.glob("csrc/cuda/**/*.cu")}
    first = [f"csrc/cuda/{name}.cu" for name in slow]
    SOURCES = [*first, *SOURCES, *sorted(kernels - set(first))]
else:
    SOURCES = [source for source in SOURCES if not source.endswith("_cuda.cpp")]


def in_units(sources: list[str], folder: Path) -> list[str]:
    """The sources, those of csrc/torch replaced by a file in `folder` that includes them.

    Torch's headers take longer to read than these files to compile. What needs CUDA's headers is compiled by itself.
    """
    of_torch = [source for source in sources if re.fullmatch(r"csrc/torch/.*(?<!_cuda)\.cpp", source)]
    text = "".join(f'#include "{Path(source).relative_to("csrc")}"\n' for source in of_torch)
    path = folder / "torch.cpp"
    if not path.exists() or path.read_text() != text:  # a new file would be compiled again
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return [os.path.relpath(path, ROOT), *(source for source in sources if source not in of_torch)]


# No -std: torch sets the standard that its headers need. No contraction: forward and backward must
# round alike (csrc/core/lanes.h), and bits must not depend on the compiler's choices. Nothing that only a debugger
# reads is installed; nothing but the module's entry is visible from outside.
COMPILE_ARGS = ["-O3", "-g0", "-pthread", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi"]
COMPILE_ARGS += ["-fvisibility=hidden", "-fvisibility-inlines-hidden"]
LINK_ARGS = ["-pthread", "-Wl,--strip-all"]
if os.environ.get("ANALYTIC_RASTERIZER_SANITIZE") == "1":
    # Checks as calls: see CMakeLists.txt. No vptr: it wants the type information of torch's hidden classes.
    SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize=vptr", "-fno-sanitize-recover=all"]
    COMPILE_ARGS += ["-O1", "-g1", *SANITIZERS, "--param", "asan-instrumentation-with-call-threshold=0"]
    LINK_ARGS = ["-pthread", *SANITIZERS]
NVCC_ARGS = ["-O3", "--fmad=false", "--expt-relaxed-constexpr", "-Xfatbin", "-compress-all"]
NVCC_ARGS += ["-Xcompiler", "-fno-gnu-unique,-fvisibility=hidden"]


def succeeds(command: list[str]) -> bool:
    try:
        return subprocess.run(command, capture_output=True).returncode == 0
    except OSError:  # There is no such program.
        return False


def openmp_flags() -> tuple[list[str], list[str]]:
    """What the compiler and the linker are told for the threads of the CPU path. Says so if there is no OpenMP."""
    # The copy that torch brings, where it does: it is there wherever the extension is, and threads are shared.
    of_torch = sorted((Path(torch.__file__).parent / "lib").glob("libgomp*.so*"))
    name = os.environ.get("CXX", "c++")
    with tempfile.TemporaryDirectory() as folder:
        source, made = f"{folder}/openmp.cpp", f"{folder}/openmp.o"
        Path(source).write_text("int main() {\n#pragma omp parallel\n  {}\n}\n")
        for library in ([str(of_torch[0])] if of_torch else [], ["-fopenmp"]):
            commands = [["-fopenmp", "-c", source, "-o", made], [made, *library, "-o", f"{folder}/openmp"]]
            if all(succeeds([*shlex.split(name), *command]) for command in commands):
                return ["-fopenmp"], library
    print(
        f"analytic_rasterizer: {name} has no OpenMP, so the CPU path will run on one thread. Set CXX to one with "
        "OpenMP: g++, or clang++ with libomp.",
        file=sys.stderr,
    )
    return [], []


@contextlib.contextmanager
def short_progress() -> Iterator[None]:
    """Of the commands that ninja prints, to this process's output, only "[3/14] csrc/cpu/kernels_avx2.cpp" is left."""
    sys.stdout.flush()
    output, (reader, writer) = os.dup(1), os.pipe()
    os.dup2(writer, 1)
    os.close(writer)

    def pass_on() -> None:
        with open(reader, errors="replace") as lines:
            for line in lines:
                done = re.match(r"(\[\d+/\d+\]) .* -c (\S+) -o ", line)
                short = f"{done[1]} {os.path.relpath(done[2], ROOT)}\n" if done else line
                os.write(output, short.encode(errors="replace"))

    thread = threading.Thread(target=pass_on)
    thread.start()
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(output, 1)  # The last end of the pipe: the thread has read all.
        thread.join()
        os.close(output)


class Build(BuildExtension):
    """Builds on every core unless MAX_JOBS says otherwise, and the files of csrc/torch together."""

    def finalize_options(self):
        super().finalize_options()
        if self.editable_mode or self.inplace:
            # One place for objects, so that a rebuild compiles only what changed.
            self.build_temp = str(ROOT / "build" / f"temp-{sys.implementation.cache_tag}")

    def build_extensions(self):
        os.environ.setdefault("MAX_JOBS", str(os.cpu_count() or 1))
        compile_args, link_args = openmp_flags()
        for extension in self.extensions:
            extension.extra_compile_args["cxx"] += compile_args
            extension.extra_link_args += link_args
            extension.depends += extension.sources  # a change of any is looked at, without ninja too
            extension.sources = in_units(extension.sources, Path(self.build_temp) / "units")
        with short_progress():
            super().build_extensions()


README, LINKS = description_and_links()

setup(
    install_requires=[torch_requirement(), "numpy"],
    long_description=README,
    long_description_content_type="text/markdown",
    project_urls=LINKS,
    ext_modules=[
        (CUDAExtension if WITH_CUDA else CppExtension)(
            "analytic_rasterizer._C",
            SOURCES,
            include_dirs=[str(ROOT / "csrc")],
            define_macros=[("AR_TORCH", torch.__version__), *([("AR_WITH_CUDA", None)] if WITH_CUDA else [])],
            extra_compile_args={"cxx": COMPILE_ARGS, "nvcc": NVCC_ARGS},
            extra_link_args=LINK_ARGS,
        )
    ],
    cmdclass={"build_ext": Build},
)
