"""What the API reference is built with: docstrings as they are written here, and lists of settings."""

import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.inspect import TypeAliasForwardRef
from typing_extensions import is_protocol

from prefrl.cli.describe import ALWAYS, setting_rows
from prefrl.cli.schema import described, schema_of
from prefrl.components import TABLE
from prefrl.config import Config
from prefrl.types import Json

CODE = re.compile(r"`([^`]+)`")


def as_rst(text: str) -> str:
    """A line of a docstring, in which `code` stands in single backticks and nothing else is markup."""
    parts = CODE.split(text)
    parts[::2] = [re.sub(r"([\\*|]|_\b)", r"\\\1", part) for part in parts[::2]]
    parts[1::2] = [f"``{part}``" for part in parts[1::2]]
    text = parts[0]
    for code, after in zip(parts[1::2], parts[2::2], strict=True):
        # Code beside a letter, as in `x`s, needs a mark between them.
        text += ("\\ " if text[-1:].isalnum() else "") + code + ("\\ " if after[:1].isalnum() else "") + after
    return text


def read(_app: Sphinx, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    lines[:] = [as_rst(line) for line in lines]


def call(_app: Sphinx, what: str, _name: str, obj: Any, _options: object, given: str, back: str) -> tuple[str, str]:
    """How something is called: nobody makes a Protocol, and a config comes from `load`."""
    bare = what == "class" and (issubclass(obj, BaseModel) or is_protocol(obj))
    return ("" if bare else given), back


class SettingsList(SphinxDirective):
    """`{settings} learners`: a section for each kind of a role; or what `config`, `loop` or `fitting` consist of."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        made = list(_listed(self.arguments[0]))
        for node in (inner for outer in made for inner in outer.findall()):
            self.set_source_info(node)
        return made


def _listed(name: Any) -> Iterator[nodes.Node]:
    if name == "config":
        fields = Config.model_fields.items()
        yield nodes.definition_list("", *(_item(name, "", "", field.description or "") for name, field in fields))
        return
    if name in ALWAYS:
        yield from _settings(schema_of(ALWAYS[name]))
        return
    classes: dict[str, list[str]] = {}  # several kinds may share one
    for kind, at in TABLE[name].items():
        classes.setdefault(at, []).append(kind)
    yield from (_section(name, kinds) for kinds in classes.values())


def _section(role: Any, kinds: list[str]) -> nodes.section:
    made = nodes.section(ids=[f"{role}-{kind}".replace("_", "-") for kind in kinds])
    made += nodes.title("", "", *_inline(", ".join(f"`{kind}`" for kind in kinds)))
    made += list(_settings(described(role, kinds[0])))
    return made


def _settings(schema: Json) -> Iterator[nodes.Node]:
    yield nodes.paragraph("", "", *_inline(" ".join(schema.get("description", "").split())))
    if formula := schema.get("x-formula"):
        yield nodes.literal_block(formula, formula, language="text")
    rows = [row for row in setting_rows(schema, schema.get("$defs", {})) if row[0] != "kind"]
    if rows:
        yield nodes.definition_list("", *(_item(*row) for row in rows))


def _item(name: str, kind: str, default: str, meaning: str) -> nodes.definition_list_item:
    told = [kind, default if default in ("", "required") else f"default {default}"]
    term = nodes.term("", "", nodes.literal(name.strip(), name.strip()))
    marks = [nodes.classifier("", ", ".join(filter(None, told)))] if any(told) else []
    said = nodes.definition("", nodes.paragraph("", "", *_inline(" ".join(meaning.split()))))
    return nodes.definition_list_item("", term, *marks, said)


def _inline(text: str) -> list[nodes.Node]:
    parts = CODE.split(text)
    return [nodes.literal(part, part) if i % 2 else nodes.Text(part) for i, part in enumerate(parts) if part]


def _named(alias: TypeAliasForwardRef) -> str:
    return alias.name


def setup(app: Sphinx) -> dict[str, str | bool]:
    # In a union, `Floats | None`, Sphinx 9 prints an alias as Python does.
    setattr(TypeAliasForwardRef, "__repr__", _named)  # noqa: B010
    app.add_directive("settings", SettingsList)
    app.connect("autodoc-process-docstring", read)
    app.connect("autodoc-process-signature", call)
    return {"version": "1", "parallel_read_safe": True}
