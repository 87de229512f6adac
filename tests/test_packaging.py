"""What a distribution holds beside the modules."""

import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Without setup.py, which builds the extension: what is packed is said in pyproject.toml and MANIFEST.in.
COMMANDS = "from setuptools import setup; setup()"


def test_wheel_and_sdist_hold_what_modules_read_and_say_that_they_are_annotated(tmp_path):
    wheel, info = tmp_path / "wheel", tmp_path / "info"
    info.mkdir()
    arguments = ["-q", "build_py", "--build-lib", str(wheel), "egg_info", "--egg-base", str(info)]
    done = subprocess.run([sys.executable, "-c", COMMANDS, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    (sources,) = info.rglob("SOURCES.txt")
    packed = set(sources.read_text().splitlines())
    for module in (ROOT / "analytic_rasterizer").rglob("*.py"):
        name = module.relative_to(ROOT)
        assert (wheel / name).is_file(), f"{name}: its folder must be among the packages of pyproject.toml"
    pages = (ROOT / "analytic_rasterizer" / "viewer" / "page").glob("*.*")
    for name in ("analytic_rasterizer/py.typed", *(str(page.relative_to(ROOT)) for page in pages)):
        assert (wheel / name).is_file(), name
        assert name in packed
