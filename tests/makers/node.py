"""Modules of the viewer's page, run without a browser."""

import json
import shutil
import subprocess

import pytest

from analytic_rasterizer.viewer import pages


def run_node(folder, modules, script):
    """What a script that imports these modules of the page prints, as JSON."""
    if shutil.which("node") is None:
        pytest.skip("needs node")
    for name in modules:
        (folder / name).write_text(pages.page_file(name))
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "script.js").write_text(script)
    done = subprocess.run(["node", "script.js"], cwd=folder, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
