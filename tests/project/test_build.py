"""The binding of the CUDA kernels to torch compiles, also where torch has no CUDA and there is no GPU."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from places import ROOT
from torch.utils import cpp_extension

NVCC = shutil.which("nvcc") or shutil.which("nvcc", path="/usr/local/cuda/bin")
SOURCES = sorted((ROOT / "csrc" / "torch").glob("*cuda*.cpp"))


def test_there_are_cuda_ops():
    assert SOURCES


def test_the_cuda_ops_compile(tmp_path):
    """Together: torch's headers take longer to read than they do."""
    if NVCC is None:
        pytest.skip("needs nvcc")
    source = tmp_path / "sources.cpp"
    source.write_text("".join(f'#include "{path}"\n' for path in SOURCES))
    # A CPU build of torch ships its CUDA headers without the one that its CUDA build generates.
    generated = tmp_path / "include" / "c10" / "cuda" / "impl" / "cuda_cmake_macros.h"
    generated.parent.mkdir(parents=True)
    generated.touch()
    include = [str(ROOT / "csrc"), *cpp_extension.include_paths(), str(tmp_path / "include")]
    include = [path for path in include if Path(path).is_dir()]
    # No code is made of it: what it says is all that is asked.
    command = [NVCC, "-std=c++20", "-Xcompiler", "-fsyntax-only", "-c", str(source), "-o", str(tmp_path / "unused.o")]
    command += [f"-I{path}" for path in include]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def kernels_of(folder):
    """(name without "_kernel", body) of every kernel in a folder of csrc/cuda, and in the folders below it."""
    texts = [path.read_text() for path in sorted((ROOT / "csrc" / "cuda" / folder).rglob("*.cu*"))]
    kernels = [kernel for text in texts for kernel in re.split(r"\b__global__\b", text)[1:]]
    return [(re.search(r"\b(\w+)_kernel\(", kernel)[1], kernel[kernel.index("{") + 1 :]) for kernel in kernels]


def test_kernels_begin_by_waiting():
    """They are launched before those ahead of them have ended (csrc/cuda/launch.cuh). One works beside those that let
    it begin, the first of which must have waited before."""
    begins = {}
    kernels = kernels_of("")
    for name, body in kernels:
        lines = re.sub(r" *//.*", "", body).split("\n")
        begins[name] = [line.strip() for line in lines if line.strip()][:2]
    assert len(begins) == len(kernels) > 30
    wait, let_begin = "wait_for_earlier_kernels();", "let_next_kernel_begin();"
    assert begins.pop("filter") == [wait, let_begin]
    assert begins.pop("listed_blend") == [let_begin, wait]
    assert begins.pop("moving_blend")[0] == "if (begin_beside_earlier_kernels(beside)) return;"
    assert [name for name, lines in begins.items() if lines[0] != wait or let_begin in lines] == []


def test_the_table_of_dispatch_names_the_kernels_of_the_four_families():
    """Route::forward and Route::backward of csrc/cuda/dispatch.h; tests/cpp/cuda_on_host/dispatch_test.cpp tests the
    rest of the table."""
    table = (ROOT / "csrc" / "cuda" / "dispatch.h").read_text()
    named = re.findall(r'"(\w+)_kernel"', table)
    assert len(named) > 10
    assert set(named) == {name for family in ("still", "moment", "channels", "rays") for name, _ in kernels_of(family)}
