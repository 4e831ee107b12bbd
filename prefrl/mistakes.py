"""What is wrong with settings, in words: where it stands, what was expected, what came."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import yaml
from pydantic_core import ErrorDetails

from prefrl.components import Settings, suggest


def placed(line: str, source: str | Path, given: Sequence[list[str]]) -> str:
    """What is said of a setting, with the line of the file that has it; unless an override has to do with it."""
    path = Path(source)
    names = line.partition(":")[0].split(".")
    if not path.is_file() or any(all(a == b for a, b in zip(names, key, strict=False)) for key in given):
        return line
    node, at = yaml.compose(path.read_text(encoding="utf-8"), yaml.SafeLoader), None
    for name in names:
        keys = node.value if isinstance(node, yaml.MappingNode) else ()
        found = next(((key, value) for key, value in keys if key.value == name), None)
        if found is None:
            break
        at, node = found[0].start_mark.line + 1, found[1]
    return f"{source}, line {at}: {line}" if at else f"{source}: {line}"


def explained(cls: type[Settings], errors: Iterable[ErrorDetails]) -> list[str]:
    """What `_explain` says of each mistake; for a setting of several types pydantic names each, here in one line."""
    found: dict[tuple[int | str, ...], list[ErrorDetails]] = {}
    for error in errors:
        *parents, last = error["loc"] or ("",)
        branch = isinstance(last, str) and ("-" in last or "[" in last)  # as in weight_decay.constrained-float
        found.setdefault(tuple(parents) if branch else error["loc"], []).append(error)
    for loc, alternatives in found.items():
        if len(alternatives) > 1:
            expected = " or ".join(dict.fromkeys(map(_expected, alternatives)))
            alternatives[:] = [{**alternatives[0], "type": "union", "loc": loc, "msg": expected}]
    return [_explain(cls, one) for alternatives in found.values() for one in alternatives]


def _expected(error: ErrorDetails) -> str:
    return error["msg"].removeprefix("Input should be ").removeprefix("a valid ").split(", unable")[0]


def _explain(cls: type[Settings], error: ErrorDetails) -> str:
    """One line a mistake: `.dotted.path: what was expected, what came`."""
    names, group = _place(cls, error["loc"])
    path = "".join(f".{name}" for name in names)
    if error["type"] == "extra_forbidden":
        return f"{path}: unknown setting; {suggest(names[-1], group.model_fields)}"
    if error["type"] == "union_tag_invalid":
        tags = [tag.strip(" '") for tag in error["ctx"]["expected_tags"].split(",")]
        return f"{path}.kind: unknown kind {error['ctx']['tag']!r}; {suggest(error['ctx']['tag'], tags)}"
    if error["type"] == "union_tag_not_found":
        kinds = [str(one.model_fields["kind"].default) for one in _groups(group.model_fields[names[-1]].annotation)]
        return f"{path}.kind: missing; choose from: {', '.join(kinds)}"
    if error["type"] == "missing":
        about = group.model_fields[names[-1]].description if names[-1] in group.model_fields else None
        return f"{path}: missing; expected a value" + (f": {' '.join(about.split())}" if about else "")
    if error["type"] == "value_error":
        inner = str(error["ctx"]["error"])
        return "\n".join(f"{path}{line if line[:1] in '.:' else ': ' + line}" for line in inner.splitlines())
    return f"{path}: expected {_expected(error)}, got {error['input']!r}"


def _place(cls: type[Settings], loc: Iterable[int | str]) -> tuple[list[str], type[Settings]]:
    """The dotted path of a mistake, and the group that its last name is of.

    Where a group is one of several kinds, pydantic's path names the kind as well.
    """
    names, parts = list[str](), [str(part) for part in loc]
    while parts:
        names.append(parts.pop(0))
        field = cls.model_fields.get(names[-1])
        if not parts or field is None:
            continue
        groups = _groups(field.annotation)
        if len(groups) > 1:
            tag = parts.pop(0)
            groups = [group for group in groups if group.model_fields["kind"].default == tag]
        cls = groups[0] if groups else cls
    return names, cls


def _groups(annotation: Any) -> list[type[Settings]]:
    """The groups of settings that a setting may be: one, those of several kinds, or none where it is a plain value."""
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return [annotation]
    if get_origin(annotation) is Annotated:
        return _groups(get_args(annotation)[0])
    unions = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    return [group for one in unions for group in _groups(one)]
