"""examples/ci: the tests of a repository that asks for CUDA pass on the CPU, under pytest and under ctest."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT
from processes import python_path

EXAMPLE = ROOT / "examples" / "ci"
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}


def run(*command, **environment):
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": python_path()} | environment
    return subprocess.run(list(map(str, command)), cwd=EXAMPLE, env=environment, capture_output=True, text=True)


def test_the_repository_asks_for_cuda():
    """The example shows nothing if its code was written for the CPU."""
    code = "".join(path.read_text() for path in (EXAMPLE / "repository").glob("*.py"))
    assert len(re.findall(r'\.cuda\(\)|device="cuda"', code)) > 10
    assert "cpu" not in code.lower()


def test_under_pytest():
    done = run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist")
    assert re.search(r"^4 passed in", done.stdout, re.M), done.stdout[-3000:] + done.stderr[-1000:]


def test_under_ctest(tmp_path):
    """Beside the tests of the CPU path, which are configured here, and built and run by `make test-cpp`."""
    cmake = shutil.which("cmake") or shutil.which("cmake", path=str(Path(sys.executable).parent))
    if cmake is None:
        pytest.skip("needs cmake")
    configured = run(
        cmake, "-S", ".", "-B", tmp_path, f"-DANALYTIC_RASTERIZER={ROOT}", f"-DPython3_EXECUTABLE={sys.executable}"
    )
    if "GoogleTest was not found" in configured.stderr:
        pytest.skip("needs GoogleTest")
    assert configured.returncode == 0, configured.stderr[-3000:]
    ctest = Path(cmake).with_name("ctest")
    listed = run(ctest, "--test-dir", tmp_path, "-N").stdout
    for name in ("repository", "core_tests_NOT_BUILT", "fuzz_core"):
        assert name in listed
    done = run(ctest, "--test-dir", tmp_path, "-R", "^repository$", "--output-on-failure")
    assert "100% tests passed, 0 tests failed out of 1" in done.stdout, done.stdout[-3000:]
