"""The binding of the CUDA kernels to torch compiles, also where torch has no CUDA and there is no GPU; and kernels wait
for those before them."""

import pathlib
import re
import shutil
import subprocess

import pytest
from torch.utils import cpp_extension

ROOT = pathlib.Path(__file__).resolve().parent.parent
NVCC = shutil.which("nvcc") or shutil.which("nvcc", path="/usr/local/cuda/bin")


SOURCES = sorted((ROOT / "csrc" / "torch").glob("*cuda*.cpp"))
KERNELS = sorted((ROOT / "csrc" / "cuda").glob("*.cu*"))


def test_there_are_cuda_ops():
    assert SOURCES


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_the_cuda_ops_compile(tmp_path, source):
    if NVCC is None:
        pytest.skip("needs nvcc")
    # A CPU build of torch ships its CUDA headers without the one that its CUDA build generates.
    generated = tmp_path / "include" / "c10" / "cuda" / "impl" / "cuda_cmake_macros.h"
    generated.parent.mkdir(parents=True)
    generated.touch()
    include = [str(ROOT / "csrc"), *cpp_extension.include_paths(), str(tmp_path / "include")]
    include = [path for path in include if pathlib.Path(path).is_dir()]
    # No code is made of it: what it says is all that is asked.
    command = [NVCC, "-std=c++20", "-Xcompiler", "-fsyntax-only", "-c", str(source), "-o", str(tmp_path / "unused.o")]
    command += [f"-I{path}" for path in include]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def test_there_are_kernels():
    assert sum(source.read_text().count("__global__") for source in KERNELS) > 40


@pytest.mark.parametrize("source", KERNELS, ids=lambda source: source.name)
def test_kernels_wait_for_those_before(source):
    """launch() puts a kernel on the device while the one before it runs. One that touched memory before it waits would
    race with those before it; and so would the kernels behind one that does not wait at all.
    """
    code = re.sub(r"//.*", "", source.read_text())
    assert "<<<" not in code, "kernels are launched by launch()"
    for kernel in code.split("__global__")[1:]:
        assert re.match(r"[^{;]*\{\s*begin_kernel\(\);", kernel), "must begin with begin_kernel(): " + kernel[:200]
