"""`prefrl describe`: a component's settings, what they mean, and what a learner optimises, as a formula."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Annotated, Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from rich.console import RenderableType
from rich.markup import escape
from rich.padding import Padding
from rich.text import Text

from prefrl.cli.console import table
from prefrl.components import TABLE, ConfigError, Role, Settings, kinds, settings_class, suggest
from prefrl.config import Config, presets
from prefrl.fit.settings import FittingSettings
from prefrl.loop import LoopSettings

ALWAYS: dict[str, type[Settings]] = {"fitting": FittingSettings, "loop": LoopSettings}
SIGNS = {Ge: "≥", Gt: ">", Le: "≤", Lt: "<"}


def explain(name: str | None) -> list[RenderableType]:
    """What a person reads about a kind or a preset; without a name, the kinds there are."""
    if name is None:
        rows = [(role[:-1], ", ".join(kinds(role))) for role in TABLE]
        return [table("kinds: prefrl describe KIND", ("role", "kinds"), [*rows, ("always there", ", ".join(ALWAYS))])]
    if name in presets():
        return [_yaml(Config.load(name))]
    if name in ALWAYS:
        return _component(name, ALWAYS[name])
    roles: list[Role] = [role for role in TABLE if name in kinds(role)]
    if not roles:
        known = [*ALWAYS, *(kind for role in TABLE for kind in kinds(role)), *presets()]
        raise ConfigError(f"nothing is called {name!r}; {suggest(name, known)}")
    return [part for role in roles for part in _component(f"{role[:-1]} kind {name}", settings_class(role, name))]


def _component(title: str, cls: type[Settings]) -> list[RenderableType]:
    intro = Text((cls.__doc__ or "").strip())
    shown = table(title, ("setting", "type", "default", "meaning"), list(_rows(cls)))
    return [intro, Text(), shown, *(_formula(cls()) if _has_defaults(cls) else [])]


def _rows(cls: type[Settings], group: str = "") -> Iterator[tuple[str, str, str, str]]:
    """A row for each setting; those of a group are told one by one, as `group.name`."""
    for name, field in cls.model_fields.items():
        inner: Any = field.annotation
        if isinstance(inner, type) and issubclass(inner, Settings):
            yield from _rows(inner, f"{group}{name}.")
        else:
            yield group + name, _type(field), _default(field), field.description or ""


def _yaml(config: Config) -> Text:
    """A config as a file that can be run; what its learner optimises stands in comments."""
    formula: Any = getattr(config.learner, "formula", None)
    lines = ["what it optimises:", *formula().splitlines()] if formula else []
    return Text(config.dump() + "".join(f"# {line}\n" for line in lines), end="")


def _formula(settings: Settings) -> list[RenderableType]:
    """The objective, of learners that can spell it out."""
    formula: Any = getattr(settings, "formula", None)
    return [Text("\nwhat it optimises", style="bold"), Padding(escape(formula()), (0, 2))] if formula else []


def _has_defaults(cls: type[Settings]) -> bool:
    return not any(field.is_required() for field in cls.model_fields.values())


def _type(field: FieldInfo) -> str:
    """The type in words, with its bounds."""
    return ", ".join([_plain(field.annotation), *_bounds(field.metadata)])


def _bounds(metadata: Iterable[Any]) -> list[str]:
    """Such as "≥ 0", of bare constraints and of those inside a `Field`."""
    inside = [m for given in metadata for m in (given.metadata if isinstance(given, FieldInfo) else [given])]
    return [f"{SIGNS[type(m)]} {next(iter(vars_of(m)))}" for m in inside if type(m) in SIGNS]


def vars_of(bound: Any) -> list[Any]:
    """The one number that a bound holds."""
    return [getattr(bound, name) for name in ("ge", "gt", "le", "lt") if hasattr(bound, name)]


def _plain(choice: Any) -> str:
    """A type, or one of the values it may have, in words."""
    inner = get_args(choice)
    if choice is type(None):
        return "null"
    if get_origin(choice) is Annotated:
        return " ".join([_plain(inner[0]), *_bounds(inner[1:])])
    if get_origin(choice) is tuple:
        return f"list of {_plain(inner[0])}" if inner[-1] is Ellipsis else f"[{', '.join(map(_plain, inner))}]"
    if inner:
        return " | ".join(map(_plain, inner))
    return getattr(choice, "__name__", None) or str(choice)


def _default(field: FieldInfo) -> str:
    if field.default_factory is not None:
        return "..."
    if field.default is PydanticUndefined:
        return "required"
    if isinstance(field.default, tuple):
        return str(list(field.default))
    return "null" if field.default is None else str(field.default)
