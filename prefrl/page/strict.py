"""JSON that means one thing only: what lenient parsers let through is refused."""

from __future__ import annotations

import json
import math
import re
from typing import Any, NoReturn

DEPTH = 16
"""Lists and objects inside one another."""
DIGITS = 20
"""Of a whole number: more fit nowhere."""
_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+(?:"|\\?\Z)', re.DOTALL)  # closed or not: no second look


class NotStrict(ValueError):
    """A body is no JSON, or JSON that could be read in two ways."""


def check_json(body: bytes) -> None:
    """Raise `NotStrict` unless a body is one plain JSON object in UTF-8.

    Refused: NaN, infinities and numbers too large for a float, huge whole numbers, a key that is given twice, lone
    surrogates, NUL characters, deep nesting. What is refused is refused before it costs anything.
    """
    _check_depth(body)
    try:
        value = json.loads(
            body.decode("utf-8"),
            parse_constant=_constant,
            parse_float=_float,
            parse_int=_int,
            object_pairs_hook=_object,
        )
    except NotStrict:
        raise
    except (ValueError, RecursionError):
        raise NotStrict("the body is no valid JSON in UTF-8") from None
    if not isinstance(value, dict):
        raise NotStrict("expected a JSON object")
    _check_text(value)


def _check_depth(body: bytes) -> None:
    depth = 0
    # Before parsing, and outside of strings, where brackets are text: a deep body would cost the parser its stack.
    for bracket in re.findall(rb"[\[\]{}]", _STRING.sub(b"", body)):
        depth += 1 if bracket in b"[{" else -1
        if depth > DEPTH:
            raise NotStrict(f"the JSON is nested more than {DEPTH} deep")


def _constant(name: str) -> NoReturn:
    raise NotStrict(f"{name} is no JSON")


def _float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise NotStrict("a number is too large")
    return value


def _int(text: str) -> int:
    if len(text) > DIGITS:
        raise NotStrict(f"a whole number has more than {DIGITS} digits")
    return int(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise NotStrict("a key is given twice")
    for key in found:
        _check_string(key)
    return found


def _check_text(value: Any) -> None:
    if isinstance(value, str):
        _check_string(value)
    elif isinstance(value, dict):
        for inner in value.values():
            _check_text(inner)
    elif isinstance(value, list):
        for inner in value:
            _check_text(inner)


def _check_string(text: str) -> None:
    if "\0" in text:
        raise NotStrict("a text holds a NUL character")
    if any("\ud800" <= c <= "\udfff" for c in text):
        raise NotStrict("a text holds half a surrogate pair")
