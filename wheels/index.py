"""Writes the pages of an index of wheels (PEP 503), one for each pair of torch and CUDA.

    python wheels/index.py FOLDER

FOLDER/pt213cpu/analytic-rasterizer/*.whl are wheels for torch 2.13 without CUDA, FOLDER/pt211cu130/... for torch 2.11
with CUDA 13.0. pip takes the wheel that fits its Python and its system from the folder that it is given, and has no
other torch to choose there, so that the installed one stays:

    pip install --index-url FOLDER/pt213cpu analytic-rasterizer

Any web server can serve FOLDER; without one, the address is file:///path/to/FOLDER/pt213cpu. The folders are indexes of
their own because pip cannot choose by the torch that is installed.
"""

import email
import hashlib
import html
import re
import sys
import zipfile
from pathlib import Path

PAIR = re.compile(r"pt(\d)(\d+)(cpu|cu\d+)")


def metadata_of(wheel: Path) -> email.message.Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if re.fullmatch(r"[^/]+\.dist-info/METADATA", n))
        return email.message_from_bytes(archive.read(name))


def torch_minor_of(wheel: Path) -> str:
    """The minor version of torch that a wheel requires, such as 2.13. Raises ValueError without a requirement."""
    required = (
        re.fullmatch(r"torch==(\d+\.\d+)\.\*", text) for text in metadata_of(wheel).get_all("Requires-Dist", [])
    )
    found = next((match[1] for match in required if match), None)
    if found is None:
        raise ValueError(f"{wheel} does not require one minor version of torch (torch==X.Y.*)")
    return found


def page(title: str, links: list[str]) -> str:
    body = "".join(f"    {link}<br>\n" for link in links)
    return f"<!DOCTYPE html>\n<html>\n  <head><title>{title}</title></head>\n  <body>\n{body}  </body>\n</html>\n"


def link_to(wheel: Path) -> str:
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    python = html.escape(metadata_of(wheel)["Requires-Python"] or "")
    return f'<a href="{wheel.name}#sha256={digest}" data-requires-python="{python}">{wheel.name}</a>'


def write_index(folder: Path) -> list[Path]:
    """Writes all pages below `folder`, and returns the wheels that they list.

    Raises:
        ValueError: There is no folder of a pair, or a wheel requires another torch than its folder says.
    """
    pairs = sorted(path for path in folder.iterdir() if path.is_dir() and PAIR.fullmatch(path.name))
    if not pairs:
        raise ValueError(f"{folder} has no folder of a pair, such as pt213cpu or pt211cu130")
    listed = []
    for pair in pairs:
        major, minor, _ = PAIR.fullmatch(pair.name).groups()
        projects = sorted(path for path in pair.iterdir() if path.is_dir())
        for project in projects:
            wheels = sorted(project.glob("*.whl"))
            for wheel in wheels:
                if torch_minor_of(wheel) != f"{major}.{minor}":
                    raise ValueError(
                        f"{wheel} requires torch {torch_minor_of(wheel)}, its folder is for {major}.{minor}"
                    )
            (project / "index.html").write_text(page(project.name, [link_to(wheel) for wheel in wheels]))
            listed += wheels
        names = [f'<a href="{project.name}/">{project.name}</a>' for project in projects]
        (pair / "index.html").write_text(page(pair.name, names))
    names = [f'<a href="{pair.name}/">{pair.name}</a>' for pair in pairs]
    (folder / "index.html").write_text(page("Wheels by torch and CUDA", names))
    return listed


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        print("\n".join(map(str, write_index(Path(sys.argv[1])))))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
