"""What the site (mkdocs.yml) does beyond Markdown: links out of docs/, and pages from files at the top of the tree.

A page reads the same on GitHub, where links are relative to the file. Here a link to another page becomes a link to
that page, a link to a file outside of docs/ becomes one to the repository's address (of pyproject.toml), or without an
address the path as text. A link to a file that does not exist is a warning, which the strict build fails on.
"""

import logging
import os
import pathlib
import re

from mkdocs.structure.files import File

ROOT = pathlib.Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TOP_PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}  # by their paths in the site
FENCED = re.compile(r"(^ *```.*?^ *```$)", re.M | re.S)
ITEM = re.compile(r"( {0,4})([-*+]|\d+\.) ")
# Code, in which nothing is a link; or a link, whose text may have code in it.
LINK = re.compile(r"`[^`]+`|(?P<image>!?)\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^)\s]+)\)")

# By class: figures on white, which a dark page shows inverted; figures whose labels a phone can read, side by side
# where there is room.
PHONE = ("moving", "popping", "conventions", "accuracy_time", "errors_weight", r"footprints_\w+", r"gallery/\w+")
FIGURES = {"plot": ("growth",), "small": PHONE}
# A photograph and its rendering in one paragraph become one picture with a divider between them.
PAIR = re.compile(r"<p>(<img[^>]*_photograph\.[^>]*>)\s*(<img[^>]*_rendering\.[^>]*>)</p>")
DIVIDED = """<div class="divided">\\1\\2<span>photograph</span><span>rendering</span>
<input type="range" value="50" aria-label="Divider between photograph and rendering"
  oninput="this.parentNode.style.setProperty('--at', this.value + '%')"></div>"""
NAMES = re.compile(r"(?<!\[)`([A-Za-z_][\w.]*)`")

log = logging.getLogger("mkdocs.hooks.links")


def on_files(files, config):
    for source, page in TOP_PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def address_of_files():
    """Where the repository shows its files, by the variable of pyproject.toml; empty without an address."""
    address = re.search(r'^repository = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.M)[1]
    return f"{address.rstrip('/')}/blob/main" if address else ""


def on_page_markdown(markdown, page, config, files):
    folder, name = os.path.split(page.file.abs_src_path)
    source = pathlib.Path(os.path.realpath(folder), name)
    if page.file.src_uri == "api/index.md":
        markdown = with_names(markdown)
    return as_python_markdown(with_links(markdown, source, page.file.src_uri, address_of_files()))


def on_page_content(html, page, config, files):
    """Figures get their class, pairs their divider."""
    for name, files_of in FIGURES.items():
        figures = rf'<img(?=[^>]*src="[^"]*images/(?:{"|".join(files_of)})\.[^"]*")'
        html = re.sub(figures, f'<img class="{name}"', html)
    return PAIR.sub(DIVIDED, html)


def with_names(markdown):
    """Rows of the table of the API with names that are links to where they are described."""
    return "\n".join(
        NAMES.sub(r"[`\1`][analytic_rasterizer.\1]", line) if line.startswith("| [") else line
        for line in markdown.split("\n")
    )


def with_links(markdown, source, page, repository):
    """The text of the file `source`, shown as `page`, with its links as the site needs them; code stays as it is."""

    def replace(match):
        image, text, target = match["image"], match["text"], match["target"]
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        path, _, heading = target.partition("#")
        file = pathlib.Path(os.path.normpath(source.parent / path))
        if not file.exists():
            log.warning(f"{source.relative_to(ROOT)}: link to {target}, which does not exist")
            return match[0]
        name = file.relative_to(ROOT).as_posix()
        shown = TOP_PAGES.get(name) or (file.relative_to(DOCS).as_posix() if file.is_relative_to(DOCS) else None)
        if shown is not None and file.is_file():
            shown = os.path.relpath(shown, os.path.dirname(page) or ".")
            return f"{image}[{text}]({shown}{'#' + heading if heading else ''})"
        if repository and not image:
            return f"[{text}]({repository.rstrip('/')}/{name}{'#' + heading if heading else ''})"
        plain = text.strip("`/")
        return f"`{name}`" if plain in (name, path, file.name) else f"{text} (`{name}`)"

    pieces = FENCED.split(markdown)  # of which every second one is fenced code
    pieces[::2] = [
        LINK.sub(lambda match: replace(match) if match["target"] else match[0], text) for text in pieces[::2]
    ]
    return "".join(pieces)


def as_python_markdown(markdown):
    """Lists as GitHub reads them: nested by two spaces, and without an empty line before the first item."""
    pieces = FENCED.split(markdown)
    pieces[::2] = map(_with_lists, pieces[::2])
    return "".join(pieces)


def _with_lists(text):
    lines, in_list, before = [], False, ""
    for line in text.split("\n"):
        item = ITEM.match(line)
        if item and not in_list and before:
            lines.append("")
        if item:
            in_list, line = True, line if len(item[1]) in (0, 4) else "    " + line.lstrip()
        elif line and not line.startswith(" ") and not before:
            in_list = False
        lines.append(line)
        before = line.strip()
    return "\n".join(lines)
