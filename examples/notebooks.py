"""Writes the tutorials as Jupyter notebooks: python examples/notebooks.py FOLDER

Text becomes cells of Markdown, Python becomes cells of code, and commands become cells of the shell, with `pip` and
`cd` as Jupyter's own, so that they last. Links lead to the files of this clone.
"""

import argparse
import json
import os
import re
import textwrap
from pathlib import Path

from analytic_rasterizer import io

TUTORIALS = Path(__file__).resolve().parents[1] / "docs" / "tutorials"
BLOCK = re.compile(r"^( *)```(python|bash)\n(.*?)^\1```$\n?", re.M | re.S)
LINK = re.compile(r"(\]\()(?![a-z]+:|#)([^)#\s]+)")


def cells_of(text: str, links: str) -> list[dict]:
    """The cells of a page, whose links to files begin with `links` in the notebook."""
    cells, end = [], 0
    for block in BLOCK.finditer(text):
        cells.append(_text(text[end : block.start()], links))
        language, code = block[2], textwrap.dedent(block[3])
        cells.append(_code(code if language == "python" else _as_commands(code)))
        end = block.end()
    cells.append(_text(text[end:], links))
    cells = [cell for cell in cells if cell["source"]]
    return [cell | {"id": f"cell-{number}"} for number, cell in enumerate(cells)]


def _text(text: str, links: str) -> dict:
    linked = LINK.sub(lambda found: f"{found[1]}{links}/{found[2]}", text.strip())
    return {"cell_type": "markdown", "metadata": {}, "source": _lines(linked)}


def _code(code: str) -> dict:
    source = _lines(code.strip())
    return {"cell_type": "code", "metadata": {}, "execution_count": None, "outputs": [], "source": source}


def _as_commands(script: str) -> str:
    """A shell's lines as Jupyter runs them: `cd` and `pip` with %, so that they act on the notebook; others with !."""
    lines = script.replace("\\\n", " ").splitlines()
    return "\n".join(_as_command(line.strip()) for line in lines if line.strip())


def _as_command(line: str) -> str:
    if line.startswith("#"):
        return line
    name, _, rest = line.partition(" ")
    if name == "export":
        return "%env " + rest
    return ("%" if name in ("cd", "pip") else "!") + line


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def notebook(page: Path, folder: Path) -> dict:
    """The notebook of a page, for the folder in which it will be."""
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    cells = cells_of(page.read_text(), os.path.relpath(page.parent, folder))
    return {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    folder = parser.parse_args().folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for page in sorted(TUTORIALS.glob("*.md")):
        path = folder / f"{page.stem}.ipynb"
        io.write_text(path, json.dumps(notebook(page, folder), indent=1, ensure_ascii=False) + "\n")
        print(path)


if __name__ == "__main__":
    main()
