"""`prefrl describe`: a component's settings, what they mean, and what a learner optimises, as a formula."""

from __future__ import annotations

import json
from collections.abc import Iterator

from rich.console import RenderableType
from rich.markup import escape
from rich.padding import Padding
from rich.text import Text

from prefrl.cli.console import table
from prefrl.cli.schema import described, schema_of
from prefrl.components import TABLE, ConfigError, Role, Settings, kinds, suggest
from prefrl.config import Config, presets
from prefrl.fit.settings import FittingSettings
from prefrl.loop import LoopSettings
from prefrl.types import Json

ALWAYS: dict[str, type[Settings]] = {"fitting": FittingSettings, "loop": LoopSettings}
WORDS = {"integer": "int", "number": "float", "boolean": "bool", "string": "str", "object": "mapping", "null": "null"}
SIGNS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def explain(name: str | None) -> list[RenderableType]:
    """What a person reads about a kind or a preset; without a name, the kinds there are."""
    if name is None:
        rows = [(role[:-1], ", ".join(kinds(role))) for role in TABLE]
        return [table("kinds: prefrl describe KIND", ("role", "kinds"), [*rows, ("always there", ", ".join(ALWAYS))])]
    if name in presets():
        return [_yaml(Config.load(name))]
    if name in ALWAYS:
        return _component(name, schema_of(ALWAYS[name]))
    roles: list[Role] = [role for role in TABLE if name in kinds(role)]
    if roles:
        return [part for role in roles for part in _component(f"{role[:-1]} kind {name}", described(role, name))]
    parts = dict(_parts())
    if name not in parts:
        known = [*ALWAYS, *(kind for role in TABLE for kind in kinds(role)), *parts, *presets()]
        raise ConfigError(f"nothing is called {name!r}; {suggest(name, known)}")
    title, group = parts[name]
    return _component(title, group)


def _parts() -> Iterator[tuple[str, tuple[str, Json]]]:
    """Kinds of a part of a component, a learner's policy say: its name, and where it is set with its settings."""
    every = [(role, kind) for role in TABLE for kind in kinds(role)]
    for role, kind in every:
        whole = described(role, kind)
        for setting, one in whole["properties"].items():
            for name, at in _kinds(one).items():
                group = {**whole["$defs"][_name({"$ref": at})], "$defs": whole["$defs"]}
                yield name, (f"{role[:-1]}.{setting}.kind={name}, with {role[:-1]}.kind={kind}", group)


def _component(title: str, described: Json) -> list[RenderableType]:
    intro = Text(described.get("description", ""))
    rows = list(setting_rows(described, described.get("$defs", {})))
    shown = table(title, ("setting", "type", "default", "meaning"), rows)
    return [intro, Text(), shown, *_formula(described.get("x-formula", ""))]


def setting_rows(described: Json, groups: Json, prefix: str = "") -> Iterator[tuple[str, str, str, str]]:
    """A row for each setting; those of a group are told one by one, as `group.name`."""
    for name, setting in described["properties"].items():
        if "$ref" in setting:
            yield from setting_rows(groups[_name(setting)], groups, f"{prefix}{name}.")
        elif kinds := _kinds(setting):
            of_kinds = {kind: groups[_name({"$ref": at})] for kind, at in kinds.items()}
            default = setting["default"]["kind"] if setting["default"] else "null"
            yield f"{prefix}{name}.kind", " | ".join(of_kinds), default, setting.get("description", "")
            for kind, group in of_kinds.items():
                own = {**group, "properties": {k: x for k, x in group["properties"].items() if k != "kind"}}
                yield f"{prefix}{name}.kind={kind}", "", "", group.get("description", "")
                yield from setting_rows(own, groups, f"  {prefix}{name}.")
        else:
            default = _default(setting, name in described.get("required", []))
            yield prefix + name, _type(setting, ", "), default, setting.get("description", "")


def _yaml(config: Config) -> Text:
    """A config as a file that can be run; what its learner optimises stands in comments."""
    formula = config.learner.formula()
    lines = ["what it optimises:", *formula.splitlines()] if formula else []
    return Text(config.dump() + "".join(f"# {line}\n" for line in lines), end="")


def _formula(formula: str) -> list[RenderableType]:
    """The objective, of learners that can spell it out."""
    return [Text("\nwhat it optimises", style="bold"), Padding(escape(formula), (0, 2))] if formula else []


def _type(setting: Json, between: str = " ") -> str:
    """The type in words, with its bounds; or the values that it may have."""
    if "$ref" in setting:
        return _name(setting)
    if "anyOf" in setting:
        return " | ".join(map(_type, setting["anyOf"]))
    if "enum" in setting or "const" in setting:
        return " | ".join(map(str, setting.get("enum", [setting.get("const")])))
    if "prefixItems" in setting:
        return f"[{', '.join(map(_type, setting['prefixItems']))}]"
    if setting.get("type") == "array":
        return f"list of {_type(setting['items'])}"
    word = setting.get("format") or WORDS[setting["type"]]
    return between.join([word, *(f"{sign} {setting[bound]:g}" for bound, sign in SIGNS.items() if bound in setting)])


def _kinds(setting: Json) -> dict[str, str]:
    """Where the settings of each kind are, for a setting that has some kind of a few, or is null; else nothing."""
    one = next((x for x in (setting, *setting.get("anyOf", [])) if "discriminator" in x), None)
    return one["discriminator"]["mapping"] if one else {}


def _name(reference: Json) -> str:
    """Of the settings class that is referred to."""
    return str(reference["$ref"]).rpartition("/")[2]


def _default(setting: Json, required: bool) -> str:
    """As YAML writes it."""
    if "default" not in setting:
        return "required" if required else "..."
    default = setting["default"]
    return default if isinstance(default, str) else json.dumps(default, ensure_ascii=False)
