"""How the modules of the package depend on each other and on other libraries."""

import ast
from graphlib import TopologicalSorter

from places import ROOT
from processes import run_python

PACKAGE = ROOT / "analytic_rasterizer"
OPTIONAL = ("matplotlib", "scipy", "PIL", "gsply", "torchmetrics")


def modules():
    """{dotted name: path} of the package's modules, the extension among them, which has no source here."""
    found = {"analytic_rasterizer._C": None}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name, path, known):
    """The modules of the package that a module imports, wherever in the file."""
    found = set()
    parents = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*parents[: len(parents) + 1 - node.level], *([node.module] if node.module else [])])
            base = base if node.level else node.module
            # A package is imported for its own names only where these are not its modules.
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                found.add(inner if inner in known else base)
    return {module for module in found if module in known and module != name}


def test_imports_go_one_way():
    known = modules()
    graph = {name: imported(name, path, known) for name, path in known.items() if path}
    assert "analytic_rasterizer.cameras.camera" in graph["analytic_rasterizer.io.views"]
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError, which names the modules
    assert order.index("analytic_rasterizer.sh") < order.index("analytic_rasterizer.render.rasterizer")


def test_no_optional_library_is_imported_with_the_package():
    code = "import sys, analytic_rasterizer; print(*(name for name in {} if name in sys.modules))"
    assert run_python(code.format(OPTIONAL)).split() == []
