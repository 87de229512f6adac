"""Other repositories' own render functions, unmodified, on our modules: where ../shared has them beside the project.

Each runs in a process of its own and takes up to twenty steps of its optimiser, so that the file takes a few minutes of
one core. They are told their dialect by the environment, as their users tell it.
"""

import importlib.util
import json
import os

import pytest
from conftest import ROOT, SHARED, needs_cuda, python_path
from processes import DEADLINE, run_program

RUNNER, CONTRACT = SHARED / "compat" / "run.py", SHARED / "compat" / "contract.py"
CHECKS = 22  # of contract.py

pytestmark = pytest.mark.skipif(not RUNNER.exists(), reason="needs the optional ../shared/compat next to the project")

# The dialects that settings and arguments cannot tell; all others are inferred.
CHOSEN = {
    "3dgs-2024-accel": "accel",
    "analytic-splatting --dense": "analytic",
    "dreamgaussian": "depth_alpha",
    "4dgaussians": "depth",
    "scaffold-gs": "scaffold",
    "3dgs-mcmc": "mcmc",
}


def cases():
    """Names of the runner's cases whose repository is there."""
    if not RUNNER.exists():
        return []
    spec = importlib.util.spec_from_file_location("compat_run", RUNNER)
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    return [name for name, case in runner.CASES.items() if (runner.REPOS / case[1]).is_dir()]


def run(device, program, *arguments, dialect=""):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("ANALYTIC_RASTERIZER_")}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1", "ANALYTIC_RASTERIZER_DIALECT": dialect}
    environment["PYTHONPATH"] = python_path()
    return run_program(program, *arguments, "--device", device, environment=environment, timeout=2 * DEADLINE)


each_device = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_cuda)])


@each_device
@pytest.mark.parametrize("name", cases())
def test_repository(device, name):
    if name == "4dgaussians":
        pytest.importorskip("tkinter", reason="4DGaussians imports tkinter, which this Python lacks")
    done = run(device, RUNNER, name, "--one", dialect=CHOSEN.get(name, ""))
    found = [line.removeprefix("@@@") for line in done.stdout.splitlines() if line.startswith("@@@")]
    assert found, done.stderr[-2000:]
    report = json.loads(found[-1])
    assert report["result"] == "pass", (report["stages"], report.get("error"), report.get("at"))
    assert report["module"] is None or report["module"].startswith(str(ROOT)) or "site-packages" in report["module"]


@each_device
def test_contract(device):
    done = run(device, CONTRACT)
    lines = done.stdout.splitlines()
    assert len(lines) == CHECKS, done.stderr[-2000:]
    assert [line for line in lines if not line.endswith(" ok")] == []
