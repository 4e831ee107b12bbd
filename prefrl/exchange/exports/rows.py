"""Rows as TRL reads them: preferences and unpaired preferences, plain and conversational, and every judgement whole."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from prefrl.exchange.exports.given import (
    LABELER,
    ORDER,
    STRENGTH,
    TIE,
    TIME,
    WEIGHT,
    WHOLE,
    Exported,
    Given,
    Tally,
    each_answer,
    knows_strengths,
    refuse_segments,
    told,
    write_lines,
)
from prefrl.exchange.transcripts import Messages, prompt_messages, response_messages
from prefrl.judgements import good, implied_pairs
from prefrl.kinds import only
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Json, Response

BOTH = "tie written both ways"
MIDDLE = "response that is neither better than all others nor worse"
ALONE = "rating of a single response"
OPINION = "judgement or skip"
ANSWERED = "behaviour that a demonstration answers"
UNTOLD = "prompt that is no transcript, written as one message of a user"


class Pair(NamedTuple):
    """Two responses, the better one first."""

    given: Given
    chosen: Response
    rejected: Response
    preference: float
    """How probably the chosen one is better: over 0.5, or 0.5 for a tie."""


@dataclass
class Conversations:
    """Texts as messages, or left as text; counts the prompts that are no transcript."""

    wanted: bool
    untold: set[str] = field(default_factory=set)

    def prompt(self, text: str) -> str | Messages:
        if not self.wanted:
            return text
        messages = prompt_messages(text)
        if messages is None:
            self.untold.add(text)
        return messages or [{"role": "user", "content": text}]

    def response(self, text: str) -> str | Messages:
        return response_messages(text) if self.wanted else text

    def notes(self) -> tuple[str, ...]:
        return (f"{len(self.untold)} x {UNTOLD}",) if self.untold else ()


def each_pair(store: Store, tally: Tally, form: str) -> Iterator[Pair]:
    """Every pair that the judgements imply, ties included; what has no pair is counted."""
    for given in each_answer(store):
        refuse_segments(given, form)
        tally.note(given)
        answer = given.answer
        if answer.reason is not None:
            tally.skip(answer.reason)
            continue
        texts = given.query.candidates
        if len(texts) == 1:
            tally.dropped[ALONE] += 1
        for i, j, preference in implied_pairs(answer, len(texts)):
            better, worse = (i, j) if preference >= 0.5 else (j, i)
            yield Pair(given, texts[better], texts[worse], max(preference, 1.0 - preference))


def export_preferences(store: Store, path: Path, ties: str = "drop", conversational: bool = False) -> Exported:
    """Write one JSON object a line with `prompt`, `chosen`, `rejected`: every decided pair that the judgements imply.

    Where the store holds strengths there is a `margin`: the log-odds of the preference, which in the Bradley-Terry
    model is the difference of two rewards, and 0 where no strength is known. Ties are left out, or with `ties="both"`
    written both ways. Raises `StoreError` for control segments.
    """
    tally = Tally({STRENGTH})
    margins = knows_strengths(store)
    form = "conversational" if conversational else "preferences"
    say = Conversations(conversational)
    written = write_lines(path, _preferences(each_pair(store, tally, form), tally, ties, margins, say))
    return tally.done(store, written, *say.notes())


def _preferences(pairs: Iterator[Pair], tally: Tally, ties: str, margins: bool, say: Conversations) -> Iterator[Json]:
    for pair in pairs:
        tie = pair.preference == 0.5
        if tie:
            tally.dropped[BOTH if ties == "both" else TIE] += 1
        orders = [(pair.chosen, pair.rejected), (pair.rejected, pair.chosen)]
        for chosen, rejected in orders[: (2 if ties == "both" else 0) if tie else 1]:
            row = {"prompt": say.prompt(chosen.prompt)}
            row |= {"chosen": say.response(chosen.text), "rejected": say.response(rejected.text)}
            yield row | ({"margin": margin(pair.preference)} if margins else {})


def margin(preference: float) -> float:
    """The difference of two rewards under which the better one is preferred so often; 0 where it always is."""
    return 0.0 if preference == 1.0 else math.log(preference / (1.0 - preference))


def export_unpaired(store: Store, path: Path, conversational: bool = False) -> Exported:
    """Write one JSON object a line with `prompt`, `completion`, `label`: whether a response is good.

    A rating is good in the upper half of its scale, bad in the lower. In what compares, a response is good that is
    better than another and worse than none, and bad the other way round; the rest is left out.
    """
    tally, say = Tally(), Conversations(conversational)
    return tally.done(store, write_lines(path, _unpaired(store, tally, say)), *say.notes())


def _unpaired(store: Store, tally: Tally, say: Conversations) -> Iterator[Json]:
    for given in each_answer(store):
        refuse_segments(given, "unpaired")
        tally.note(given)
        tally.dropped[WHOLE] = 0
        answer = given.answer
        if answer.reason is not None:
            tally.skip(answer.reason)
            continue
        texts = given.query.candidates
        for response, label in zip(texts, good(answer, len(texts)), strict=True):
            if label is None:
                tally.dropped[MIDDLE] += 1
            else:
                row = {"prompt": say.prompt(response.prompt), "completion": say.response(response.text)}
                yield row | {"label": label}


def export_demonstrations(store: Store, path: Path) -> Exported:
    """Write one JSON object a line with `prompt` and `completion`, and a `weight` other than 1: what was shown.

    Raises `ValueError` for a name that promises arrays, and `StoreError` for demonstrations of pictures.
    """
    if path.suffix == ".npz":
        raise ValueError(f"{path}: demonstrations of text are JSON lines: name the file .jsonl")
    opinions = 0
    for given in each_answer(store):
        refuse_segments(given, "demonstrations")
        opinions += 1
    shown = store.demonstrations()
    error = StoreError(f"demonstrations of {store.holds}s do not fit JSON lines; use --form bundle")
    texts = only(Response, [one.like for one in shown], error)
    weights = [one.demonstration.weight for one in shown]
    rows = (
        {"prompt": text.prompt, "completion": text.text} | ({} if weight == 1.0 else {"weight": weight})
        for text, weight in zip(texts, weights, strict=True)
    )
    left = {LABELER: len(shown), TIME: len(shown), OPINION: opinions}
    left[ANSWERED] = sum(one.like.id != one.query.candidates[0].id for one in shown)
    return Exported(write_lines(path, rows), {name: count for name, count in left.items() if count})


def export_judgements(store: Store, path: Path) -> Exported:
    """Write one JSON object a line with `prompt`, `responses` and the answer as it was given, skips included."""
    tally = Tally({LABELER, ORDER, TIME, STRENGTH, WEIGHT, WHOLE})
    return tally.done(store, write_lines(path, each_judgement(store, tally)))


def each_judgement(store: Store, tally: Tally) -> Iterator[Json]:
    """Every answer as a row of its prompt, its responses in the query's order, and the answer."""
    for given in each_answer(store):
        refuse_segments(given, "judgements")
        tally.note(given)
        texts = given.query.candidates
        row = {"query": given.query.id, "prompt": texts[0].prompt, "responses": [c.text for c in texts]}
        yield row | told(given)
