"""Installing into an environment of its own: beside nothing, beside another simple_knn, and before it."""

import os
import pathlib
import shutil
import subprocess
import sys

import analytic_simple_knn
import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
DEADLINE = 3600
"""Seconds after which something counts as hanging; compiling takes half a minute."""
USE = "import torch; from simple_knn._C import distCUDA2; print(distCUDA2(torch.eye(3)))"


class Environment:
    """A virtual environment that sees the packages of the one that runs the tests, torch and pip among them."""

    def __init__(self, folder):
        self.folder = folder
        # Without pip, which takes longer to install than all the rest: this environment's can work on that one.
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
        (self.packages,) = folder.glob("lib/python*/site-packages")
        outside = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
        (self.packages / "outside.pth").write_text("\n".join(outside))

    def python(self, *arguments, folder=None):
        # PYTHONPATH, by which the tests may have been told where to find the package, would also be heard in there.
        variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        variables["ANALYTIC_RASTERIZER_CUDA"] = "0"  # to compile less
        command = [self.folder / "bin" / "python", *arguments]
        folder = self.folder if folder is None else folder
        return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, timeout=DEADLINE)

    def install(self, source):
        """Without pip's isolation, which would download setuptools."""
        options = ["--quiet", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
        return self.python("-m", "pip", "install", *options, source)

    def add_other(self, file, text):
        """A file of another simple_knn; how that was installed does not matter."""
        (self.packages / "simple_knn").mkdir(exist_ok=True)
        (self.packages / "simple_knn" / file).write_text(text)

    def files(self):
        return {
            path: path.read_bytes()
            for path in self.packages.rglob("*")
            if path.suffix in (".py", ".so", "") and path.is_file()
        }


@pytest.fixture
def environment(tmp_path):
    return Environment(tmp_path / "environment")


@pytest.fixture
def source(tmp_path):
    """The folder without what has been built in it, so that building it again leaves no trace."""
    ignored = shutil.ignore_patterns("build", "*.so", "*.egg-info", "__pycache__", "tests")
    return shutil.copytree(ROOT, tmp_path / "source", ignore=ignored)


def test_install_from_this_folder_alone(environment, source):
    """It works, could be repeated, and has no file that another one would bring."""
    if environment.python("-c", USE).returncode == 0:
        pytest.skip("needs an environment that has no simple_knn")
    done = environment.install(source)
    assert done.returncode == 0, done.stderr[-4000:]
    done = environment.python("-c", USE)
    assert done.stdout == "tensor([2., 2., 2.])\n", done.stderr
    # The command that refuses, without compiling once more.
    again = environment.python("setup.py", "-q", "build_py", folder=source)
    assert again.returncode == 0, again.stderr
    ours = {path for path in environment.files() if path.parent.name == "simple_knn"}
    # Nothing that others have: their compiled module has another name, and they may have an __init__.py.
    assert {path.name for path in ours} == {"_C.py"}


def refusals(done):
    return [line for line in done.stderr.splitlines() if "analytic_simple_knn provides simple_knn, which" in line]


def test_another_one_is_left_alone(environment, source):
    """Installing fails with one sentence that says what to do, and touches nothing."""
    environment.add_other("_C.py", "def distCUDA2(points):\n    return 'the other one'\n")
    before = environment.files()
    done = environment.install(source)
    assert done.returncode != 0
    assert len(refusals(done)) == 1 and "pip uninstall simple_knn" in refusals(done)[0], done.stderr
    assert environment.files() == before
    assert environment.python("-c", USE).stdout == "the other one\n"


def test_another_one_that_cannot_be_imported(environment, source):
    """As if it needed a GPU. The command that refuses is enough, without all of pip."""
    environment.add_other("__init__.py", "raise RuntimeError('needs a GPU')")
    done = environment.python("setup.py", "-q", "build_py", folder=source)
    assert done.returncode != 0
    assert len(refusals(done)) == 1 and "needs a GPU" in refusals(done)[0], done.stderr


def test_a_compiled_one_comes_first(tmp_path):
    """Where both are installed after all, in whichever order, Python takes the other one's compiled module."""
    (tmp_path / "simple_knn").mkdir()
    shutil.copy(ROOT / "simple_knn" / "_C.py", tmp_path / "simple_knn")
    suffix = "".join(pathlib.Path(analytic_simple_knn._C.__file__).suffixes)
    (tmp_path / "simple_knn" / f"_C{suffix}").write_bytes(b"")
    code = "import importlib.util; print(importlib.util.find_spec('simple_knn._C').origin)"
    done = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path = [{str(tmp_path)!r}, *sys.path]; {code}"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == str(tmp_path / "simple_knn" / f"_C{suffix}")


def failure_of_import(folder):
    """The last line that Python prints where the packages in this folder come first."""
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import simple_knn._C"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode != 0
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: ") and "path/to/analytic_rasterizer/simple_knn`" in last
    return last


def copy_of_packages(folder):
    """Without the compiled module."""
    left_out = shutil.ignore_patterns("__pycache__", "_C.*so")
    for package in ("analytic_simple_knn", "simple_knn"):
        shutil.copytree(ROOT / package, folder / package, ignore=left_out)
    return folder / "analytic_simple_knn"


def test_a_clone_that_was_not_built(tmp_path):
    package = copy_of_packages(tmp_path)
    assert f"imported from {package}, which has no compiled module, as a clone that" in failure_of_import(tmp_path)
    (package / "_C.cpython-27-x86_64-linux-gnu.so").write_bytes(b"")
    assert "for this version of Python, only _C.cpython-27" in failure_of_import(tmp_path)


def test_a_module_that_was_built_for_another_torch(tmp_path):
    import torch

    package = copy_of_packages(tmp_path)
    built = pathlib.Path(analytic_simple_knn._C.__file__)
    library = built.read_bytes()
    assert f"analytic_simple_knn was built for torch {torch.__version__}" == analytic_simple_knn._C.BUILT_FOR
    library = library.replace(torch.__version__.encode(), b"0" + torch.__version__.encode()[1:])
    (package / built.name).write_bytes(library.replace(b"PyInit__C", b"PyInit__D"))
    expected = f"was built for torch 0{torch.__version__[1:]} and cannot be loaded with torch {torch.__version__} ("
    assert expected in failure_of_import(tmp_path)
