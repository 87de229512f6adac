"""The notebooks hold what the tutorials hold, whose blocks test_tutorials.py runs."""

import ast
import importlib.util
import json
import re
import subprocess
import sys

import pytest
from places import ROOT

spec = importlib.util.spec_from_file_location("notebooks", ROOT / "examples" / "notebooks.py")
notebooks = importlib.util.module_from_spec(spec)
spec.loader.exec_module(notebooks)
PAGES = sorted(notebooks.TUTORIALS.glob("*.md"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("notebooks")
    run = subprocess.run([sys.executable, ROOT / "examples" / "notebooks.py", out], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [str(out / f"{page.stem}.ipynb") for page in PAGES]
    return out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_nothing_of_a_page_is_lost(folder, page):
    cells = json.loads((folder / f"{page.stem}.ipynb").read_text())["cells"]
    text = page.read_text()
    blocks = re.findall(r"^ *```(\w+)$", text, re.M)
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) == len(blocks) > 0
    for language, cell in zip(blocks, code):
        source = "".join(cell["source"])
        if language == "python":
            ast.parse(source)
            assert source.splitlines()[0].strip() in text
        else:
            assert all(re.match(r"[!%#]", line) for line in source.splitlines())
    words = [word for cell in cells for line in cell["source"] for word in re.findall(r"\w+", line)]
    lost = set(re.findall(r"\w+", text)) - set(words) - {"bash", "python", "export"}
    assert lost == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_files(folder, page):
    texts = [cell for cell in json.loads((folder / f"{page.stem}.ipynb").read_text())["cells"]]
    for cell in texts:
        if cell["cell_type"] == "markdown":
            for _, target in notebooks.LINK.findall("".join(cell["source"])):
                assert (folder / target).exists()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_cells_have_what_the_format_asks_for(folder, page):
    found = json.loads((folder / f"{page.stem}.ipynb").read_text())
    assert (found["nbformat"], found["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in found["cells"]}) == len(found["cells"])
    of_code = {"cell_type", "id", "metadata", "source", "outputs", "execution_count"}
    for cell in found["cells"]:
        assert cell.keys() == of_code - (set() if cell["cell_type"] == "code" else {"outputs", "execution_count"})


def test_commands():
    script = "pip install a\ncd b\nexport X=1\npython -m c \\\n  --d\n# why\n"
    (before, code) = notebooks.cells_of(f"text\n\n- one\n\n  ```bash\n{script}  ```\n", "..")
    assert before["source"] == ["text\n", "\n", "- one"]
    assert "".join(code["source"]).split("\n") == [
        "%pip install a",
        "%cd b",
        "%env X=1",
        "!python -m c    --d",
        "# why",
    ]
