"""What the events of a store say in their bodies, and whether those from elsewhere may be believed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Protocol

from prefrl.blobs import read_arrays
from prefrl.engines import StoreError
from prefrl.projection import ANSWERS
from prefrl.types import (
    Answer,
    Candidate,
    Choice,
    Comparison,
    Query,
    Ranking,
    Rating,
    Response,
    Segment,
    Skip,
    check_fits,
)

ANSWER_TYPES: dict[str, type[Answer]] = dict(zip(ANSWERS, (Comparison, Ranking, Choice, Rating, Skip), strict=True))
PORTABLE = ("candidate", "query", *ANSWERS, "retract", "assign", "repeat", "guideline", "flag")
"""Kinds that a copy for others holds: what was asked and answered, not who may come in or how the project is set."""


class Asked(Protocol):
    """Queries that are known, with the ids of their candidates."""

    def __contains__(self, id: str) -> bool: ...

    def __getitem__(self, id: str) -> list[str]: ...

    def __setitem__(self, id: str, candidates: list[str]) -> None: ...


def describe(candidate: Candidate) -> dict[str, Any]:
    """A candidate without its arrays and its gold."""
    if isinstance(candidate, Segment):
        return {"type": "segment", "episode": candidate.episode, "start": candidate.start, "steps": len(candidate)}
    tokens = {"prompt_tokens": list(candidate.prompt_tokens), "tokens": list(candidate.tokens)}
    return {"type": "response", "prompt": candidate.prompt, "text": candidate.text, **tokens}


def load_candidate(id: str, body: dict[str, Any], blobs: Path) -> Any:
    """A candidate from its description, and its arrays if it has any; its content must have the id it goes by."""
    loaded: Candidate
    if body["type"] == "response":
        loaded = Response(body["prompt"], body["text"], tuple(body["prompt_tokens"]), tuple(body["tokens"]))
    else:
        x = read_arrays(blobs, id)
        loaded = Segment(x["observations"], x["actions"], body["episode"], body["start"], x.get("states"))
    if loaded.id != id:
        raise StoreError(f"candidate {id[:12]} has changed since it was filed: its sha256 is now {loaded.id[:12]}")
    return loaded


def read_answer(kind: str, query: str, labeler: str, body: dict[str, Any]) -> Answer:
    """The answer that an event holds; JSON has lists where answers have tuples."""
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in body.items() if k != "about"}
    return ANSWER_TYPES[kind](query=query, labeler=labeler, **values)


def check_event(one: dict[str, Any], queries: Asked, candidates: dict[str, Any], blobs: Path) -> None:
    """Check an event from elsewhere against those before it, and remember it if later ones may speak of it.

    Raises `ValueError`, `KeyError`, `TypeError` or `AttributeError` for one that cannot be believed.
    """
    if not all(isinstance(one[name], str) for name in ("id", "kind", "subject", "actor", "at")):
        raise TypeError("id, kind, subject, actor and at must be strings")
    if one["kind"] not in PORTABLE:
        raise StoreError(f"unknown kind {one['kind']!r}")
    about = one["body"].get("about", {})
    if not isinstance(about, dict) or not all(isinstance(about.get(n, ""), str) for n in ("submission", "assignment")):
        raise TypeError("about must be an object, its submission and assignment strings")
    if one["kind"] == "candidate":
        candidates[one["id"]] = load_candidate(one["id"], one["body"], blobs)
    elif one["kind"] == "query":
        queries[one["id"]] = _check_query(one["id"], one["body"], candidates)
    elif one["kind"] in ("guideline", "flag"):
        _check_words(one)
    elif one["subject"] not in queries:
        raise StoreError(f"it speaks of query {one['subject'][:12]}, which is not there")
    else:
        _check_reply(one, len(queries[one["subject"]]))


def _check_reply(one: dict[str, Any], size: int) -> None:
    """What somebody said to a query, or was shown of it."""
    if one["kind"] == "assign":
        _check_assignment(one, size)
    elif one["kind"] == "repeat":
        if not re.fullmatch("repeat:[0-9a-f]{32}", one["id"]):
            raise StoreError(f"its id {one['id'][:20]!r} is not that of a repeated answer")
        answer = dict(one["body"]["answer"])
        check_fits(read_answer(answer.pop("kind"), one["subject"], one["actor"], answer), size)
    elif not one["id"].startswith(f"{one['subject']}:{one['actor']}:"):
        raise StoreError(f"its id {one['id'][:20]} is not that of an answer to its query by its labeler")
    elif one["kind"] in ANSWERS:
        try:
            check_fits(read_answer(one["kind"], one["subject"], one["actor"], one["body"]), size)
        except ValueError as error:
            raise StoreError(str(error)) from None


def _check_assignment(one: dict[str, Any], size: int) -> None:
    body = one["body"]
    if not re.fullmatch("[0-9a-f]{32}", one["id"]):
        raise StoreError(f"its id {one['id'][:20]!r} is not that of an assignment")
    if body["purpose"] not in ("label", "check", "repeat") or not isinstance(body.get("guideline", ""), str):
        raise StoreError(f"an assignment has a purpose and a guideline, got {body!r:.200}")
    if sorted(body["shown"]) != list(range(size)):
        raise StoreError(f"an assignment shows each of {size} candidates once, got {body['shown']!r:.200}")


def _check_words(one: dict[str, Any]) -> None:
    if not isinstance(one["body"]["text"], str):
        raise TypeError("its text must be a string")


def _check_query(id: str, body: dict[str, Any], candidates: dict[str, Any]) -> list[str]:
    """The candidates of a query from elsewhere; they must be there, and make up its id."""
    purpose, expected = body.get("purpose", "label"), body.get("expected")
    if Query(tuple(candidates[c] for c in body["candidates"])).id != id:
        raise StoreError(f"query {id[:12]} does not have the sha256 of its candidates")
    if purpose not in ("label", "check") or not isinstance(body.get("batch", 0), int):
        raise StoreError(f"query {id[:12]} has the purpose {purpose!r:.40}; expected label or check")
    if (purpose == "check") != (expected in range(len(body["candidates"])) and expected is not None):
        raise StoreError(f"query {id[:12]} is a check, and names its best candidate, or neither")
    return list(body["candidates"])
