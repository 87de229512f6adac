"""The drop-in beside other distributions of its name, and extended by a file."""

import shutil
import sys

import pytest
from places import ROOT
from processes import run_python

import diff_gaussian_rasterization  # noqa: F401  (a test takes it out of sys.modules)
from analytic_rasterizer import dialects, installation

pytestmark = pytest.mark.usefixtures("nothing_chosen")

FAKE = "GaussianRasterizer = None\n"


@pytest.mark.parametrize(
    "files, message",
    [
        ({"diff_gaussian_rasterization/__init__.py": FAKE}, "is not that of analytic_rasterizer but another at"),
        ({"diff_gaussian_rasterization/leftover.txt": ""}, "diff_gaussian_rasterization is missing"),
        ({"diff_gaussian_rasterization_ms.py": FAKE}, "diff_gaussian_rasterization_ms is not that of"),
        ({}, None),
    ],
    ids=["another", "removed", "another_ms", "ours"],
)
def test_another_distribution_of_the_same_name(tmp_path, files, message):
    """Ours is copied to a folder of its own, as in site-packages, and another's files are put over it."""
    installed(tmp_path)
    for path, text in files.items():
        folder = (tmp_path / path).parent
        if folder != tmp_path:
            shutil.rmtree(folder)
            folder.mkdir()
        elif (tmp_path / path).stem != path:
            shutil.rmtree(tmp_path / (tmp_path / path).stem)
        (tmp_path / path).write_text(text)
    code = """
        import sys, warnings
        sys.path = [sys.argv[1]] + [p for p in sys.path if "site-packages" in p or "lib" in p]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            import analytic_rasterizer
            import analytic_rasterizer.dialects
        assert analytic_rasterizer.__file__.startswith(sys.argv[1])
        print(*[w.message for w in caught], sep="\\n")
    """
    printed = run_python(code, str(tmp_path), PYTHONPATH=str(tmp_path)).strip()
    if message is None:
        assert printed == ""
    else:
        assert printed.count("\n") == 0 and message in printed and "--force-reinstall --no-deps" in printed


def test_the_distribution_to_uninstall_is_named(tmp_path, monkeypatch):
    """As pip knows it, which need not be the name of the module."""
    info = tmp_path / "their_rasterizer-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-rasterizer\nVersion: 1.0\n")
    (info / "top_level.txt").write_text("diff_gaussian_rasterization\n")
    (tmp_path / "diff_gaussian_rasterization.py").write_text(FAKE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "diff_gaussian_rasterization")
    problem = installation.problem_of("diff_gaussian_rasterization")
    assert "`pip uninstall -y their-rasterizer` and then `pip install --force-reinstall --no-deps" in problem


def installed(folder):
    """The packages in another folder, as an installation has them."""
    for package in ("analytic_rasterizer", "diff_gaussian_rasterization", "diff_gaussian_rasterization_ms"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    library = next(path for path in (ROOT / "analytic_rasterizer").glob("_C*"))
    assert (folder / "analytic_rasterizer" / library.name).exists()


def test_compiled_module_of_another_that_was_left_behind(tmp_path):
    """A `_C` that the other rasterizer left beside our __init__.py is not imported."""
    installed(tmp_path)
    (tmp_path / "diff_gaussian_rasterization" / "_C.py").write_text("raise RuntimeError('the wrong one')")
    code = """
        import diff_gaussian_rasterization._C
        from diff_gaussian_rasterization import _C
        print(_C.rasterize_gaussians.__module__, diff_gaussian_rasterization._C.mark_visible.__module__)
    """
    names = run_python(code, PYTHONPATH=str(tmp_path)).split()
    assert names == ["analytic_rasterizer.dialects._native"] * 2


def test_a_new_dialect_is_one_file(tmp_path):
    """The file of its page, put into the package, is a dialect: by choice and by inference."""
    text = (ROOT / "docs" / "internals" / "adding-a-dialect.md").read_text()
    source = text.split("```python\n# analytic_rasterizer/dialects/confident.py\n")[1].split("```")[0]
    installed(tmp_path)
    (tmp_path / "analytic_rasterizer" / "dialects" / "confident.py").write_text(source)
    code = """
        import sys, torch
        import diff_gaussian_rasterization as d
        import analytic_rasterizer
        assert analytic_rasterizer.__file__.startswith(sys.argv[1])
        view = torch.eye(4); view[3, 2] = 4
        camera = [8, 8, 0.4, 0.4, torch.zeros(3), 1.0, view, view @ torch.diag(torch.tensor([2.5, 2.5, 1, 0])), 0]
        projection = torch.zeros(4, 4); projection[0, 0] = projection[1, 1] = 2.5; projection[2, 3] = 1
        camera[7] = view @ projection
        settings = d.GaussianRasterizationSettings(*camera, torch.zeros(3), False, False, confidence=torch.ones(1, 1))
        made = d.GaussianRasterizer(settings)(
            torch.zeros(1, 3), None, torch.ones(1, 1), colors_precomp=torch.ones(1, 3), scales=torch.ones(1, 3),
            rotations=torch.ones(1, 4),
        )
        print(settings.dialect, len(made), settings.footprint_in_use())
        d.set_dialect("confident"); print(d.GaussianRasterizationSettings._fields[-1])
    """
    printed = run_python(code, str(tmp_path), PYTHONPATH=str(tmp_path)).split()
    assert printed == ["confident", "4", "point:dilation=0.3", "confidence"]
    assert "confident" not in dialects.DIALECTS
