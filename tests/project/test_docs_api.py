"""Public names: each has a docstring that describes its parameters, and is in the API reference of the site."""

import ast
import functools
import importlib
import inspect
import re

import pytest
from places import ROOT

import analytic_rasterizer

PACKAGE = ROOT / "analytic_rasterizer"


def module_names():
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if not any(part.startswith("_") and part != "__init__" for part in parts):
            yield ".".join(part for part in parts if part != "__init__")


@functools.cache
def tree_of(module):
    path = ROOT.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    path = path if path.exists() else path.with_suffix(".pyi")
    return ast.parse(path.read_text()), path.name == "__init__.py"


def exports(module):
    """The names in `__all__` that the source of a module states."""
    for statement in tree_of(module)[0].body:
        if isinstance(statement, ast.Assign) and getattr(statement.targets[0], "id", None) == "__all__":
            return ast.literal_eval(statement.value)
    return []


# Packages, and modules that the package exports. Those of single dialects export the names of other repositories, which
# docs/dialects.md describes together.
MODULES = [
    name
    for name in module_names()
    if exports(name) and (tree_of(name)[1] or name.rpartition(".")[2] in analytic_rasterizer.__all__)
]
NAMES = [(module, name) for module in MODULES for name in exports(module)]


def comment_of_value(module, name):
    """The string after the assignment of a module's variable, in the module that assigns it."""
    tree, is_package = tree_of(module)
    for statement in ast.walk(tree):
        if isinstance(statement, ast.ImportFrom) and name in [alias.asname or alias.name for alias in statement.names]:
            parts = module.split(".") if is_package else module.split(".")[:-1]
            parts = parts[: len(parts) - statement.level + 1] + (statement.module or "").split(".")
            original = next(alias.name for alias in statement.names if name == (alias.asname or alias.name))
            return comment_of_value(".".join(filter(None, parts)), original)
    for statement, following in zip(tree.body, tree.body[1:]):
        targets = getattr(statement, "targets", [getattr(statement, "target", None)])
        if name in [getattr(target, "id", None) for target in targets]:
            is_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            return following.value.value if is_text else ""
    return ""


def public_members(cls):
    """Methods and properties that a class defines by itself, with docstrings of their own or of a base."""
    for name, member in vars(cls).items():
        if not name.startswith("_") and (inspect.isroutine(member) or isinstance(member, (property, classmethod))):
            yield name, getattr(cls, name)


def described(docstring):
    """Parameters and attributes that sections of a docstring describe."""
    sections = re.findall(r"^(?:Args|Attributes):\n((?:    .*\n|\n)+)", docstring + "\n", re.M)
    entries = re.findall(r"^    (\**\w+(?:, \**\w+)*):", "\n".join(sections), re.M)
    return {name.lstrip("*") for entry in entries for name in entry.split(", ")}


def undescribed(thing, docstring):
    """Parameters that a docstring neither lists nor mentions, nor leaves to another by name."""
    if re.search(r"[Aa]rguments[^.]* those\s+of\s+`|others: As of", docstring):
        return []
    parameters = inspect.signature(thing).parameters.values()
    names = [p.name for p in parameters if p.name not in ("self", "cls", "args", "kwargs") and p.name[0] != "_"]
    known = described(docstring)
    return [name for name in names if name not in known and not re.search(rf"\b{name}\b", docstring)]


@pytest.mark.parametrize(("module", "name"), NAMES, ids=map(".".join, NAMES))
def test_docstrings(module, name):
    thing = getattr(importlib.import_module(module), name)
    if not (inspect.isclass(thing) or inspect.isroutine(thing) or inspect.ismodule(thing)):
        assert comment_of_value(module, name).strip(), "a value is described by a string after its assignment"
        return
    own = vars(thing).get("__doc__") if inspect.isclass(thing) else inspect.getdoc(thing)
    assert own, "no docstring"
    docstring = inspect.cleandoc(own)
    if inspect.isclass(thing):
        docstring += "\n" + (inspect.getdoc(vars(thing).get("__init__")) or "")
        if vars(thing).keys() & {"__init__", "_fields", "__dataclass_fields__"}:
            assert not undescribed(thing, docstring)
        for member, value in public_members(thing):
            text = inspect.getdoc(value)
            assert text, f"{member} has no docstring"
            if inspect.isroutine(value):
                assert not undescribed(value, text), member
    elif inspect.isroutine(thing) and thing.__module__ != "analytic_rasterizer._C":
        assert not undescribed(thing, docstring)


def test_reference_has_every_name():
    pages = "\n".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.md"))
    shown = set(re.findall(r"^::: ([\w.]+)$", pages, re.M))
    wanted = {f"{module}.{name}" for module, name in NAMES}
    assert not {name for name in wanted - shown if name.rpartition(".")[0] not in shown}
    for module in MODULES:  # which nothing else may have imported in this process
        importlib.import_module(module)
    for name in shown:
        found = functools.reduce(getattr, name.split(".")[1:], analytic_rasterizer)
        assert not inspect.ismodule(found) or found.__doc__


def test_pages_are_in_the_navigation():
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert pages <= listed, "pages that mkdocs.yml does not list"
