"""The page and a scene in one HTML file, which opens without a server and without a network."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re

from ..io import write_bytes
from .compressed import compress
from .packing import PackedScene
from .pages import MODULES, WORKER, content_security_policy, page_file

MAX_EMBEDDED = 500_000_000
"""Characters of an array in an exported file: browsers hold no longer string."""


def export_page(path, scene: PackedScene, *, exact: bool = False) -> int:
    """Writes the page and the scene into one file, `path`, and returns its size in bytes.

    The file loads nothing: its Content-Security-Policy allows the hashes of its own script and style and no connection.

    Args:
        scene: What `pack_scene` returned.
        exact: Keep all numbers as they are. Otherwise they are rounded (`compressed.py`), and the file is
            several times smaller. Compact scenes are always kept.

    Raises:
        ValueError: A scene too large for one file.
        OSError: The file cannot be written.
    """
    style, script = page_file("style.css"), bundle(MODULES)
    policy = content_security_policy(
        script=_source_hash(script), style=_source_hash(style), connect="'none'", worker="blob:"
    )
    meta = scene.meta
    if exact or meta["compact"] is not None:
        arrays = {"geometry": _zipped(scene.geometry), "harmonics": _zipped(scene.harmonics)}
    else:
        compressed, columns = compress(scene)
        meta = meta | {"compressed": compressed}
        arrays = {"columns": columns}
    data = [
        _element("scene", "application/json", json.dumps(meta, allow_nan=False).replace("<", "\\u003c")),
        *(_element(name, "application/octet-stream", _text(array)) for name, array in arrays.items()),
        _element("sorter", "text/plain", page_file(WORKER)),
    ]
    html = page_file("index.html")
    html = _replace_once(
        html,
        '<meta charset="utf-8">',
        f'<meta charset="utf-8">\n<meta http-equiv="Content-Security-Policy" content="{policy}">',
    )
    html = _replace_once(html, '<link rel="stylesheet" href="style.css">', f"<style>{style}</style>")
    html = _replace_once(
        html,
        '<script type="module" src="main.js"></script>',
        "\n".join([*data, f'<script type="module">{script}</script>']),
    )
    content = html.encode()
    write_bytes(path, content)
    return len(content)


def bundle(names) -> str:
    """The modules as one: their text in this order, without imports and exports.

    They then share one scope, so that no two of them may declare the same name.
    """
    parts = []
    for name in names:
        text = re.sub(r"^import\s[^;]*;\n", "", page_file(name), flags=re.MULTILINE)
        parts.append(re.sub(r"^export\s+", "", text, flags=re.MULTILINE))
    return "\n".join(parts)


def _zipped(data: bytes) -> bytes:
    return gzip.compress(data, 6, mtime=0)


def _text(data: bytes) -> str:
    text = base64.b64encode(data).decode()
    if len(text) > MAX_EMBEDDED:
        raise ValueError(
            f"the scene is too large for one file: an array takes {len(text) / 1e6:.0f} MB, and browsers hold "
            f"{MAX_EMBEDDED / 1e6:.0f} MB; serve it instead"
        )
    return text


def _element(name: str, kind: str, text: str) -> str:
    return f'<script type="{kind}" id="data-{name}">{text}</script>'


def _source_hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _replace_once(text: str, old: str, new: str) -> str:
    before, found, after = text.partition(old)
    if not found:
        raise ValueError(f"index.html of the viewer must contain {old}")
    return before + new + after
