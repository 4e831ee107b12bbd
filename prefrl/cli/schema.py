"""The JSON Schema of a config file, for editors that complete and check YAML. Shipped as configs/schema.json."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from prefrl.components import TABLE, Role, Settings, plugins, settings_class
from prefrl.config import ROLES, Config
from prefrl.types import Json

REQUIRED = ["task", "reward", "learner"]


def schema() -> Json:
    """Every key of a config with its type and meaning; for a component, the settings of each built-in kind."""
    definitions: Json = {}
    properties = {name: _group(name, field.annotation, definitions) for name, field in Config.model_fields.items()}
    for name, field in Config.model_fields.items():
        properties[name]["description"] = field.description
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "prefrl config",
        "type": "object",
        "properties": properties,
        "required": REQUIRED,
        "additionalProperties": False,
        "$defs": definitions,
    }


def schema_of(cls: type[Settings]) -> Json:
    """The schema of a settings class; with its defaults, a learner says what it optimises."""
    made = cls.model_json_schema(ref_template="#/$defs/{model}")
    if not made.get("required") and (formula := cls().formula()):
        made["x-formula"] = formula
    return made


def described(role: Role, kind: str) -> Json:
    """The schema of one kind's settings, with its `$defs`.

    For a built-in kind it is taken from the file that is shipped: nothing is imported that the kind itself needs.
    """
    if kind in plugins(role):
        return schema_of(settings_class(role, kind))
    shipped = json.loads(files("prefrl.configs").joinpath("schema.json").read_text(encoding="utf-8"))
    name = TABLE[role][kind].partition(":")[2]
    return {**shipped["$defs"][name], "$defs": shipped["$defs"]}


def _group(name: str, annotation: Any, definitions: Json) -> Json:
    """The schema of one top-level key."""
    if name in ROLES:
        role = ROLES[name]
        classes = {settings_class(role, kind): kind for kind in TABLE[role]}  # several kinds may share one
        return {"oneOf": [_define(cls, definitions, kind) for cls, kind in classes.items()]}
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return _define(annotation, definitions, None)
    return {"type": "integer"}  # the seed


def _define(cls: type[Settings], definitions: Json, kind: str | None) -> Json:
    """File a settings class under its name, and refer to it. A component's kind must be spelled out."""
    made = schema_of(cls)
    made, inner = _apart(cls.__name__, made, made.pop("$defs", {}), definitions)
    definitions |= inner
    if kind is not None:
        made["required"] = sorted({"kind", *made.get("required", [])})
    definitions[cls.__name__] = made
    return {"$ref": f"#/$defs/{cls.__name__}"}


def _apart(outer: str, made: Json, inner: Json, known: Json) -> tuple[Json, Json]:
    """A schema and its `$defs`, with another name for those that are components of their own as well.

    As a part of another component they need not spell out their kind, and optimise nothing by themselves.
    """
    both = json.dumps([made, inner])
    clashing = {name: f"{outer}.{name}" for name, group in inner.items() if known.get(name, group) != group}
    for name, other in clashing.items():
        both = both.replace(f'"#/$defs/{name}"', f'"#/$defs/{other}"')
    made, inner = json.loads(both)
    return made, {clashing.get(name, name): group for name, group in inner.items()}


def text() -> str:
    """The schema as it is shipped."""
    return json.dumps(schema(), indent=1, ensure_ascii=False) + "\n"
