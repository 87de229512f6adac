"""What a distribution says of itself, and what it holds beside the modules."""

import configparser
import email
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest
import torch
from places import ROOT

import analytic_rasterizer as ar

MINOR = ".".join(torch.__version__.split(".")[:2])


def setup(folder, *arguments):
    """Commands of setup.py that compile nothing."""
    environment = os.environ | {"ANALYTIC_RASTERIZER_CUDA": "0"}
    command = [sys.executable, "setup.py", "-q", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def metadata_of(folder, info, *arguments):
    info.mkdir()
    setup(folder, "egg_info", "--egg-base", info, *arguments)
    (path,) = info.rglob("PKG-INFO")
    return email.message_from_string(path.read_text())


def test_wheel_and_sdist_hold_what_modules_read_and_say_that_they_are_annotated(tmp_path):
    wheel, info = tmp_path / "wheel", tmp_path / "info"
    metadata = metadata_of(ROOT, info, "build_py", "--build-lib", wheel)
    (sources,) = info.rglob("SOURCES.txt")
    packed = set(sources.read_text().splitlines())
    for module in (ROOT / "analytic_rasterizer").rglob("*.py"):
        name = module.relative_to(ROOT)
        assert (wheel / name).is_file(), f"{name}: its folder must be among the packages of pyproject.toml"
    pages = (ROOT / "analytic_rasterizer" / "viewer" / "page").glob("*.*")
    for name in ("analytic_rasterizer/py.typed", *(str(page.relative_to(ROOT)) for page in pages)):
        assert (wheel / name).is_file(), name
        assert name in packed
    # What builds and tests an unpacked sdist.
    for pattern in ("csrc/**/*.*", "tests/**/*.*", "docs/**/*.md", "simple_knn/**/*.py", "examples/**/*.*", "*.md"):
        for path in ROOT.glob(pattern):
            made = {"build", "__pycache__", ".pytest_cache"} & set(path.relative_to(ROOT).parts)
            if path.is_file() and path.suffix != ".so" and not made:
                assert str(path.relative_to(ROOT)) in packed
    assert {"Makefile", "CMakeLists.txt", "CITATION.cff", "mkdocs.yml"} <= packed
    assert not [name for name in packed if name.endswith((".so", ".pyc"))]
    check_metadata(metadata)
    (points,) = info.rglob("entry_points.txt")
    found = {point.group: point for point in entry_points(points.read_text())}
    method = found["nerfstudio.method_configs"]
    assert method.name == "splatfacto-analytic" and (ROOT / f"{method.module.replace('.', '/')}.py").is_file()
    assert set(found) == {"console_scripts", method.group}
    assert "nerfstudio" not in str(metadata.get_all("Requires-Dist"))


def entry_points(text):
    """Those of a file entry_points.txt."""
    parser = configparser.ConfigParser(delimiters="=")
    parser.optionxform = str
    parser.read_string(text)
    return [EntryPoint(name, value, group) for group in parser.sections() for name, value in parser[group].items()]


def check_metadata(metadata):
    assert metadata["Version"] == ar.__version__
    required = [text for text in metadata.get_all("Requires-Dist") if "extra" not in text]
    assert required == [f"torch=={MINOR}.*", "numpy"], "an installed extension fits one minor version of torch"
    assert metadata.get_all("Project-URL") is None
    assert "](docs/" not in metadata.get_payload(), "a link to a file that a package page does not have"
    assert "docs/install.md" in metadata.get_payload()


def test_an_sdist_can_be_built_with_many_versions_of_torch(tmp_path):
    metadata = metadata_of(ROOT, tmp_path / "info", "sdist", "--dist-dir", tmp_path)
    assert "torch>=2.4" in metadata.get_all("Requires-Dist")
    assert (tmp_path / f"analytic_rasterizer-{ar.__version__}.tar.gz").is_file()


def test_one_variable_gives_the_addresses(tmp_path):
    clone = tmp_path / "clone"
    clone.mkdir()
    for name in ("setup.py", "README.md", "pyproject.toml", "LICENSE"):
        shutil.copy(ROOT / name, clone)
    for package in re.findall(r'^    "(\w+(?:\.\w+)*)",$', (ROOT / "pyproject.toml").read_text(), re.M):
        (clone / package.replace(".", "/")).mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / "analytic_rasterizer" / "__init__.py", clone / "analytic_rasterizer")
    text = (clone / "pyproject.toml").read_text()
    assert text.count('repository = ""') == 1
    (clone / "pyproject.toml").write_text(text.replace('repository = ""', 'repository = "https://example.org/a/b/"'))
    metadata = metadata_of(clone, tmp_path / "info")
    assert set(metadata.get_all("Project-URL")) == {
        "Repository, https://example.org/a/b",
        "Issues, https://example.org/a/b/issues",
        "Changelog, https://example.org/a/b/blob/main/CHANGELOG.md",
    }
    description = metadata.get_payload()
    assert "[docs/install.md](https://example.org/a/b/blob/main/docs/install.md)" in description
    assert "](https://example.org/a/b/raw/main/docs/images/moving.png)" in description
    assert not re.search(r"\]\((?!https://|#)", description)


def test_the_version_is_the_same_everywhere():
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == ar.__version__
    released = [version for version in changelog() if version != "Unreleased"]
    assert released[0] == ar.__version__


def changelog():
    """The lines of each version."""
    _, *parts = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.M)
    return {part.split("\n")[0]: part.strip().split("\n") for part in parts}


@pytest.mark.parametrize("version", changelog())
def test_a_version_of_the_changelog_is_short(version):
    assert len(changelog()[version]) <= 40


BUILDING = """
import os, runpy, subprocess, sys, setuptools
setuptools.setup = lambda **_: None
setup = runpy.run_path("setup.py")
print("before", flush=True)
with setup["short_progress"]():
    print("[1/2] ccache c++ -MMD -c -c", os.path.abspath("csrc/cpu/sort.cpp"), "-o sort.o -O3")
    print("sort.cpp:3: warning")
    subprocess.run([sys.executable, "-c", "print('[2/2] c++ -c csrc/cpu/ssim.cpp -o ssim.o')"])
print("after", flush=True)
print(setup["openmp_flags"]()[0], flush=True)
os.environ["CXX"] = "no-such-compiler"
print(setup["openmp_flags"](), flush=True)
"""


def test_a_build_says_what_it_compiles_and_that_there_is_no_openmp():
    environment = os.environ | {"ANALYTIC_RASTERIZER_CUDA": "0"}
    environment.pop("CXX", None)
    command = [sys.executable, "-c", BUILDING]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    *progress, flags, without = done.stdout.splitlines()
    assert progress == ["before", "[1/2] csrc/cpu/sort.cpp", "sort.cpp:3: warning", "[2/2] csrc/cpu/ssim.cpp", "after"]
    assert flags == ("['-fopenmp']" if ar._C.has_openmp else "[]") and without == "([], [])"
    assert "no-such-compiler has no OpenMP, so the CPU path will run on one thread" in done.stderr
