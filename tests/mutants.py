"""21 mistakes in the project that its tests have to notice, from every room of csrc and of the package.

    python tests/mutants.py                 all of them: some minutes, most of them for compiling
    python tests/mutants.py sh filters      some, by name
    python tests/mutants.py --list          what they are

A mistake is a change of one place in a copy of the working tree, in a temporary folder. Its tests run before it and
after it. Without it they have to pass. With it they should fail: it is `caught`. Otherwise it SURVIVED, and the exit
status is 1; where the tests pass neither way, or do not run, they are BROKEN.

Mistakes in csrc/core, csrc/cpu and csrc/cuda are judged by a C++ test, which is compiled alone ($CXX, else c++; needs
GoogleTest, and for the kernels, which run on the host, the headers of the CUDA toolkit). Those in csrc/torch are judged
by Python tests, for which the extension is built in the copy. tests/project/test_mutants.py sees to it that every
mistake can still be made.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
FLAGS = ["-std=c++17", "-O1", "-fopenmp", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi"]
ON_HOST = ["-U_FORTIFY_SOURCE", "-Wno-unknown-pragmas"]  # of the kernels
LIBRARIES = ["-lgtest_main", "-lgtest", "-pthread"]
CUDA = Path(os.environ.get("CUDA_HOME", "/usr/local/cuda"))


class BrokenError(Exception):
    """The tests could not judge."""


class Mutant(NamedTuple):
    """A mistake.

    Attributes:
        name: On the command line.
        file: Where it is, relative to the root.
        old, new: What is replaced, which occurs once, and by what.
        tests: Name of the file of the tests, which may be anywhere in tests/, and the part of it that must fail: an
            expression of pytest's -k, or a filter of GoogleTest.
        sources: Names of further files that a C++ test is compiled with, anywhere in tests/cpp or csrc.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, str]
    sources: tuple[str, ...] = ()

    @property
    def is_built(self) -> bool:
        """Whether the extension has to be built anew."""
        return self.file.startswith("csrc/torch/")


MODELS = ("models.cpp",)
MUTANTS = (
    Mutant(
        "sh",
        "csrc/core/sh.h",
        "T(4) * c20 * z * weight[6] - c2 *",
        "T(4) * c20 * z * weight[6] + c2 *",
        ("sh_test.cpp", "*"),
        MODELS,
    ),
    Mutant(
        "bin",
        "csrc/core/bin.h",
        "hi = min(span.hi, T(n - 1));",
        "hi = min(span.hi, T(n));",
        ("bin_test.cpp", "*"),
        MODELS,
    ),
    Mutant(
        "footprint",
        "csrc/core/footprint/gaussian.h",
        "return T(2) * std::log(T(1 / kAlphaMin) * opacity * amp);",
        "return std::log(T(1 / kAlphaMin) * opacity * amp);",
        ("footprint_test.cpp", "*Support*"),
        MODELS,
    ),
    Mutant(
        "camera",
        "csrc/core/camera/lens_model.h",
        "to.lens.center.x -= by_u.x;",
        "to.lens.center.x += by_u.x;",
        ("project_test.cpp", "*FullCamera*"),
        MODELS,
    ),
    Mutant(
        "sort",
        "csrc/cpu/sort.cpp",
        "    any |= set_in_any[p];",
        "    any = set_in_any[p];",
        ("sort_test.cpp", "*"),
        (*MODELS, "sort.cpp", "parallel.cpp", "quota.cpp"),
    ),
    Mutant(
        "still",
        "csrc/cuda/still/vjp_sums.cuh",
        "pair.ninth[lane % 4 * 2 + 1 - odd]",
        "pair.ninth[lane % 4 * 2 + odd]",
        ("pair_sums_test.cpp", "*"),
    ),
    Mutant(
        "channels",
        "csrc/cuda/channels/groups_vjp.cuh",
        "through -= kSampleShare<F> * params.dL_dalpha",
        "through += kSampleShare<F> * params.dL_dalpha",
        ("group_kernels_test.cpp", "*"),
    ),
    Mutant(
        "render",
        "analytic_rasterizer/render/sphere.py",
        "splats.means2d.new_tensor([size[1] / 2, size[0] / 2])",
        "splats.means2d.new_tensor([size[0] / 2, size[1] / 2])",
        ("test_lens.py", "means2d"),
    ),
    Mutant(
        "cameras",
        "analytic_rasterizer/cameras/path.py",
        "elevation.cos() * level + elevation.sin() * up",
        "elevation.cos() * level - elevation.sin() * up",
        ("test_camera_path.py", "orbit"),
    ),
    Mutant(
        "dialects",
        "analytic_rasterizer/dialects/monogs.py",
        "torch.stack([m[2, 1] - m[1, 2],",
        "torch.stack([m[1, 2] - m[2, 1],",
        ("test_dialect_gradients.py", "pose"),
    ),
    Mutant(
        "gsplat",
        "analytic_rasterizer/dialects/gsplat/scene.py",
        "variance=self.footprint.option if filters else _PIXEL_VARIANCE,",
        "variance=self.footprint.option if filters else 0.0,",
        ("test_gsplat.py", "radii or conics or footprint"),
    ),
    Mutant(
        "captures",
        "analytic_rasterizer/captures/extent.py",
        "RADIUS_FACTOR * (places - places.mean(0))",
        "RADIUS_FACTOR * (places - places[0])",
        ("test_train_alive.py", "extent"),
    ),
    Mutant(
        "training",
        "analytic_rasterizer/training/parts.py",
        "several and scale == min(scales) else 1",
        "several and scale == scales[0] else 1",
        ("test_train_options.py", "presets_give_way"),
    ),
    Mutant(
        "density",
        "analytic_rasterizer/density/gradient.py",
        "<= options.prune_above * self.extent)",
        "<= options.prune_above)",
        ("test_densify.py", "large"),
    ),
    Mutant(
        "distributed",
        "analytic_rasterizer/distributed/bands.py",
        "if cut > 0 and wanted - before[cut - 1] < before[cut] - wanted:",
        "if cut > 0 and wanted - before[cut - 1] > before[cut] - wanted:",
        ("test_distributed_parts.py", "balanced"),
    ),
    Mutant(
        "io",
        "analytic_rasterizer/io/splat.py",
        '(rows["rotations"].astype(np.float32) - 128) / 128',
        '(rows["rotations"].astype(np.float32) - 127) / 128',
        ("test_formats.py", "splat"),
    ),
    Mutant(
        "viewer",
        "analytic_rasterizer/viewer/packing.py",
        "down = -math.sin(angle) * ahead - math.cos(angle) * up",
        "down = math.sin(angle) * ahead - math.cos(angle) * up",
        ("test_viewer.py", "upright"),
    ),
    Mutant(
        "analysis",
        "analytic_rasterizer/analysis/reference.py",
        "cy=cy - row / fine)",
        "cy=cy - row)",
        ("test_image_reference.py", "shifted"),
    ),
    Mutant(
        "cli",
        "analytic_rasterizer/cli/arguments.py",
        "0 <= float(part) <= 1 for part in parts",
        "0 <= float(part) for part in parts",
        ("test_cli.py", "errors_are_one_line"),
    ),
    Mutant(
        "filters",
        "analytic_rasterizer/filters.py",
        "(1 + 2 * MARGIN) * projected",
        "(1 + MARGIN) * projected",
        ("test_filters.py", "finest or beside"),
    ),
    Mutant(
        "torch",
        "csrc/torch/composite.cpp",
        "dL_ddepth.mul(depth).neg_()",
        "dL_ddepth.mul(depth)",
        ("test_gsplat.py", "gradcheck"),
    ),
)
"""The extension is built for the last ones: those before run on the one that is there."""


def find(name: str, root: Path | None = None) -> Path:
    """The file of that name among the tests and the sources, of which there is one."""
    found = [path for folder in ("tests", "csrc") for path in sorted(((root or ROOT) / folder).rglob(name))]
    if len(found) != 1:
        raise BrokenError(f"{name}: expected one file in tests and csrc, found {len(found)}")
    return found[0]


def copy_tree(to: Path) -> None:
    """What git knows or does not ignore, and the extension that was built in place."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    names += [path.relative_to(ROOT).as_posix() for path in (ROOT / "analytic_rasterizer").glob("_C*.so")]
    for name in filter(None, names):
        if (ROOT / name).is_file():  # else it was removed
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)


def run(command: list, tree: Path, **environment: str) -> int:
    """The exit status of a command in the copy, whose output is kept in output.txt there."""
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"} | environment
    with (tree / "output.txt").open("w") as output:
        return subprocess.run(
            list(map(str, command)), cwd=tree, env=environment, stdout=output, stderr=subprocess.STDOUT
        ).returncode


def last_lines(tree: Path, count: int = 15) -> str:
    return "\n".join((tree / "output.txt").read_text(errors="replace").splitlines()[-count:])


def passes_cpp(mutant: Mutant, tree: Path) -> bool:
    """Compiles a C++ test and runs it."""
    name, chosen = mutant.tests
    test, program = find(name, tree), tree / "judge"
    options = [*FLAGS, f"-I{tree / 'csrc'}", f"-I{tree / 'tests/cpp'}"]
    if "cuda_on_host" in test.parts:
        options += [*ON_HOST, "-isystem", CUDA / "include"]
    sources = [test, *(find(source, tree) for source in mutant.sources)]
    compiler = os.environ.get("CXX", "c++").split()
    if run([*compiler, *options, *sources, "-o", program, *LIBRARIES], tree) != 0:
        raise BrokenError(f"{name} does not compile:\n{last_lines(tree)}")
    status = run([program, f"--gtest_filter={chosen}"], tree)
    if status == 0 and not re.search(r"PASSED  \] [1-9]", last_lines(tree)):
        raise BrokenError(f"{name} has no test {chosen}")
    return status == 0  # otherwise a test failed, or a signal ended it


def passes_python(mutant: Mutant, tree: Path) -> bool:
    """Runs Python tests, for which the extension is built anew if need be."""
    if mutant.is_built:
        build(tree)
    name, chosen = mutant.tests
    options = ["-q", "-x", "-n0", "-p", "no:cacheprovider", "-k", chosen]
    status = run([sys.executable, "-m", "pytest", *options, find(name, tree)], tree)
    if status not in (0, 1) or (status == 0 and " passed" not in last_lines(tree)):
        raise BrokenError(f"{name} -k '{chosen}' did not run:\n{last_lines(tree)}")
    return status == 0


def build(tree: Path) -> None:
    """The extension for the CPU, in the copy."""
    # ccache, which torch uses where there is one, is to find what was compiled in another folder.
    options = {"ANALYTIC_RASTERIZER_CUDA": "0", "CCACHE_BASEDIR": str(tree), "CCACHE_NOHASHDIR": "1"}
    if run([sys.executable, "setup.py", "-q", "build_ext", "--inplace"], tree, **options) != 0:
        raise BrokenError(f"the extension cannot be built:\n{last_lines(tree)}")


def verdict(mutant: Mutant, tree: Path, passes: Callable[[Mutant, Path], bool]) -> str:
    """What became of it: "caught", "SURVIVED", or "BROKEN: " and why. Afterwards the file is as it was."""
    path = tree / mutant.file
    text = path.read_text(encoding="utf-8")
    try:
        if text.count(mutant.old) != 1:
            raise BrokenError(f"{mutant.file}: expected once, found {text.count(mutant.old)} times: {mutant.old}")
        if not passes(mutant, tree):
            raise BrokenError(f"{mutant.tests[0]} fails without it:\n{last_lines(tree)}")
        path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        return "SURVIVED" if passes(mutant, tree) else "caught"
    except BrokenError as problem:
        return f"BROKEN: {problem}"
    finally:
        path.write_text(text, encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    """Makes the mistakes; returns 0 if all were caught, 1 if not."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    names = [mutant.name for mutant in MUTANTS]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of: {', '.join(names)} (default: all)")
    parser.add_argument("--list", action="store_true", help="say what they are, and make none")
    args = parser.parse_args(argv)
    unknown = sorted(set(args.names) - set(names))
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}")
    chosen = [mutant for mutant in MUTANTS if mutant.name in (args.names or names)]
    if args.list:
        print(*(f"{m.name}: {m.file}\n  - {m.old.strip()}\n  + {m.new.strip()}" for m in chosen), sep="\n")
        return 0
    caught = 0
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        tree = Path(folder)
        copy_tree(tree)
        for mutant in chosen:
            judge = passes_cpp if mutant.tests[0].endswith(".cpp") else passes_python
            said = verdict(mutant, tree, judge)
            caught += said == "caught"
            print(f"{mutant.name:12} {mutant.file:48} {said}", flush=True)
    print(f"{caught} of {len(chosen)} caught")
    return 0 if caught == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
