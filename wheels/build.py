"""Builds a wheel for the torch of this Python, puts it into an index of wheels, and tries it.

    python wheels/build.py OUT [TEST ...]

makes OUT/*.tar.gz, the sources, and from them OUT/pt213cpu/analytic-rasterizer/*.whl (the folder is that of the pair of
torch and CUDA), with the pages of the index. It then installs the wheel from the index into a fresh environment that
sees the packages of this one, renders a picture there, and runs the given tests, such as tests/api/test_api.py.

Needs torch, pip, setuptools, ninja, pybind11 and wheel, for tests the extra `test`, and no network. The environment
variables of docs/install.md hold: ANALYTIC_RASTERIZER_CUDA, TORCH_CUDA_ARCH_LIST, MAX_JOBS. A wheel is for others: the
GPUs of this machine do not decide its architectures.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import torch
from index import torch_minor_of, write_index
from platform_tag import platform_tag

ROOT = Path(__file__).resolve().parent.parent
PROJECT = "analytic-rasterizer"


def run(*command: object, **options: object) -> None:
    print("$", *command, flush=True)
    subprocess.run([str(word) for word in command], check=True, **options)


def wheel_folder(has_cuda: bool) -> str:
    """Of the package, whose extension need not be there for it."""
    path = ROOT / "analytic_rasterizer" / "installation.py"
    spec = importlib.util.spec_from_file_location("installation", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.wheel_folder(torch.__version__, torch.version.cuda if has_cuda else None)


def build(out: Path) -> Path:
    """The wheel, in the folder of its pair below `out`."""
    with tempfile.TemporaryDirectory() as folder:
        run(sys.executable, "setup.py", "-q", "sdist", "--dist-dir", folder, cwd=ROOT)
        (sources,) = Path(folder).glob("*.tar.gz")
        # From the sources and not from here: an old build folder would add its files.
        wheels = Path(folder) / "wheels"
        pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
        run(*pip, "--wheel-dir", wheels, sources, env=os.environ | {"CUDA_VISIBLE_DEVICES": ""})
        (wheel,) = wheels.glob("*.whl")
        tag, because, needed = platform_tag(wheel)
        print(f"{tag}, because of {because}")
        run(sys.executable, "-m", "wheel", "tags", "--remove", "--platform-tag", tag, wheel)
        (wheel,) = wheels.glob("*.whl")
        place = out / wheel_folder(any(name.startswith("libcudart") for name in needed)) / PROJECT
        place.mkdir(parents=True, exist_ok=True)
        shutil.copy(sources, out)
        return Path(shutil.copy(wheel, place))


def try_out(wheel: Path, tests: list[str]) -> None:
    """In a fresh environment, which gets torch and what the tests need from this one."""
    with tempfile.TemporaryDirectory() as folder:
        run(sys.executable, "-m", "venv", "--without-pip", f"{folder}/venv")
        python = Path(folder) / "venv" / "bin" / "python"
        own = subprocess.check_output(
            [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True
        )
        (Path(own.strip()) / "torch.pth").write_text(sysconfig.get_path("purelib") + "\n")
        index = wheel.parent.parent.resolve().as_uri()
        # Whatever version of the package this environment has: torch and NumPy are there.
        install = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-cache-dir"]
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PIP_FIND_LINKS")}
        environment["PIP_CONFIG_FILE"] = os.devnull
        run(*install, "--ignore-installed", "--no-deps", "--index-url", index, PROJECT, env=environment)
        for name in ("tests", "examples", "pyproject.toml"):  # without the package, which Python would find first
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, Path(folder) / name)
        run(python, "-m", "analytic_rasterizer", cwd=folder, env=environment)
        run(python, "examples/first_picture.py", cwd=folder, env=environment)
        if tests:
            run(python, "-m", "pytest", "-q", *tests, cwd=folder, env=environment)


def check_packages(tests: list[str]) -> None:
    """Exits where packages are missing that would be missed after the minutes of the build."""
    needed = ["pip", "setuptools", "wheel", *(["pytest", "scipy", "mpmath", "hypothesis"] if tests else [])]
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        sys.exit(f"wheels/build.py needs {', '.join(missing)}: {sys.executable} -m pip install {' '.join(missing)}")


def main(out: Path, tests: list[str]) -> None:
    check_packages(tests)
    out.mkdir(parents=True, exist_ok=True)
    wheel = build(out)
    write_index(out)
    print(f"{wheel}, for torch {torch_minor_of(wheel)}, {wheel.stat().st_size / 1e6:.1f} MB")
    try_out(wheel, tests)
    print(f"pip install --index-url {wheel.parent.parent.resolve().as_uri()} {PROJECT}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2:])
