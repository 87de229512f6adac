"""What an import says where the compiled extension is missing, or was built for another torch."""

import os
import platform
import shutil
import warnings

import pytest
import torch
from places import ROOT
from processes import run_program

from analytic_rasterizer import _C, installation

PACKAGES = ("analytic_rasterizer", "diff_gaussian_rasterization", "diff_gaussian_rasterization_ms")
HERE = installation.wheel_folder(torch.__version__, torch.version.cuda)
LIBRARY = next((ROOT / "analytic_rasterizer").glob("_C.*.so"))


def copy_of_packages(folder, with_extension=False):
    left_out = shutil.ignore_patterns("__pycache__", *([] if with_extension else ["_C.*"]))
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=left_out)
    return folder / "analytic_rasterizer"


def failure(*folders, module="analytic_rasterizer"):
    """The last line that Python prints of an import that fails, with these folders first in its path."""
    path = os.pathsep.join(map(str, folders))
    # An editable installation lends its extension to any package of this name: its finder is left out.
    program = f"import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'Editable' not in str(f)]; import {module}"
    done = run_program(program, environment=os.environ | {"PYTHONPATH": path})
    assert done.returncode != 0 and done.stdout == ""
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: ")
    return last


@pytest.mark.parametrize("module", PACKAGES)
def test_a_clone_that_was_not_built(tmp_path, module):
    package = copy_of_packages(tmp_path)
    sentence = failure(tmp_path, module=module)
    assert f"was imported from {package}, which has no compiled extension, as a clone that was not built in" in sentence
    assert f"`pip install -e {tmp_path}`" in sentence
    assert "circular" not in sentence


def test_a_clone_beside_an_installation(tmp_path):
    """That Python would have found, had it been started elsewhere."""
    clone, site = tmp_path / "clone", tmp_path / "site"
    copy_of_packages(clone)
    copy_of_packages(site, with_extension=True)
    expected = f"start Python in another folder than {clone}, so that the one in {site} is found"
    assert expected in failure(clone, site)


def test_an_extension_for_another_version_of_python(tmp_path):
    package = copy_of_packages(tmp_path)
    (package / "_C.cpython-27-x86_64-linux-gnu.so").write_bytes(b"")
    expected = f"no compiled extension for Python {platform.python_version()}, only _C.cpython-27-x86_64-linux-gnu.so:"
    assert expected in failure(tmp_path)


def test_an_extension_that_was_built_for_another_torch(tmp_path):
    """A function of torch that the extension needs is missing, as after an upgrade."""
    package = copy_of_packages(tmp_path)
    library = LIBRARY.read_bytes()
    version = torch.__version__.encode()
    other = b"0" + version[1:]
    assert library.count(b"was built for torch " + version) == 1
    library = library.replace(b"was built for torch " + version, b"was built for torch " + other)
    library = library.replace(b"_ZN3c10", b"_ZN3c99")
    (package / LIBRARY.name).write_bytes(library)
    sentence = failure(tmp_path)
    assert f"was built for torch {other.decode()} and cannot be loaded with torch {torch.__version__}," in sentence
    assert "undefined symbol: _ZN3c99" in sentence
    assert f"install the wheel of {HERE} (docs/install.md), or build it for this torch" in sentence
    assert "`pip install --force-reinstall --no-deps path/to/analytic_rasterizer`" in sentence


@pytest.mark.parametrize("content", [b"no library", _C.BUILT_FOR.encode() + b"\0"])
def test_an_extension_that_is_damaged(tmp_path, content):
    package = copy_of_packages(tmp_path)
    (package / LIBRARY.name).write_bytes(content)
    sentence = failure(tmp_path)
    assert f"{LIBRARY.name} cannot be loaded with torch {torch.__version__} (" in sentence
    assert "install it again, `pip install --force-reinstall" in sentence


def test_an_extension_of_another_torch_that_can_be_loaded():
    """A warning, since calls may crash; none for another release of the same version."""
    assert f"analytic_rasterizer was built for torch {torch.__version__}" == _C.BUILT_FOR
    major, minor, *_ = torch.__version__.split(".")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for version in (torch.__version__, f"{major}.{minor}.99+cu999"):
            installation.warn_if_built_for_another(f"analytic_rasterizer was built for torch {version}")
    with pytest.warns(UserWarning, match=rf"for torch {major}\.99\.0, and torch {major}\.{minor}.* calls may crash"):
        installation.warn_if_built_for_another(f"analytic_rasterizer was built for torch {major}.99.0")


def test_a_wheel_for_another_torch_says_so_in_one_sentence_at_import(tmp_path):
    """As after `pip install --no-deps` of the wrong wheel, which can be loaded."""
    package = copy_of_packages(tmp_path)
    before, after = b"was built for torch 2.", b"was built for torch 9."
    library = LIBRARY.read_bytes()
    assert library.count(before) == 1
    (package / LIBRARY.name).write_bytes(library.replace(before, after))
    program = "import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'Editable' not in str(f)]\n"
    program += "import analytic_rasterizer; print(analytic_rasterizer.__file__)"
    done = run_program(program, environment=os.environ | {"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 0 and done.stdout.strip() == str(package / "__init__.py")
    (warning,) = [line for line in done.stderr.splitlines() if "UserWarning" in line]
    expected = (
        f"was built for torch {torch.__version__.replace('2.', '9.', 1)}, and torch {torch.__version__} is installed"
    )
    assert expected in warning and f"install the wheel of {HERE}" in warning


@pytest.mark.parametrize(
    ("version", "cuda", "folder"),
    [("2.13.0+cpu", None, "pt213cpu"), ("2.11.0+cu130", "13.0", "pt211cu130"), ("2.4.1a0+git", "12.1", "pt24cu121")],
)
def test_the_folder_of_the_wheels_that_fit(version, cuda, folder):
    assert installation.wheel_folder(version, cuda) == folder


def test_what_is_installed_is_said_with_the_wheels_that_fit():
    built_for = "analytic_rasterizer was built for torch 2.11.0+cu130"
    text = installation.about("1.2.3", built_for, has_cuda=True, has_openmp=True)
    assert text.startswith("analytic_rasterizer 1.2.3, built for torch 2.11.0+cu130, for the CPU and CUDA\n")
    assert f"--index-url INDEX/{HERE} analytic-rasterizer" in text
    text = installation.about("1.2.3", built_for, has_cuda=False, has_openmp=False)
    assert text.splitlines()[0].endswith("for one thread of the CPU (its compiler had no OpenMP)")
