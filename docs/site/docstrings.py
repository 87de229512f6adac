"""How the API reference reads docstrings, for mkdocstrings (mkdocs.yml).

Docstrings are Google's, with two freedoms: parameters may share a description ("width, height: Size, px."), and what is
returned may be a text in place of named values. Names of the library in them become links. Options that are declared
(analytic_rasterizer/declared.py) are attributes with the text of their declaration.
"""

import ast
import re
import textwrap

import griffe

RETURNS = re.compile(r"^Returns:\n((?:    .*\n|\n)+)", re.M)
NAMED = re.compile(r"(?=^\w+: )", re.M)
NAME = re.compile(r"(?<!\[)`([A-Za-z_][\w.]*)`(?!\])")


class Docstrings(griffe.Extension):
    def on_package(self, *, pkg, **kwargs):
        self.package = pkg
        self.declared = {}  # default and text of options, by their class and name
        self._find_declared(pkg)
        self._visit(pkg)

    def _find_declared(self, parent):
        for member in parent.members.values():
            if member.is_alias or not (member.is_module or member.is_class):
                continue
            self._find_declared(member)
            if member.is_class:
                self.declared[member.name] = dict(filter(None, map(_declaration, member.members.values())))
                for base in member.bases:
                    self.declared[member.name] |= self.declared.get(str(base), {})

    def _add_declared(self, kind):
        """Options in a class's docstring and signature: its own, and those of parts, which it has as PART.NAME."""
        options = dict(self.declared.get(kind.name, {}))
        for member in kind.members.values():
            part, _, name = str(getattr(member, "value", "")).partition(".")
            if name == member.name and name in self.declared.get(part, ()):
                options[name] = self.declared[part][name]
        if not options:
            return
        for name in options.keys() & kind.members.keys():
            kind.members[name].value = options[name][0]
        head, raises, rest = kind.docstring.value.partition("Raises:\n")
        entries = "".join(f"    {name}: {text}\n" for name, (_, text) in options.items())
        kind.docstring.value = f"{head.rstrip()}\n\nAttributes:\n{entries}\n{raises}{rest}"

    def _visit(self, parent):
        for member in parent.members.values():
            if member.is_alias:
                continue
            if member.docstring:
                if member.is_class:
                    self._add_declared(member)
                self._read(member)
            if member.is_module or member.is_class:
                self._visit(member)

    def _read(self, described):
        docstring = described.docstring
        docstring.value = NAME.sub(lambda match: self._linked(match, described), docstring.value)
        docstring.value = RETURNS.sub(_items, docstring.value + "\n")
        for section in docstring.parsed:  # which keeps what it has parsed
            if section.kind in (griffe.DocstringSectionKind.parameters, griffe.DocstringSectionKind.attributes):
                for entry in section.value:
                    if ", " in entry.name and entry.annotation is None:
                        entry.annotation = _annotation(described, entry.name.partition(", ")[0])

    def _linked(self, match, described):
        """A name of the class that is described, of its package, or of the library, with its link."""
        first, *others = match[1].split(".")
        around = described if described.is_class else described.parent
        if not others and around is not None and around.is_class and _is_described(around, first):
            same = described is around.members[first]
            return match[0] if same else f"[{match[0]}][{around.path}.{first}]"
        if described.path.endswith(f".{first}"):
            return match[0]
        module = described if described.is_module else described.module
        while module is not None:
            shown = module.is_package or module.name in self.package.exports
            if shown and first in (module.exports or ()):
                found = f"{module.path}.{first}"
                if len(others) == 1 and _is_described(module[first], others[0]):
                    found += f".{others[0]}"
                return f"[{match[0]}][{found}]"
            module = module.parent
        return match[0]


def _declaration(member):
    """Name, default and text of a class's attribute that is `option(default, text, ..)`."""
    value = str(member.value) if not member.is_alias and member.is_attribute and member.value is not None else ""
    if not value.startswith("option("):
        return None
    default, text = ast.parse(value, mode="eval").body.args[:2]
    return member.name, (ast.unparse(default), ast.literal_eval(text))


def _is_described(parent, name):
    """Whether a member has a heading of its own in the reference."""
    member = parent.members.get(name)
    return member is not None and not name.startswith("_") and bool(member.docstring)


def _items(match):
    """The section as griffe reads it: an item for every name, or one without a name."""
    text = textwrap.dedent(match[1]).strip("\n")
    items = NAMED.split(text)[1:] if NAMED.match(text) else [f": {text}"]
    lines = "\n".join(textwrap.indent(item.rstrip("\n"), "    ").lstrip() for item in items)
    return "Returns:\n" + textwrap.indent(lines, "    ") + "\n\n"


def _annotation(described, name):
    if described.is_class and name in described.members:
        return described.members[name].annotation
    parameters = getattr(described, "parameters", None)
    return parameters[name].annotation if parameters is not None and name in parameters else None
