"""What the events of a store say in their bodies, and whether those from elsewhere may be believed."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from prefrl.judgements import Answer, Choice, Comparison, Demonstration, Ranking, Rating, Skip, check_fits
from prefrl.kinds import kind_of, logged
from prefrl.storage.blobs import read_arrays, write_arrays
from prefrl.storage.engines import StoreError
from prefrl.storage.projection import ANSWERS
from prefrl.types import LARGEST, Candidate, Fields, Json, is_whole

ANSWER_TYPES: dict[str, type[Answer]] = dict(
    zip(ANSWERS, (Comparison, Ranking, Choice, Rating, Demonstration, Skip), strict=True)
)
PORTABLE = ("candidate", "query", *ANSWERS, "retract", "assign", "repeat", "guideline", "flag")
"""Kinds that a copy for others holds: what was asked and answered, not who may come in or how the project is set."""
LEVELS = 10_000
"""Levels of a rating scale at most: a fit has a threshold between each two of them."""
DEEPEST = 20
"""How deeply lists and objects may be nested in an event from elsewhere."""
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?(Z|[+-]\d\d:\d\d)", re.ASCII)
_NO_TEXT = re.compile("[\0\ud800-\udfff]")
_HEX = "[0-9a-f]{32}"
_IDS = {
    "assign": re.compile(_HEX),
    "repeat": re.compile(f"repeat:{_HEX}(:{_HEX})?"),
    "guideline": re.compile(r"guideline:.*", re.DOTALL),
    "flag": re.compile(r"flag:.*", re.DOTALL),
}
"""What ids look like that are not made of what they name: none may stand in the place of an answer's."""


def describe(candidate: Candidate) -> Json:
    """A candidate without its arrays and its gold."""
    kind = kind_of(candidate)
    return {"type": kind.noun, **kind.describe(candidate)}


def write_candidate(candidate: Candidate, blobs: Path) -> None:
    """Write the arrays that a candidate's description does not hold, if there are any."""
    if arrays := kind_of(candidate).arrays(candidate):
        write_arrays(blobs, candidate.id, arrays)


def load_candidate(id: str, body: Json, blobs: Path) -> Any:
    """A candidate from its description, and its arrays if it has any; its content must have the id it goes by."""
    loaded = logged(body["type"]).load(body, lambda: read_arrays(blobs, id))
    if loaded.id != id:
        raise StoreError(f"candidate {id[:12]} has changed since it was filed: its sha256 is now {loaded.id[:12]}")
    return loaded


def answer_kind(answer: Answer) -> str:
    """The kind of the event that holds an answer."""
    return next(kind for kind, cls in ANSWER_TYPES.items() if isinstance(answer, cls))


def answer_body(answer: Answer) -> Json:
    """What the event that holds an answer says beside its query and its labeler."""
    return {name: value for name, value in asdict(answer).items() if name not in ("query", "labeler")}


def read_answer(kind: str, query: str, labeler: str, body: Json) -> Answer:
    """The answer that an event holds; JSON has lists where answers have tuples."""
    values: Json = {k: tuple(v) if isinstance(v, list) else v for k, v in body.items() if k != "about"}
    return ANSWER_TYPES[kind](query=query, labeler=labeler, **values)


# --- from elsewhere -----------------------------------------------------------------------------------------------


def check_answer(answer: Answer, size: int) -> None:
    """`check_fits`, and whether each value is of its kind, and no larger than a store and its readers can take.

    Raises `ValueError`.
    """
    check_fits(answer, size)
    check_text("labeler", answer.labeler)
    if answer.shown and not _is_order(answer.shown, size):
        raise ValueError(f"shown: expected each of 0 to {size - 1} once, got {answer.shown!r:.200}")
    if not isinstance(answer, Skip) and not _is_finite(answer.weight):
        raise ValueError(f"weight: expected a finite number, got {answer.weight!r:.40}")
    match answer:
        case Comparison(preference=preference):
            good, expected = _is_finite(preference), "a preference that is a number"
        case Ranking(ranks=ranks):
            good, expected = max(ranks) <= LARGEST, f"ranks that are whole numbers up to {LARGEST}"
        case Choice():
            good, expected = True, ""  # it is no larger than the query, see `check_fits`
        case Rating(scale=scale):
            good, expected = scale <= LEVELS, f"a scale of at most {LEVELS} levels"
        case Demonstration(like=like):
            good, expected = isinstance(like, str), "the id of a candidate"
        case Skip(reason=reason):
            good, expected = reason in ("skip", "incomparable"), "the reason skip or incomparable"
    if not good:
        raise ValueError(f"expected {expected}, got {answer!r:.300}")


def check_text(name: str, value: Any) -> None:
    """Raise `ValueError` unless a value is text that every database can hold."""
    if not isinstance(value, str) or _NO_TEXT.search(value):
        raise ValueError(f"{name}: expected text that is valid Unicode, without NUL, got {value!r:.200}")


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_order(shown: Any, size: int) -> bool:
    return isinstance(shown, Sequence) and all(map(is_whole, shown)) and sorted(shown) == list(range(size))


def check_event(one: Fields) -> None:
    """Check what an event from elsewhere says by itself, whatever came before it.

    Raises `ValueError`, `KeyError`, `TypeError` or `AttributeError` for one that cannot be believed.
    """
    for name in ("id", "kind", "subject", "actor", "at"):
        check_text(name, one[name])
    if one["kind"] not in PORTABLE:
        raise StoreError(f"unknown kind {one['kind']!r:.40}")
    if not _TIME.fullmatch(one["at"]):
        raise StoreError(f"at: expected a time as 2026-01-31T12:00:00+00:00, got {one['at']!r:.40}")
    datetime.fromisoformat(one["at"])
    if one["kind"] in _IDS and not _IDS[one["kind"]].fullmatch(one["id"]):
        raise StoreError(f"its id {one['id'][:40]!r} is not that of an event of kind {one['kind']!r}")
    if one["kind"] in ("guideline", "flag") and not isinstance(one["body"]["text"], str):
        raise StoreError(f"text: expected a string, got {one['body']['text']!r:.200}")
    _check_values(one["body"])
    _check_about(one["body"].get("about", {}))


def _check_values(value: Any, depth: int = 0) -> None:
    """Raise `StoreError` for numbers that no database holds, and for what no reader can follow."""
    if depth > DEEPEST:
        raise StoreError(f"its body is nested more than {DEEPEST} deep")
    if isinstance(value, int | float) and not isinstance(value, bool) and not abs(value) < 2.0**63:
        raise StoreError(f"a number in its body is too large: {value!r:.40}")
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_values(part, depth + 1)


_ABOUT: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("submission", "digest", "assignment"), (str,)),
    **dict.fromkeys(("guideline", "comment", "outcome", "strength"), (str, type(None))),
    **dict.fromkeys(("ranking", "flags"), (list, type(None))),
    **dict.fromkeys(("timings", "shown"), (dict, type(None))),
}
"""What is read of how an answer came about; whatever else stands there is kept, and read by nobody."""


def _check_about(about: Any) -> None:
    for name, kinds in _ABOUT.items():
        if name in about and not isinstance(about[name], kinds):
            raise StoreError(f"about.{name}: expected {kinds[0].__name__}, got {about[name]!r:.200}")
    decision = (about.get("timings") or {}).get("decision_ms")
    if decision is not None and not (_is_finite(decision) and decision >= 0):
        raise StoreError(f"about.timings.decision_ms: expected a number from 0 on, got {decision!r:.40}")


def check_assignment(body: Fields, size: int) -> None:
    """What was put to somebody of a query of `size` candidates. Raises `StoreError`."""
    if body["purpose"] not in ("label", "check", "repeat") or not isinstance(body.get("guideline", ""), str):
        raise StoreError(f"an assignment has a purpose and a guideline, got {body!r:.200}")
    if not _is_order(body["shown"], size):
        raise StoreError(f"an assignment shows each of {size} candidates once, got {body['shown']!r:.200}")


def check_purpose(body: Fields, size: int) -> None:
    """What a query of `size` candidates was asked for. Raises `StoreError`."""
    purpose, expected = body.get("purpose", "label"), body.get("expected")
    if purpose not in ("label", "check") or not is_whole(body.get("batch", 0), LARGEST):
        raise StoreError(f"a query has a purpose, label or check, and the number of its batch, got {body!r:.200}")
    if (purpose == "check") != is_whole(expected, size - 1) or (purpose == "label" and expected is not None):
        raise StoreError(f"a query is a check, and names its best candidate, or neither, got {body!r:.200}")


def load_foreign(id: str, body: Json, blobs: Path) -> Candidate:
    """`load_candidate` for one from elsewhere. Raises `StoreError` where a part of it is not of its kind."""
    loaded: Candidate = load_candidate(id, body, blobs)
    if body != describe(loaded):
        raise StoreError(f"candidate {id[:12]} is not described as it is: {body!r:.200}")
    if fault := kind_of(loaded).fault(loaded):
        raise StoreError(f"candidate {id[:12]} {fault}")
    return loaded
