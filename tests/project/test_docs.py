"""The documents point at what exists: files, headings, and the sections of docs that the code cites.

They and the messages of the package recommend the same footprints.
"""

import pathlib
import re

import pytest
from places import ROOT

import analytic_rasterizer as ar
from analytic_rasterizer import advice, cli, footprints
from analytic_rasterizer.training.options import TrainingOptions

DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("simple_knn/*.md"), *ROOT.glob("third_party/*.md")]
)
SOURCES = sorted(
    path
    for folder in ("csrc", "analytic_rasterizer", "tests", "benchmarks")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".h", ".cpp", ".cu", ".cuh", ".py", ".js") and path != pathlib.Path(__file__).resolve()
)


def anchor(heading):
    """The name that GitHub gives to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(document):
    text = re.sub(r"^```.*?^```$", "", document.read_text(), flags=re.M | re.S)
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)$", text, flags=re.M)}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links(document):
    text = " ".join(document.read_text().split())
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?:", target):
            continue
        path, _, heading = target.partition("#")
        file = (document.parent / path).resolve() if path else document
        assert file.exists(), f"{target} does not exist"
        assert not heading or heading in anchors(file), f"{target}: there is no such heading"


def test_sections_that_the_code_cites():
    cited = 0
    for path in SOURCES:
        text = re.sub(r"\n\s*(///?|#)?\s*", " ", path.read_text())  # a citation may be broken over lines of a comment
        for page, sections in re.findall(r'docs/([\w/-]+\.md), ("[^"]+"(?: and "[^"]+")*)', text):
            document = ROOT / "docs" / page
            known = anchors(document) | {anchor(bold) for bold in re.findall(r"\*\*(.+?)\*\*", document.read_text())}
            for section in re.findall(r'"([^"]+)"', sections):
                assert anchor(section) in known, f'{path.relative_to(ROOT)} cites "{section}" of docs/{page}'
                cited += 1
    assert cited > 10, "the citations are written in another way: this test reads none of them"


def words(text):
    return " ".join(text.split())


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/footprints.md"])
def test_pages_recommend_one_footprint(page):
    """The rows of the table of footprints are those of the code."""
    text = (ROOT / page).read_text()
    for where, which in footprints.ADVICE.items():
        assert f"\n| {where} | {which} |" in text, f"{page} should say: {where}: {which}"


@pytest.mark.usefixtures("nothing_chosen")
def test_messages_recommend_the_same_footprint():
    for footprint in (footprints.PAPER, footprints.DILATED, footprints.RECOMMENDED):
        assert footprint in advice.TEXT
    assert footprints.ADVICE_IN_WORDS in words(cli.build_parser().format_help())
    assert TrainingOptions().footprint == footprints.RECOMMENDED
    assert ar.get_default_footprint().name == footprints.PAPER
