"""Every behaviour asked about and every answer given: an append-only log of events, beside files named by content.

The log is the truth. Open queries, judgements and counts are read off it, so nothing can disagree with it. The
arrays of segments lie in `blobs/`, the hidden gold in `gold/`, which nothing but an oracle or an evaluation opens.
One process writes at a time; any number may read while it does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic

from sqlalchemy import Row

from prefrl.blobs import read_arrays, write_arrays
from prefrl.log import EventLog, StoreError, row
from prefrl.types import (
    Answer,
    C,
    Candidate,
    Choice,
    Comparison,
    Floats,
    Judged,
    Query,
    Ranking,
    Rating,
    Response,
    Segment,
    Skip,
    check_fits,
)

WRITERS = 16
"""Files written at once."""
ANSWERS: dict[str, type[Answer]] = {
    "comparison": Comparison,
    "ranking": Ranking,
    "choice": Choice,
    "rating": Rating,
    "skip": Skip,
}


@dataclass
class _View:
    """What the log says, read once and kept up with."""

    sequence: int = 0
    candidates: dict[str, dict[str, Any]] = field(default_factory=dict)
    queries: dict[str, list[str]] = field(default_factory=dict)
    answers: list[tuple[int, str, str, Answer | None]] = field(default_factory=list)
    """(sequence number, query, labeler, answer), None for a retraction; oldest first."""

    def read(self, row: Row[Any]) -> None:
        self.sequence = row.seq
        if row.kind == "candidate":
            self.candidates[row.id] = row.body
        elif row.kind == "query":
            self.queries[row.id] = row.body["candidates"]
        elif row.kind in (*ANSWERS, "retract"):
            answer = _answer(row.kind, row.subject, row.actor, row.body) if row.kind in ANSWERS else None
            self.answers.append((row.seq, row.subject, row.actor, answer))

    def standing(self, upto: int | None = None) -> dict[tuple[str, str], Answer]:
        """(query, labeler) -> the answer that stands, in the order in which they were given."""
        found: dict[tuple[str, str], Answer] = {}
        for seq, query, labeler, answer in self.answers:
            if upto is not None and seq > upto:
                break
            if answer is None:
                found.pop((query, labeler), None)
            else:
                found[query, labeler] = answer
        return found


class Store(Generic[C]):
    """A store in a folder (see the module's docstring); fits `prefrl.protocols.Store`."""

    def __init__(self, folder: Path, write: bool = True, url: str | None = None) -> None:
        """Open, or make, the store of a folder.

        Raises `StoreError` where another process is writing to it, where it is missing (for reading), damaged, or
        from a newer prefrl. `url` names another SQLAlchemy database for the log.
        """
        self.folder = folder
        self._log = EventLog(folder, write, url)
        self._view = _View()
        self._loaded: dict[str, C] = {}

    def close(self) -> None:
        """Let go of the database, and of the right to write."""
        self._log.close()

    def __enter__(self) -> Store[C]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- writing ---------------------------------------------------------------------------------------------

    def ask(self, queries: Sequence[Query[C]]) -> None:
        """Add queries with their candidates; what is there already is left alone. Gold is filed apart."""
        candidates = {c.id: c for query in queries for c in query.candidates}
        self._check_kind(candidates.values())
        self._file(candidates.values())
        rows = [row(id, "candidate", body=_describe(candidate)) for id, candidate in candidates.items()]
        rows += [row(query.id, "query", body={"candidates": [c.id for c in query.candidates]}) for query in queries]
        self._log.append(rows)

    def answer(self, answers: Sequence[Answer]) -> None:
        """Add answers, in one transaction; one per query and labeler: the first stands until it is retracted."""
        view = self._refresh()
        rows = []
        for answer in answers:
            if answer.query not in view.queries:
                raise StoreError(f"an answer to query {answer.query[:12]}, which was never asked")
            _check_size(answer, len(view.queries[answer.query]))
            kind = next(k for k, cls in ANSWERS.items() if isinstance(answer, cls))
            body = {k: v for k, v in asdict(answer).items() if k not in ("query", "labeler")}
            rows.append(row(self._answer_id(answer.query, answer.labeler), kind, answer.query, answer.labeler, body))
        self._log.append(rows)

    def retract(self, query: str, labeler: str) -> None:
        """Take a labeler's answer back; the log keeps both."""
        if (query, labeler) not in self._refresh().standing():
            raise StoreError(f"{labeler!r} has no answer to query {query[:12]} to take back")
        self._log.append([row(f"{self._answer_id(query, labeler)}:retract", "retract", query, labeler, {})])

    def merge(self, events: Sequence[dict[str, Any]], blobs: Path) -> int:
        """Add the events of another store, arrays from its `blobs` folder; returns how many answers they hold.

        All or none: each is checked before anything is written. Raises `ValueError` naming the first bad event.
        """
        known, candidates = dict(self._refresh().queries), dict[str, Any]()
        for number, one in enumerate(events, 1):
            try:
                _check_event(one, known, candidates, blobs)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ValueError(f"event {number} cannot be merged: {error}") from error
        self._check_kind(candidates.values())
        self._file(candidates.values())
        self._log.append(events)
        return sum(one["kind"] in ANSWERS for one in events)

    def _check_kind(self, candidates: Iterable[Candidate]) -> None:
        """A store holds segments or responses, not both: a learner could make nothing of the others."""
        there = next(iter(self._refresh().candidates.values()), None)
        new = next(iter(candidates), None)
        if there is not None and new is not None and there["type"] != _describe(new)["type"]:
            raise StoreError(
                f"the store in {self.folder} holds {there['type']}s, and cannot hold {type(new).__name__}s"
            )

    def _answer_id(self, query: str, labeler: str) -> str:
        retracted = sum(a is None and (q, n) == (query, labeler) for _, q, n, a in self._view.answers)
        return f"{query}:{labeler}:{retracted}"

    def _file(self, candidates: Iterable[Candidate]) -> None:
        """Write arrays and gold, each under its id; in threads, since each file waits for the disk."""
        with ThreadPoolExecutor(WRITERS) as pool:
            list(pool.map(self._file_one, candidates))

    def _file_one(self, candidate: Candidate) -> None:
        if isinstance(candidate, Segment):
            arrays = {"observations": candidate.observations, "actions": candidate.actions, "states": candidate.states}
            write_arrays(self.folder / "blobs", candidate.id, {k: v for k, v in arrays.items() if v is not None})
        if candidate.gold is not None:
            write_arrays(self.folder / "gold", candidate.id, {"gold": candidate.gold})

    # --- reading ---------------------------------------------------------------------------------------------

    @property
    def sequence(self) -> int:
        """The number of the newest event: the snapshot that a fit is made on."""
        return self._refresh().sequence

    def open_queries(self, labeler: str = "") -> list[Query[C]]:
        """Queries without a judgement that this labeler has not skipped, oldest first. Candidates carry no gold."""
        view = self._refresh()
        closed = {
            query
            for (query, who), answer in view.standing().items()
            if not isinstance(answer, Skip) or answer.reason == "incomparable" or who == labeler
        }
        return [self.query(id) for id in view.queries if id not in closed]

    def judged(self, upto: int | None = None) -> list[Judged[C]]:
        """Queries with their judgements, in the order in which they were given, up to a sequence number."""
        answers = self._refresh().standing(upto).values()
        return [Judged(self.query(a.query), a) for a in answers if not isinstance(a, Skip)]

    def answers(self) -> list[Answer]:
        """Every answer that stands, skips included, in the order in which they were given."""
        return list(self._refresh().standing().values())

    def events(self) -> list[dict[str, Any]]:
        """The whole log, oldest first: what a lossless copy needs, beside the blobs."""
        return [dict(one._mapping) for one in self._log.since(0)]

    def query(self, id: str) -> Query[C]:
        """A query by its id, with its candidates."""
        return Query(tuple(self.candidate(c) for c in self._refresh().queries[id]))

    def candidate(self, id: str) -> C:
        """A candidate by its id, without gold. Segments are read from their blob once, and kept."""
        if id not in self._loaded:
            self._loaded[id] = _load(id, self._view.candidates[id], self.folder / "blobs")
        return self._loaded[id]

    def gold(self, candidates: Sequence[C]) -> list[Floats]:
        """The hidden values of candidates: for oracles and evaluation only."""
        return [read_arrays(self.folder / "gold", c.id)["gold"] for c in candidates]

    def counts(self) -> dict[str, int]:
        """How many queries were asked, how many judgements and how many skips stand."""
        view = self._refresh()
        standing = view.standing()
        skipped = sum(isinstance(a, Skip) for a in standing.values())
        return {"asked": len(view.queries), "answered": len(standing) - skipped, "skipped": skipped}

    def _refresh(self) -> _View:
        for one in self._log.since(self._view.sequence):
            self._view.read(one)
        return self._view


def _describe(candidate: Candidate) -> dict[str, Any]:
    if isinstance(candidate, Segment):
        return {"type": "segment", "episode": candidate.episode, "start": candidate.start, "steps": len(candidate)}
    tokens = {"prompt_tokens": list(candidate.prompt_tokens), "tokens": list(candidate.tokens)}
    return {"type": "response", "prompt": candidate.prompt, "text": candidate.text, **tokens}


def _load(id: str, body: dict[str, Any], blobs: Path) -> Any:
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


def _check_event(one: dict[str, Any], queries: dict[str, list[str]], candidates: dict[str, Any], blobs: Path) -> None:
    """Check an event from elsewhere against those before it, and remember it if later ones may speak of it."""
    if not all(isinstance(one[name], str) for name in ("id", "kind", "subject", "actor", "at")):
        raise TypeError("id, kind, subject, actor and at must be strings")
    if one["kind"] == "candidate":
        candidates[one["id"]] = _load(one["id"], one["body"], blobs)
    elif one["kind"] == "query":
        queries[one["id"]] = _check_query(one["id"], one["body"], candidates)
    elif one["subject"] not in queries:
        raise StoreError(f"it speaks of query {one['subject'][:12]}, which is not there")
    elif not one["id"].startswith(f"{one['subject']}:{one['actor']}:"):
        raise StoreError(f"its id {one['id'][:20]} is not that of an answer to its query by its labeler")
    elif one["kind"] in ANSWERS:
        _check_size(_answer(one["kind"], one["subject"], one["actor"], one["body"]), len(queries[one["subject"]]))
    elif one["kind"] != "retract":
        raise StoreError(f"unknown kind {one['kind']!r}")


def _check_size(answer: Answer, size: int) -> None:
    try:
        check_fits(answer, size)
    except ValueError as error:
        raise StoreError(str(error)) from None


def _check_query(id: str, body: dict[str, Any], candidates: dict[str, Any]) -> list[str]:
    """The candidates of a query from elsewhere; they must be there, and make up its id."""
    if Query(tuple(candidates[c] for c in body["candidates"])).id != id:
        raise StoreError(f"query {id[:12]} does not have the sha256 of its candidates")
    return list(body["candidates"])


def _answer(kind: str, query: str, labeler: str, body: dict[str, Any]) -> Answer:
    """The answer that an event holds; JSON has lists where answers have tuples."""
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in body.items()}
    return ANSWERS[kind](query=query, labeler=labeler, **values)
