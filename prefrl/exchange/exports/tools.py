"""What labelling tools read: records of Argilla, tasks of Label Studio, battles as in the LMSYS arena."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Any

from prefrl.exchange.exports.given import (
    LABELER,
    TIME,
    WHOLE,
    Exported,
    Given,
    Tally,
    each_answer,
    each_query,
    refuse_segments,
    write_lines,
    write_list,
)
from prefrl.exchange.exports.rows import ALONE, UNTOLD
from prefrl.exchange.tool_rows import user_id
from prefrl.exchange.transcripts import Messages, prompt_messages, response_messages
from prefrl.judgements import Answer, Choice, Comparison, Ranking, Skip, implied_pairs
from prefrl.store import Store
from prefrl.types import Response

SOME_RATING = "rating, for which records hold no question"


def _by_query(store: Store[Any], tally: Tally, form: str) -> Iterator[list[Given]]:
    """The answers to each query, in the order in which the queries were first answered."""
    for group in each_query(store):
        for given in group:
            refuse_segments(given, form)
            tally.note(given)
        yield group


# --- Argilla ------------------------------------------------------------------------------------------------------


def export_argilla(store: Store[Any], path: Path) -> Exported:
    """Write a JSON list of records of Argilla 2, as its `Dataset.records.to_json` does: one a query.

    Fields `prompt`, `response_1` and so on; the question `preference` for pairs (a field's name or "tie"), `ranking`
    for rankings (names with ranks), `best` for choices. A skip is a discarded answer.
    """
    tally = Tally({LABELER, WHOLE})
    groups = _by_query(store, tally, "argilla")
    written = write_list(path, chain.from_iterable(_record(group, tally) for group in groups))
    return tally.done(store, written)


def _record(group: Sequence[Given], tally: Tally) -> list[dict[str, Any]]:
    texts = group[0].query.candidates
    names = [f"response_{i + 1}" for i in range(len(texts))]
    responses: dict[str, list[dict[str, Any]]] = {}
    for given in group:
        if (answer := _argilla_answer(given.answer, names)) is None:
            tally.dropped[SOME_RATING] += 1
            continue
        question, value, status = answer
        said = {"value": value, "user_id": user_id(given.answer.labeler), "status": status}
        responses.setdefault(question, []).append(said)
    if not responses:
        return []
    fields = {"prompt": texts[0].prompt} | dict(zip(names, (c.text for c in texts), strict=True))
    named = sorted({given.answer.labeler for given in group} - {""})
    record = {"id": group[0].query.id, "fields": fields, "metadata": {"labelers": named}, "suggestions": {}}
    return [record | {"responses": responses, "vectors": {}}]


def _argilla_answer(answer: Answer, names: Sequence[str]) -> tuple[str, Any, str] | None:
    """(question, value, status); None for what no question holds."""
    pair = "preference" if len(names) == 2 else "ranking"
    match answer:
        case Skip(reason=reason):
            return pair, reason, "discarded"
        case Comparison(preference=preference):
            return pair, "tie" if preference == 0.5 else names[0 if preference > 0.5 else 1], "submitted"
        case Choice(best=best):
            return "best", names[best], "submitted"
        case Ranking(ranks=ranks):
            value = [{"value": name, "rank": rank} for name, rank in zip(names, ranks, strict=True)]
            return "ranking", sorted(value, key=lambda one: one["rank"]), "submitted"
    return None


# --- Label Studio -------------------------------------------------------------------------------------------------


def export_label_studio(store: Store[Any], path: Path) -> Exported:
    """Write a JSON list of tasks of Label Studio with their annotations: one a pair of responses.

    The data are `prompt`, `left` and `right`; a `pairwise` result says which is better, a result of the `choices`
    "outcome" that it is a tie or incomparable. An annotation that was cancelled is a skip.
    """
    tally = Tally({LABELER, TIME})
    groups = _by_query(store, tally, "label-studio")
    return tally.done(store, write_list(path, chain.from_iterable(_tasks(group, tally) for group in groups)))


def _tasks(group: Sequence[Given], tally: Tally) -> list[dict[str, Any]]:
    """A task for each pair of a query's responses that was judged."""
    texts, pairs = group[0].query.candidates, dict[tuple[int, int], list[dict[str, Any]]]()
    for given in group:
        if given.answer.reason is not None and len(texts) != 2:
            tally.skip(given.answer.reason)
        tally.dropped[ALONE] += len(texts) == 1 and given.answer.reason is None
        for i, j, result, cancelled in _results(given.answer, len(texts)):
            better_first = (i, j) if i < j else (j, i)
            if i > j:
                result = _swapped(result)
            annotation = {"result": result, "was_cancelled": cancelled, "created_at": given.at}
            annotation["completed_by"] = {"email": given.answer.labeler} if given.answer.labeler else None
            pairs.setdefault(better_first, []).append(annotation)
    id = group[0].query.id
    return [_task(id, texts[i], texts[j], annotations) for (i, j), annotations in pairs.items()]


def _task(query: str, left: Response, right: Response, annotations: list[dict[str, Any]]) -> dict[str, Any]:
    data = {"prompt": left.prompt, "left": left.text, "right": right.text}
    return {"data": data, "meta": {"query": query}, "annotations": annotations}


def _results(answer: Answer, size: int) -> list[tuple[int, int, list[dict[str, Any]], bool]]:
    """(left, right, result, whether it was cancelled) for each pair that an answer speaks of."""
    if answer.reason is not None:
        outcome = [] if answer.reason == "skip" else [_choice("incomparable")]
        return [(0, 1, outcome, answer.reason == "skip")] if size == 2 else []
    found = []
    for i, j, preference in implied_pairs(answer, size):
        side = "left" if preference > 0.5 else "right"
        found.append((i, j, [_choice("tie")] if preference == 0.5 else [_pairwise(side)], False))
    return found


def _pairwise(side: str) -> dict[str, Any]:
    return {"from_name": "pairwise", "to_name": "left,right", "type": "pairwise", "value": {"selected": side}}


def _choice(outcome: str) -> dict[str, Any]:
    return {"from_name": "outcome", "to_name": "left", "type": "choices", "value": {"choices": [outcome]}}


def _swapped(result: list[dict[str, Any]]) -> list[dict[str, Any]]:
    side = {"left": "right", "right": "left"}
    return [_pairwise(side[r["value"]["selected"]]) if r["type"] == "pairwise" else r for r in result]


# --- the arena ----------------------------------------------------------------------------------------------------


def export_arena(store: Store[Any], path: Path) -> Exported:
    """Write one JSON object a line as the LMSYS arena publishes its battles: two conversations and a winner.

    Which models wrote the responses is unknown to a store. What is incomparable is called "tie (bothbad)".
    """
    tally, untold = Tally({LABELER, TIME}), set[str]()
    written = write_lines(path, _battles(store, tally, untold))
    notes = ["the models are called unknown: a store does not know them"]
    return tally.done(store, written, *notes, *([f"{len(untold)} x {UNTOLD}"] if untold else []))


def _battles(store: Store[Any], tally: Tally, untold: set[str]) -> Iterator[dict[str, Any]]:
    for given in each_answer(store):
        refuse_segments(given, "arena")
        tally.note(given)
        texts, answer = given.query.candidates, given.answer
        if answer.reason is not None:
            if answer.reason == "skip" or len(texts) != 2:
                tally.skip(answer.reason)
            else:
                yield _battle(given, texts, "tie (bothbad)", untold)
            continue
        tally.dropped[ALONE] += len(texts) == 1
        for i, j, preference in implied_pairs(answer, len(texts)):
            winner = "tie" if preference == 0.5 else "model_a" if preference > 0.5 else "model_b"
            yield _battle(given, (texts[i], texts[j]), winner, untold)


def _battle(given: Given, pair: Sequence[Response], winner: str, untold: set[str]) -> dict[str, Any]:
    asked: Messages | None = prompt_messages(pair[0].prompt)
    if asked is None:
        untold.add(pair[0].prompt)
        asked = [{"role": "user", "content": pair[0].prompt}]
    a, b = ([*asked, *response_messages(one.text)] for one in pair)
    models: Mapping[str, Any] = {"question_id": given.query.id, "model_a": "unknown", "model_b": "unknown"}
    said = {"winner": winner, "judge": given.answer.labeler, "conversation_a": a, "conversation_b": b}
    turns = sum(message["role"] == "user" for message in a)
    return {**models, **said, "turn": turns, "tstamp": datetime.fromisoformat(given.at).timestamp()}
