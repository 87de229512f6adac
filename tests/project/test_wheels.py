"""wheels/: the index by pairs of torch and CUDA, from which pip leaves torch as it is, and the tag of a wheel."""

import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import zipfile

import pytest
from places import ROOT

from analytic_rasterizer.installation import wheel_folder


def module_of(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "wheels" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


index, installing, platform_tag = (module_of(name) for name in ("index", "install", "platform_tag"))
# pip of a user without settings: what it finds, it finds in the index and in its environment.
PIP = {key: value for key, value in os.environ.items() if not key.startswith(("PIP_", "PYTHONPATH"))}
PIP["PIP_CONFIG_FILE"] = os.devnull


def distribution(name, version, *required):
    """The files of an installed distribution, by their names."""
    info = f"{name}-{version}.dist-info"
    lines = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}", "Requires-Python: >=3.10"]
    lines += [f"Requires-Dist: {text}" for text in required]
    tags = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    return {f"{info}/METADATA": "\n".join(lines) + "\n", f"{info}/WHEEL": tags, f"{info}/RECORD": ""}


def write_wheel(folder, minor, version="0.2.0"):
    place = folder / "analytic-rasterizer"
    place.mkdir(parents=True, exist_ok=True)
    path = place / f"analytic_rasterizer-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in distribution("analytic_rasterizer", version, f"torch=={minor}.*", "numpy").items():
            archive.writestr(name, text)
    return path


@pytest.fixture
def folder(tmp_path):
    """An index with wheels for torch 2.13 and 2.14."""
    wheels = tmp_path / "a folder"
    write_wheel(wheels / "pt213cpu", "2.13", "0.1.9")
    write_wheel(wheels / "pt213cpu", "2.13")
    write_wheel(wheels / "pt214cu130", "2.14")
    index.write_index(wheels)
    return wheels


@pytest.fixture
def python(tmp_path):
    """An environment that has torch 2.13.0+cpu and NumPy, as far as pip can tell."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    say = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = subprocess.check_output([python, "-c", say], text=True).strip()
    for name, version in (("torch", "2.13.0+cpu"), ("numpy", "2.4.6")):
        for file, text in distribution(name, version).items():
            path = os.path.join(site, file)
            os.makedirs(os.path.dirname(path), exist_ok=True)
            with open(path, "w") as opened:
                opened.write(text)
    return python


def install(python, address, *options):
    command = [sys.executable, "-m", "pip", "--python", python, "install", "--index-url", address, *options]
    if importlib.util.find_spec("pip") is None:
        pytest.skip("needs pip")
    return subprocess.run(
        [*map(str, command), "--no-cache-dir", "analytic-rasterizer"], env=PIP, capture_output=True, text=True
    )


def test_pip_installs_the_wheel_of_the_pair_and_leaves_torch(folder, python):
    done = install(python, (folder / "pt213cpu").as_uri(), "--dry-run", "--quiet", "--report", "-")
    assert done.returncode == 0, done.stderr[-2000:]
    (installed,) = json.loads(done.stdout)["install"]
    assert installed["metadata"]["name"] == "analytic_rasterizer" and installed["metadata"]["version"] == "0.2.0"
    url = installed["download_info"]["url"]
    assert url.endswith("/a%20folder/pt213cpu/analytic-rasterizer/analytic_rasterizer-0.2.0-py3-none-any.whl")


def test_pip_refuses_the_wheel_of_another_pair_and_leaves_torch(folder, python):
    done = install(python, (folder / "pt214cu130").as_uri(), "--dry-run", "--report", "-")
    assert done.returncode != 0
    assert "No matching distribution found for torch==2.14.*" in done.stderr


def test_the_pages_are_those_of_an_index(folder):
    assert '<a href="pt213cpu/">pt213cpu</a>' in (folder / "index.html").read_text()
    assert '<a href="analytic-rasterizer/">' in (folder / "pt213cpu" / "index.html").read_text()
    text = (folder / "pt213cpu" / "analytic-rasterizer" / "index.html").read_text()
    assert text.count(".whl#sha256=") == 2 and 'data-requires-python="&gt;=3.10"' in text


def test_a_wheel_in_the_wrong_folder_is_refused(folder):
    shutil.copytree(folder / "pt213cpu", folder / "pt212cpu")
    with pytest.raises(ValueError, match=r"whl requires torch 2\.13, its folder is for 2\.12"):
        index.write_index(folder)


def test_a_folder_without_pairs_is_refused(tmp_path):
    (tmp_path / "pt2").mkdir()
    with pytest.raises(ValueError, match="has no folder of a pair, such as pt213cpu"):
        index.write_index(tmp_path)


@pytest.mark.parametrize(
    ("versions", "expected"),
    [
        (set(), (17, "manylinux2014")),
        ({"GLIBC_2.2.5", "GLIBC_2.14", "GLIBCXX_3.4.19", "CXXABI_1.3"}, (17, "manylinux2014")),
        ({"GLIBC_2.27", "GLIBC_2.29", "GLIBC_2.3.4"}, (29, "GLIBC_2.29")),
        ({"GLIBC_2.28", "GLIBCXX_3.4.24"}, (28, "GLIBC_2.28")),
        ({"GLIBC_2.32", "GLIBCXX_3.4.30"}, (35, "GLIBCXX_3.4.30")),
        ({"GLIBC_2.32", "GLIBC_ABI_DT_RELR", "GLIBC_2.4"}, (36, "GLIBC_ABI_DT_RELR")),
    ],
)
def test_the_least_glibc(versions, expected):
    assert platform_tag.least_glibc(versions) == expected


def test_versions_that_the_table_does_not_know_are_refused():
    with pytest.raises(ValueError, match=r"GLIBCXX_3\.4\.99 is newer"):
        platform_tag.least_glibc({"GLIBCXX_3.4.99"})


def wheel_of(tmp_path, compiler, code, *options):
    source, library, wheel = tmp_path / "a.cpp", tmp_path / "a.so", tmp_path / "a.whl"
    source.write_text(code)
    subprocess.run([compiler, "-shared", "-fPIC", str(source), "-o", str(library), *options], check=True)
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.write(library, "a/_C.so")
    return wheel


@pytest.fixture
def compiler():
    found = shutil.which("g++")
    if found is None or shutil.which("readelf") is None:
        pytest.skip("needs g++ and readelf")
    return found


def test_the_tag_of_a_library(tmp_path, compiler):
    wheel = wheel_of(tmp_path, compiler, "#include <cmath>\ndouble f(double x) { return std::exp(x); }", "-lm")
    tag, because, needed = platform_tag.platform_tag(wheel)
    assert tag.startswith("manylinux_2_") and tag.endswith(platform.machine())
    versions = platform_tag.dynamic_section(tmp_path / "a.so")[1]
    assert because in (*versions, "manylinux2014") and "libm.so.6" in needed


def test_a_library_that_other_systems_lack_is_refused(tmp_path, compiler):
    (tmp_path / "b.cpp").write_text("int b() { return 1; }")
    other = tmp_path / "libother.so.3"
    command = [compiler, "-shared", "-fPIC", str(tmp_path / "b.cpp"), "-Wl,-soname,libother.so.3", "-o", str(other)]
    subprocess.run(command, check=True)
    wheel = wheel_of(tmp_path, compiler, "int b(); int f() { return b(); }", str(other))
    with pytest.raises(ValueError, match=r"needs libother\.so\.3, which other systems may not have"):
        platform_tag.platform_tag(wheel)


def test_the_workflow_builds_what_its_folders_say():
    text = (ROOT / ".github" / "workflows" / "wheels.yml").read_text()
    rows = re.findall(r'pair: (\w+), torch: ([\d.]+), index: (?:cpu|cu(\d+)(\d)), image: .*, cuda: "(\d)"', text)
    assert len(rows) == 5
    for folder, version, major, minor, cuda in rows:
        assert folder == wheel_folder(version, f"{major}.{minor}" if major else None)
        assert cuda == ("1" if major else "0")
    assert f"pair: [{', '.join(sorted(row[0] for row in rows))}]" in text


def test_a_build_without_its_packages_ends_before_it_begins(tmp_path, monkeypatch):
    for name in ("index", "platform_tag"):  # which build.py finds beside itself
        monkeypatch.setitem(sys.modules, name, module_of(name))
    building, found = module_of("build"), importlib.util.find_spec
    lacks = {"wheel", "pytest"}
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name in lacks else found("json"))
    for tests, named in ((["tests/a.py"], "wheel pytest"), ([], "wheel")):
        with pytest.raises(SystemExit, match=f"needs {', '.join(named.split())}: .* -m pip install {named}$"):
            building.main(tmp_path / "dist", tests)
    assert not (tmp_path / "dist").exists()


@pytest.mark.parametrize("status", [0, 3])
def test_an_installation_says_what_it_compiles_and_why_it_fails(capsys, status):
    lines = ["Collecting x", "  [3/14] csrc/cpu/sort.cpp", "  analytic_rasterizer: c++ has no OpenMP", "[notice] pip"]
    program = f"import sys; print(*{lines}, sep='\\n'); sys.exit({status})"
    assert installing.run([sys.executable, "-c", program]) == status
    shown = ["[3/14] csrc/cpu/sort.cpp", "analytic_rasterizer: c++ has no OpenMP"]
    assert capsys.readouterr().out.splitlines() == shown + (lines if status else [])
