"""How the documents are built: `sphinx-build -W docs docs/_build`."""

import re
from importlib.metadata import version as installed
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from pydantic import BaseModel
from sphinx.application import Sphinx

from prefrl.cli.describe import ALWAYS, rows
from prefrl.cli.schema import described, schema_of

project = "prefrl"
author = "the prefrl authors"
copyright = "2026, the prefrl authors"
version = release = installed("prefrl")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "prefrl"
html_show_sphinx = False

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
ALIASES = ("Arrays", "Bools", "Fields", "Floats", "Integers", "Json", "Metrics", "State")
autodoc_type_aliases = {name: name for name in ALIASES}
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
default_role = "code"  # in docstrings, single backticks are code
add_module_names = False
suppress_warnings = ["ref.python"]  # the role Store and the class Store have one name

MODULES = re.compile(r"~?\b(?:\w+\.)+(?=[A-Z])|~?\bnumpy\.(?=ndarray|dtype)")
SHAPES = re.compile(r"(?<=ndarray)\[tuple\[Any, \.\.\.\], ~?dtype\[[^\]]*(?:\[Any\])?\]\]")


def plain(text: str, special: str) -> str:
    """Text that the parser takes as it stands, but for what is in backticks."""
    parts = text.split("`")
    return "`".join(re.sub(special, r"\\\g<0>", part) if i % 2 == 0 else part for i, part in enumerate(parts))


def escape_docstring(
    _app: Sphinx, _what: str, _name: str, _obj: object, _options: object, lines: list[str], **_: object
) -> None:
    """Docstrings are plain English: a star or a bar is no markup."""
    if lines[0].startswith("Alias for field number"):  # Python's own, of a field without a docstring
        lines.clear()
    lines[:] = plain("\n".join(lines), r"[*|]|_(?!\w)").split("\n")


def short_signature(
    _app: Sphinx, _what: str, _name: str, obj: object, _options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Settings have their fields in tables; types in signatures go without the names of their modules."""
    if signature == "(*args, **kwargs)" or (isinstance(obj, type) and issubclass(obj, BaseModel)):
        return "", None
    signature, returns = (part and SHAPES.sub("", MODULES.sub("", part)) for part in (signature, returns))
    return signature, returns


def told(meaning: str, indent: str = "  ") -> str:
    """An attribute's docstring as Markdown; its later paragraphs belong to the same setting."""
    return plain(meaning, r"[*_<\[$|]").replace("\n", f"\n{indent}")


def shown_type(kind: str, default: str) -> str:
    """Its type and its default; rows without a type head the settings of one choice."""
    if not kind:
        return "where it is chosen:"
    return f"`{kind}`, default `{default}`." if default else f"`{kind}`."


class SettingsOf(Directive):
    """The settings of one component, from its class: `{settings} learners text`, or `{settings} loop`."""

    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        found: Any = schema_of(ALWAYS[self.arguments[0]]) if len(self.arguments) == 1 else described(*self.arguments)
        lines = [told(found.get("description", ""), ""), ""]
        for name, kind, default, meaning in rows(found, found.get("$defs", {})):
            if name.strip() == "kind":
                continue
            lines += [f"`{name.strip()}`", f": {shown_type(kind, default)} {told(meaning)}".rstrip(), ""]
        if formula := found.get("x-formula"):
            lines += ["What it optimises, with the defaults:", "", "```text", *formula.splitlines(), "```"]
        at = nodes.container(classes=["settings"])
        text = [line for block in lines for line in block.split("\n")]
        self.state.nested_parse(StringList(text, self.arguments[0]), self.content_offset, at)
        return [at]


def setup(app: Sphinx) -> None:
    """Add what is ours."""
    app.add_directive("settings", SettingsOf)
    app.connect("autodoc-process-docstring", escape_docstring)
    app.connect("autodoc-process-signature", short_signature)
