"""The site that `make docs` builds: links out of docs/, lists as GitHub reads them, and nothing from the network."""

import importlib.util
import logging
import re
import shutil
import subprocess
import sys

import pytest
from places import ROOT

pytest.importorskip("mkdocs", reason="the site is built with mkdocs: make docs")
for name in ("material", "mkdocstrings_handlers"):
    pytest.importorskip(name, reason=f"the site needs {name}: make docs")

DOCS = ROOT / "docs"
spec = importlib.util.spec_from_file_location("site_hooks", DOCS / "site" / "hooks.py")
hooks = importlib.util.module_from_spec(spec)
spec.loader.exec_module(hooks)


KEPT = "[a](internals/log.md#x) [b](#here) [c](https://host)"


@pytest.mark.parametrize(
    ("markdown", "repository", "expected"),
    [
        ("see [the\nloop](../examples/train_loop.py)", "", "see the\nloop (`examples/train_loop.py`)"),
        ("[examples/train_loop.py](../examples/train_loop.py)", "", "`examples/train_loop.py`"),
        ("[a](../examples/demo.py)", "https://host/main/", "[a](https://host/main/examples/demo.py)"),
        (KEPT, "", KEPT),
        ("[a](../CONTRIBUTING.md#a-command-1-file)", "", "[a](contributing.md#a-command-1-file)"),
        ("![a](images/demo.png)", "https://host", "![a](images/demo.png)"),
        ("`[a](../none.py)` [`code`](../examples/demo.py)", "", "`[a](../none.py)` `code` (`examples/demo.py`)"),
        ("```\n[a](../none.py)\n```", "", "```\n[a](../none.py)\n```"),
    ],
)
def test_links(markdown, repository, expected):
    assert hooks.with_links(markdown, DOCS / "footprints.md", "footprints.md", repository) == expected


def test_links_of_pages_from_the_top():
    linked = hooks.with_links("[a](docs/footprints.md)", ROOT / "CONTRIBUTING.md", "contributing.md", "")
    assert linked == "[a](footprints.md)"


def test_dead_link_is_a_warning(caplog):
    with caplog.at_level(logging.WARNING):
        hooks.with_links("[a](../examples/none.py)", DOCS / "footprints.md", "footprints.md", "")
    assert "none.py" in caplog.text


def test_lists():
    nested = "text\n\n- a\n    - b\n  on\n- c\n\ntext\n"
    assert hooks.as_python_markdown("text\n- a\n  - b\n  on\n- c\n\ntext\n") == nested
    assert hooks.as_python_markdown("- a\n\n```\nx\n- y\n```") == "- a\n\n```\nx\n- y\n```"


def build(*options):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", *map(str, options)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_pages_load_nothing_from_the_network(tmp_path):
    run = build("--site-dir", tmp_path)
    assert run.returncode == 0, run.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"?(https?:)?//", page.read_text())
        assert not loaded, page
    assert not list(tmp_path.rglob("*.py"))
    reference = (tmp_path / "api" / "training.html").read_text()  # has what options are declared with
    assert "Share of 1 - SSIM in the loss, next to the mean absolute error." in reference


def test_strict_build_refuses_dead_links(tmp_path):
    for path in ROOT.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "docs").unlink()
    shutil.copytree(DOCS, tmp_path / "docs")
    (tmp_path / "mkdocs.yml").unlink()
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    with (tmp_path / "docs" / "losses.md").open("a") as page:
        page.write("\n\n[a](density.md#nowhere) [b](../csrc/none.h)\n")
    run = build("--config-file", tmp_path / "mkdocs.yml", "--site-dir", tmp_path / "site")
    assert run.returncode != 0
    assert "density.md#nowhere" in run.stderr and "../csrc/none.h" in run.stderr
