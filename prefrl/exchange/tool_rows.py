"""What labelling tools write, as answers: records of Argilla, tasks of Label Studio, battles of the LMSYS arena."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from prefrl.exchange.layout import Row, answer_of, optional, responses
from prefrl.exchange.transcripts import read_messages, split_conversations
from prefrl.types import Fields

PROMPTS = ("prompt", "instruction", "question", "input")
"""Names under which a tool's records hold what was asked."""
PAIRS = (("left", "right"), ("text1", "text2"), ("answer1", "answer2"), ("response_1", "response_2"))
"""Names of the two texts in tasks of Label Studio; the second are its template's."""
TIES = ("tie", "equal", "same")
_USERS = uuid.uuid5(uuid.NAMESPACE_URL, "prefrl:labeler")
"""Argilla's users go by a UUID: that of a labeler's name under this one."""
TOOLS: Mapping[str, Callable[[Fields], list[Row | str]]]


def _row(verdict: str, value: Any, prompt: str, texts: Sequence[str], labeler: str) -> Row:
    return answer_of({"labeler": labeler, verdict: value}, responses(prompt, texts))


def _written_from(found: Sequence[Row | str], query: Any) -> list[Row | str]:
    """The rows, as written from a query of a store if that is what is named."""
    return [one._replace(named=query) if isinstance(one, Row) and isinstance(query, str) else one for one in found]


def _object(row: Fields, name: str) -> Fields:
    if not isinstance(found := row.get(name), Mapping):
        raise ValueError(f"column {name!r}: expected an object, got {found!r:.200}")
    return found


# --- Argilla ------------------------------------------------------------------------------------------------------


def _argilla(record: Fields) -> list[Row | str]:
    """A record {"fields", "responses": {question: [{"value", "user_id", "status"}]}} of Argilla 2, one row a response.

    The responses to compare are the fields that a question's answers name, or all fields but the prompt. An answer is
    the name of a field, "tie", "incomparable", or an order of names.
    """
    prompt, texts = _fields(_object(record, "fields"))
    given = record.get("responses") or {}
    if not isinstance(given, Mapping):
        raise ValueError(f'expected "responses": question -> list, got {given!r:.200}')
    names = _labelers(record.get("metadata"))
    found: list[Row | str] = []
    for question, answers in given.items():
        for answer in answers if isinstance(answers, list) else []:
            found.append(_argilla_answer(question, answer, prompt, texts, names))
    return _written_from(found, record.get("id")) or ["record without a response"]


def user_id(labeler: str) -> str:
    """The UUID that stands for a labeler's name in Argilla's records."""
    return str(uuid.uuid5(_USERS, labeler.encode("utf-8", "backslashreplace").decode()))


def _labelers(metadata: Any) -> dict[str, str]:
    """Names by user, of records that name their labelers: those that `user_id` stands for."""
    names = metadata.get("labelers") if isinstance(metadata, Mapping) else None
    return {user_id(""): ""} | {user_id(name): name for name in names or () if isinstance(name, str)}


def _fields(fields: Fields) -> tuple[str, dict[str, str]]:
    """The prompt, and the texts by the names of their fields, in the order of the numbers in these."""
    known = next((name for name in PROMPTS if name in fields), None)
    if not isinstance(prompt := fields.get(known or "", ""), str):
        raise ValueError(f"field {known!r}: expected text, got {prompt!r:.200}")
    texts = {name: text for name, text in fields.items() if name != known and text is not None}
    if bad := next((name for name, text in texts.items() if not isinstance(text, str)), None):
        raise ValueError(f"field {bad!r}: expected text, got {texts[bad]!r:.200}")
    return prompt, dict(sorted(texts.items(), key=lambda item: [int(n) for n in re.findall(r"\d{1,9}", item[0])]))


def _argilla_answer(
    question: str, answer: Any, prompt: str, texts: Mapping[str, str], names: Mapping[str, str]
) -> Row | str:
    if not isinstance(answer, Mapping):
        raise ValueError(f'question {question!r}: expected {{"value", "user_id"}}, got {answer!r:.200}')
    user = str(answer.get("user_id") or "")
    labeler = names.get(user, user)
    status = answer.get("status") or "submitted"
    value = answer.get("value")
    several = list(texts.values())
    if status == "discarded":
        return _row("skip", "incomparable" if value == "incomparable" else "skip", prompt, several, labeler)
    if status != "submitted":
        return "draft of a response"
    if isinstance(value, list):
        return _row("ranks", _order(value, list(texts)), prompt, several, labeler)
    if str(value).lower() in TIES and len(texts) == 2:
        return _row("preference", 0.5, prompt, several, labeler)
    if value == "incomparable":
        return _row("skip", "incomparable", prompt, several, labeler)
    best = _named(value, list(texts))
    if best is None:
        return f"answer to question {question!r}, which names no response"
    if len(texts) == 2:
        return _row("preference", 1.0 - best, prompt, several, labeler)
    return _row("best", best, prompt, several, labeler)


def _order(value: Sequence[Any], names: Sequence[str]) -> list[int]:
    """A rank for each response, from an order of names, or from names with ranks."""
    by_name = {}
    for place, one in enumerate(value):
        name, rank = (one.get("value"), one.get("rank", place + 1)) if isinstance(one, Mapping) else (one, place + 1)
        at = _named(name, names)
        if at is None or at in by_name or isinstance(rank, bool) or not isinstance(rank, int):
            raise ValueError(f"expected a ranking of {', '.join(names)}, got {value!r:.200}")
        by_name[at] = rank
    if len(by_name) < len(names):
        raise ValueError(f"expected a ranking of all of {', '.join(names)}, got {value!r:.200}")
    ranks = sorted(set(by_name.values()))
    return [ranks.index(by_name[at]) for at in range(len(names))]


def _named(value: Any, names: Sequence[str]) -> int | None:
    """Which field an answer names: "response-1" is "response_1"."""
    plain = [name.lower().replace("-", "_") for name in names]
    wanted = str(value).lower().replace("-", "_")
    return plain.index(wanted) if wanted in plain else None


# --- Label Studio -------------------------------------------------------------------------------------------------


def _label_studio(task: Fields) -> list[Row | str]:
    """A task {"data", "annotations"} with pairwise results, one row an annotation; a choice may be a tie.

    An annotation that was cancelled is a skip.
    """
    prompt, texts = _task(_object(task, "data"))
    annotations = task.get("annotations")
    if not isinstance(annotations, list):
        raise ValueError(f'expected "annotations": list, got {annotations!r:.200}')
    found = [_annotation(one, prompt, texts) for one in annotations]
    meta = task.get("meta")
    return _written_from(found, meta.get("query") if isinstance(meta, Mapping) else "") or [
        "task without an annotation"
    ]


def _task(data: Fields) -> tuple[str, list[str]]:
    pair = next((pair for pair in PAIRS if pair[0] in data and pair[1] in data), None)
    if pair is None:
        tried = ", ".join("/".join(pair) for pair in PAIRS)
        raise ValueError(
            f"expected two texts ({tried}) in the task's data, got {', '.join(map(str, data))}: "
            "name them with --map left=...,right=..."
        )
    prompt = next((data[name] for name in PROMPTS if name in data), "")
    texts = [data[name] for name in pair]
    if not all(isinstance(text, str) for text in [prompt, *texts]):
        raise ValueError(f"expected text in the task's data, got {data!r:.200}")
    return prompt, texts


def _annotation(one: Any, prompt: str, texts: Sequence[str]) -> Row | str:
    if not isinstance(one, Mapping) or not isinstance(one.get("result") or [], list):
        raise ValueError(f'expected an annotation with "result": list, got {one!r:.200}')
    who = one.get("completed_by")
    who = (who.get("email") or who.get("id")) if isinstance(who, Mapping) else who
    labeler = "" if who is None else str(who)
    if one.get("was_cancelled"):
        return _row("skip", "skip", prompt, texts, labeler)
    values = [
        r["value"] for r in one.get("result") or [] if isinstance(r, Mapping) and isinstance(r.get("value"), Mapping)
    ]
    chosen = {c for value in values for c in _choices(value)}
    if "incomparable" in chosen:
        return _row("skip", "incomparable", prompt, texts, labeler)
    if chosen & set(TIES):
        return _row("preference", 0.5, prompt, texts, labeler)
    if len(sides := chosen & {"left", "right"}) == 1:
        return _row("preference", 1.0 if "left" in sides else 0.0, prompt, texts, labeler)
    return "annotation without a choice of left or right"


def _choices(value: Fields) -> list[str]:
    several = value.get("choices")
    found = [value.get("selected"), *(several if isinstance(several, list) else [])]
    return [one.lower() for one in found if isinstance(one, str)]


# --- the arena ----------------------------------------------------------------------------------------------------


def _arena(battle: Fields) -> list[Row | str]:
    """{"conversation_a", "conversation_b", "winner"} and perhaps the "judge"; both bad is incomparable."""
    a, b = (read_messages(battle.get(f"conversation_{side}")) for side in "ab")
    prompt, *texts = split_conversations(a, b)
    winner, labeler = battle.get("winner"), optional(battle, "judge", str, "")
    if winner == "tie (bothbad)":
        found = _row("skip", "incomparable", prompt, texts, labeler)
    elif isinstance(winner, str) and winner in _WINNERS:
        found = _row("preference", _WINNERS[winner], prompt, texts, labeler)
    else:
        raise ValueError(f"winner: expected {', '.join(_WINNERS)} or tie (bothbad), got {winner!r:.200}")
    return _written_from([found], battle.get("question_id"))


_WINNERS = {"model_a": 1.0, "model_b": 0.0, "tie": 0.5}
TOOLS = {"argilla": _argilla, "label-studio": _label_studio, "arena": _arena}
"""What reads the rows of each tool."""
