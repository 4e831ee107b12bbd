"""Judged responses to prompts: JSON lines in the forms that the field uses, and tables of chosen and rejected.

- `{"prompt", "chosen", "rejected"}`;
- `{"prompt", "responses": [...]}` with one of `"ranks"`, `"best"`, `"ratings"` (and `"scale"`), `"preference"`;
- conversation trees of OpenAssistant (Koepf et al. 2023): a ranking of the replies to each of a person's turns.

`"labeler"`, `"weight"` and `"split"` may be added to a row of the first two forms.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prefrl.files import read_lines
from prefrl.label.formats import Parts, Row
from prefrl.types import Choice, Comparison, Judged, Judgement, Query, Ranking, Rating, Response

PAIR = ("prompt", "chosen", "rejected")
VERDICTS = ("ranks", "best", "ratings", "preference")
SPEAKERS = {"prompter": "Human", "assistant": "Assistant"}


def text_rows(path: Path) -> Parts:
    """(row N, what reads it) for each line or table row."""
    for number, row in enumerate(_rows(path), 1):
        yield f"row {number}", partial(parse, row)


def parse(row: Any) -> list[Row | str]:
    """A line, or a table's row as a dict, as judgements and reasons for leaving others out; raises `ValueError`."""
    if isinstance(row, str):
        row = _json(row)
    if not isinstance(row, dict):
        raise ValueError(f"expected an object, got {type(row).__name__}")
    if isinstance(row.get("prompt"), dict):
        return _tree(row["prompt"], _optional(row, "split", str, ""))
    return [Row(_several(row) if "responses" in row else _pair(row), _optional(row, "split", str, ""))]


def _rows(path: Path) -> Iterator[Any]:
    """Lines of JSON, or the rows of a table as dicts."""
    if path.suffix not in (".csv", ".parquet"):
        yield from read_lines(path)
        return
    from datasets import Dataset

    with tempfile.TemporaryDirectory() as cache:
        read = Dataset.from_csv if path.suffix == ".csv" else Dataset.from_parquet
        yield from read(str(path), cache_dir=cache, keep_in_memory=True)


def _json(line: str) -> Any:
    try:
        return json.loads(line, parse_constant=_no_constant)
    except RecursionError:
        raise ValueError("the object is nested too deeply") from None


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a value")


# --- chosen and rejected -----------------------------------------------------------------------------------------


def _pair(row: Mapping[str, Any]) -> Judged[Response]:
    for name in PAIR:
        if name not in row:
            raise ValueError(f"column {name!r} is missing; there are: {', '.join(map(str, row))}")
        if not isinstance(row[name], str):
            raise ValueError(f"column {name!r}: expected a string, got {row[name]!r}")
    if row["chosen"] == row["rejected"]:
        raise ValueError("chosen and rejected are the same text")
    return _judged(row, [row["chosen"], row["rejected"]], partial(_comparison, 1.0))


# --- several responses ------------------------------------------------------------------------------------------


def _several(row: Mapping[str, Any]) -> Judged[Response]:
    texts, given = row["responses"], [name for name in VERDICTS if row.get(name) is not None]
    if not isinstance(row.get("prompt"), str) or not isinstance(texts, list):
        raise ValueError(f'expected "prompt": string and "responses": list, got {row!r:.200}')
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(f"expected responses that are strings, got {texts!r:.200}")
    if len(given) != 1:
        raise ValueError(f"expected one of {', '.join(VERDICTS)}, got {', '.join(given) or 'none'}")
    return _judged(row, texts, partial(_VERDICTS[given[0]], row))


def _judged(row: Mapping[str, Any], texts: Sequence[str], verdict: Callable[..., Judgement]) -> Judged[Response]:
    """A query over responses, and a judgement in the query's own order: `order[i]` is where response i stands in it."""
    responses = [Response(row["prompt"], text) for text in texts]
    query = Query(tuple(responses))
    place = {candidate.id: i for i, candidate in enumerate(query.candidates)}
    who = {"labeler": _optional(row, "labeler", str, ""), "weight": float(_optional(row, "weight", (int, float), 1.0))}
    return Judged(query, verdict(query=query.id, order=[place[r.id] for r in responses], who=who))


def _comparison(first_better: float, query: str, order: Sequence[int], who: dict[str, Any]) -> Comparison:
    return Comparison(query, first_better if order[0] == 0 else 1.0 - first_better, **who)


def _preference(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Comparison:
    value = row["preference"]
    if len(order) != 2 or isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"a preference is a number, of the first of two responses; got {value!r} for {len(order)}")
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"a preference must lie in [0, 1], got {value}")
    return _comparison(float(value), query, order, who)


def _ranking(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Ranking:
    return Ranking(query, _integers(row["ranks"], "ranks", order), **who)


def _choice(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Choice:
    best = row["best"]
    if isinstance(best, bool) or not isinstance(best, int) or not 0 <= best < len(order):
        raise ValueError(f"best: expected the number of a response, from 0 to {len(order) - 1}, got {best!r}")
    return Choice(query, order[best], **who)


def _rating(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Rating:
    scale = row.get("scale")
    if isinstance(scale, bool) or not isinstance(scale, int):
        raise ValueError(f'ratings need "scale", how many levels there are; got {scale!r}')
    return Rating(query, _integers(row["ratings"], "ratings", order), scale, **who)


_VERDICTS: Mapping[str, Callable[..., Judgement]] = {
    "ranks": _ranking,
    "best": _choice,
    "ratings": _rating,
    "preference": _preference,
}


def _integers(values: Any, name: str, order: Sequence[int]) -> tuple[int, ...]:
    """One integer for each response, put into the query's order."""
    whole = isinstance(values, list) and all(isinstance(v, int) and not isinstance(v, bool) for v in values)
    if not whole or len(values) != len(order):
        raise ValueError(f"{name}: expected an integer for each of {len(order)} responses, got {values!r:.200}")
    by_place = dict(zip(order, values, strict=True))
    return tuple(by_place[i] for i in range(len(order)))


def _optional(row: Mapping[str, Any], name: str, kind: Any, default: Any) -> Any:
    """A value that may be left out; a table has None there."""
    value = row.get(name)
    if value is None:
        return default
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f"column {name!r}: expected {getattr(kind, '__name__', 'number')}, got {value!r:.200}")
    return value


# --- conversation trees ------------------------------------------------------------------------------------------


def _tree(root: Mapping[str, Any], split: str) -> list[Row | str]:
    """A ranking for each group of ranked replies to one conversation so far."""
    found: list[Row | str] = []
    waiting = [(root, "")]
    while waiting:
        message, before = waiting.pop()
        if message.get("role") not in SPEAKERS or not isinstance(message.get("text"), str):
            raise ValueError(f"expected a message with a text and a role ({', '.join(SPEAKERS)}), got {message!r:.200}")
        here = f"{before}{SPEAKERS[message['role']]}: {message['text']}\n\n"
        replies = [r for r in message.get("replies") or [] if isinstance(r, dict)]
        if message["role"] == "prompter" and replies:
            found += _group(f"{here}{SPEAKERS['assistant']}: ", replies, split)
        waiting += [(reply, here) for reply in reversed(replies)]
    return found


def _group(prompt: str, replies: Sequence[Mapping[str, Any]], split: str) -> list[Row | str]:
    ranked = [reply for reply in replies if reply.get("rank") is not None]
    if len(ranked) < 2:
        return ["prompt with fewer than two ranked replies"]
    row = {"prompt": prompt, "responses": [r.get("text") for r in ranked], "ranks": [r["rank"] for r in ranked]}
    return [Row(_several(row), split), *["reply without a rank beside ranked ones"] * (len(replies) - len(ranked))]
