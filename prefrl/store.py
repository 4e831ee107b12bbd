"""Every behaviour asked about and every answer given: an append-only log of events, beside files named by content.

The log is the truth; the tables beside it are derived from it in the same transaction, and can be written again. The
arrays of segments lie in `blobs/`, the hidden gold in `gold/`, which nothing but an oracle or an evaluation opens.
One process writes at a time, from any of its threads; any number may read while it does.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Generic

import sqlalchemy as sql

from prefrl.judgements import Answer, Demonstrated, Demonstration, Judged, check_fits
from prefrl.storage.arrivals import Merged, check_arrivals
from prefrl.storage.blobs import read_arrays, write_arrays
from prefrl.storage.events import answer_body, answer_kind, describe, load_candidate, read_answer, write_candidate
from prefrl.storage.log import EventLog, StoreError, StoreFull, Transaction, row
from prefrl.storage.projection import ANSWERS, CHUNK, JUDGEMENTS, bodies, chunks, words
from prefrl.storage.tables import event, standing
from prefrl.storage.tables import query as asked
from prefrl.types import C, Candidate, Floats, Json, Query

WRITERS = 16
"""Files written at once."""
_SIZE = sql.select(asked.c.id, asked.c.size).where(asked.c.id == sql.bindparam("b_id"))


class Store(Generic[C]):
    """A store in a folder (see the module's docstring); fits `prefrl.protocols.Store`."""

    def __init__(self, folder: str | Path, write: bool = True, url: str | None = None) -> None:
        """Open, or make, the store of a folder.

        Raises `StoreError` where another process is writing to it, where it is missing (for reading), damaged, or
        from a newer prefrl. `url` names another SQLAlchemy database for the log; so does a file `store.url` in the
        folder.
        """
        self.folder = Path(folder)
        self.log = EventLog(self.folder, write, url)
        self._queries: dict[str, tuple[str, ...]] = {}
        self._loaded: dict[str, C] = {}

    def close(self) -> None:
        """Let go of the database, and of the right to write."""
        self.log.close()

    def __enter__(self) -> Store[C]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- writing ---------------------------------------------------------------------------------------------

    def ask(self, queries: Sequence[Query[C]], purpose: str = "label", expected: Sequence[int] = ()) -> None:
        """Add queries with their candidates; what is there already is left alone. Gold is filed apart.

        With the purpose "check" nothing is learned from them: they find out whether a person looks, and `expected`
        says which candidate of each is clearly the best.
        """
        candidates = {c.id: c for query in queries for c in query.candidates}
        self._check_kind(candidates.values())
        # Files before events: what the log names must be there, and a file that it does not name does no harm.
        self._file(candidates.values())
        more: list[Json] = [{} for _ in queries]
        if purpose != "label":
            more = [{"purpose": purpose, "expected": best} for _, best in zip(queries, expected, strict=True)]
        with self.log.transaction() as tx:
            rows = _rows(candidates.values())
            for query, extra in zip(queries, more, strict=True):
                body = {"candidates": [c.id for c in query.candidates], "batch": tx.seq} | extra
                rows.append(row(query.id, "query", body=body))
            tx.extend(rows)

    def keep(self, candidates: Sequence[C]) -> None:
        """Add candidates that no query asks about: behaviours for demonstrations to show. Gold is filed apart."""
        self._check_kind(candidates)
        self._file(candidates)
        with self.log.transaction() as tx:
            tx.extend(_rows(candidates))

    def answer(self, answers: Sequence[Answer]) -> None:
        """Add answers, in one transaction; one per query and labeler: the first stands until it is retracted."""
        with self.log.transaction() as tx:
            self.put_all(tx, answers)

    def put_all(self, tx: Transaction, answers: Sequence[Answer], about: Json | None = None) -> list[int]:
        """Add answers in a transaction; returns their numbers. `about` is kept with each: how it came about."""
        sizes = _sizes(tx, {answer.query for answer in answers})
        there = words(tx.connection, [(answer.query, answer.labeler) for answer in answers])
        rows = []
        for answer in answers:
            if answer.query not in sizes:
                raise StoreError(f"an answer to query {answer.query[:12]}, which was never asked")
            _check_size(answer, sizes[answer.query])
            body = answer_body(answer) | ({"about": about} if about else {})
            revision = there.get((answer.query, answer.labeler), {"revision": 0})["revision"]
            id = f"{answer.query}:{answer.labeler}:{revision}"
            rows.append(row(id, answer_kind(answer), answer.query, answer.labeler, body))
        self._check_shown(tx, [answer for answer in answers if isinstance(answer, Demonstration)])
        return tx.extend(rows)

    def put(self, tx: Transaction, answer: Answer, about: Json) -> int:
        """Add one answer in a transaction; returns its number."""
        return self.put_all(tx, [answer], about)[0]

    def show(self, tx: Transaction, like: C, answer: Demonstration, about: Json) -> int:
        """Add a behaviour and the demonstration that it is, in a transaction; returns the answer's number."""
        try:
            self._file_one(like)  # before its event, as in `ask`
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise StoreFull(f"the disk with {self.folder} is full: this was not stored, try again later") from error
        tx.extend(_rows([like]))
        return self.put(tx, answer, about)

    def retract(self, query: str, labeler: str) -> None:
        """Take a labeler's answer back; the log keeps both."""
        with self.log.transaction() as tx:
            self.take_back(tx, query, labeler)

    def take_back(self, tx: Transaction, query: str, labeler: str, about: Json | None = None) -> int:
        """Take a labeler's answer back in a transaction; returns the retraction's number."""
        word = words(tx.connection, [(query, labeler)]).get((query, labeler))
        if word is None or word["kind"] == "retracted":
            raise StoreError(f"{labeler!r} has no answer to query {query[:12]} to take back")
        id = f"{query}:{labeler}:{word['revision']}:retract"
        return tx.append(row(id, "retract", query, labeler, {"about": about} if about else {}))

    def merge(self, events: Callable[[], Iterable[Json]], blobs: Path) -> Merged:
        """Add the events of another store, arrays from its `blobs` folder; returns how many answers are new.

        All or none, and few in memory at a time: each is checked before anything is written, so `events` is called
        twice. Raises `ValueError` as `check_arrivals` does.
        """
        with self.log.reading() as connection:
            merged = check_arrivals(events(), blobs, connection)
        with self.log.transaction() as tx, ThreadPoolExecutor(WRITERS) as pool:
            for some in chunks(events(), CHUNK):
                list(pool.map(partial(self._copy, blobs), (e for e in some if e["kind"] == "candidate")))
                tx.extend(some)
        return merged

    def _check_shown(self, tx: Transaction, answers: Sequence[Demonstration]) -> None:
        """Raise `StoreError` unless what each shows is here, and of its query's context."""
        asked = bodies(tx.connection, (one.query for one in answers))
        own = {one.query: asked[one.query]["candidates"][0] for one in answers}
        found = bodies(tx.connection, (*own.values(), *(one.like for one in answers)))
        contexts = {id: load_candidate(id, body, self.folder / "blobs").context for id, body in found.items()}
        for one in answers:
            if one.like not in found:
                raise StoreError(f"a demonstration of candidate {one.like[:12]}, which the store does not hold")
            if contexts[one.like] != contexts[own[one.query]]:
                raise StoreError(f"query {one.query[:12]} is answered by a behaviour of another context (prompt)")

    def _copy(self, blobs: Path, one: Json) -> None:
        self._file_one(load_candidate(one["id"], one["body"], blobs))

    def _check_kind(self, candidates: Iterable[Candidate]) -> None:
        """A store holds candidates of one kind: a learner could make nothing of the others."""
        there, new = self.holds, next(iter(candidates), None)
        if there and new is not None and there != describe(new)["type"]:
            raise StoreError(f"the store in {self.folder} holds {there}s, and cannot hold {type(new).__name__}s")

    def _file(self, candidates: Iterable[Candidate]) -> None:
        """Write arrays and gold, each under its id; in threads, since each file waits for the disk."""
        with ThreadPoolExecutor(WRITERS) as pool:
            list(pool.map(self._file_one, candidates))  # waits, and raises what a thread raised

    def _file_one(self, candidate: Candidate) -> None:
        write_candidate(candidate, self.folder / "blobs")
        if candidate.gold is not None:
            write_arrays(self.folder / "gold", candidate.id, {"gold": candidate.gold})

    # --- reading ---------------------------------------------------------------------------------------------

    @property
    def sequence(self) -> int:
        """The number of the newest event: the snapshot that a fit is made on."""
        return self.log.sequence

    @property
    def holds(self) -> str:
        """What its candidates are called (`Kind.noun`); "" where there are none yet."""
        with self.log.reading() as connection:
            body = connection.scalar(sql.select(event.c.body).where(event.c.kind == "candidate").limit(1))
        return str(body["type"]) if body else ""

    def open_queries(self, labeler: str = "") -> list[Query[C]]:
        """Queries without a judgement that this labeler has not skipped, oldest first. Candidates carry no gold."""
        mine = standing.alias()
        skipped = (mine.c.query == asked.c.id) & (mine.c.labeler == labeler) & (mine.c.kind == "skip")
        unanswered = (asked.c.purpose == "label") & (asked.c.judged == 0) & (asked.c.incomparable == 0)
        some = sql.select(asked.c.id).where(unanswered, ~sql.exists().where(skipped)).order_by(asked.c.seq)
        with self.log.reading() as connection:
            ids = list(connection.scalars(some))
        self._fetch(ids)
        return [self.query(id) for id in ids]

    def judged(self, upto: int | None = None) -> list[Judged[C]]:
        """Queries with their judgements, in the order in which they were given, up to a sequence number."""
        answers = list(self._standing(JUDGEMENTS, upto))
        self._fetch({answer.query for answer in answers})
        return [Judged(self.query(a.query), a) for a in answers if a.reason is None]

    def demonstrations(self, upto: int | None = None) -> list[Demonstrated[C]]:
        """Queries with the behaviours that answer them, in the order in which they were given, up to a sequence
        number."""
        answers = [a for a in self._standing(["demonstration"], upto) if isinstance(a, Demonstration)]
        self._fetch({answer.query for answer in answers})
        self._load({answer.like for answer in answers})
        return [Demonstrated(self.query(a.query), self.candidate(a.like), a) for a in answers]

    def answers(self) -> list[Answer]:
        """Every answer that stands, skips included, in the order in which they were given."""
        return list(self._standing(ANSWERS))

    def _standing(self, kinds: Sequence[str], upto: int | None = None) -> Iterator[Answer]:
        """Answers that no later word of the same labeler on the same query has replaced."""
        later = event.alias()
        snapshot = self.sequence if upto is None else upto
        same = (later.c.subject == event.c.subject) & (later.c.actor == event.c.actor)
        after = same & (later.c.seq > event.c.seq) & (later.c.seq <= snapshot)
        known = event.c.kind.in_(kinds) & (event.c.seq <= snapshot)
        replaced = sql.exists().where(after, later.c.kind.in_((*ANSWERS, "retract")))
        trains = sql.exists().where(asked.c.id == event.c.subject, asked.c.purpose == "label")
        with self.log.reading() as connection:
            for one in connection.execute(sql.select(event).where(known, ~replaced, trains).order_by(event.c.seq)):
                yield read_answer(one.kind, one.subject, one.actor, one.body)

    def events(self) -> Iterator[Json]:
        """The whole log, oldest first: what a lossless copy needs, beside the blobs."""
        return self.log.since(0)

    def query(self, id: str) -> Query[C]:
        """A query by its id, with its candidates. Raises `StoreError` for one that was never asked."""
        if id not in self._queries:
            self._fetch([id])
        return Query(tuple(self.candidate(c) for c in self._queries[id]))

    def candidate(self, id: str) -> C:
        """A candidate by its id, without gold. Segments are read from their blob once, and kept."""
        if id not in self._loaded:
            self._load({id})
        return self._loaded[id]

    def _fetch(self, ids: Iterable[str]) -> None:
        """Have queries and their candidates in memory, with few looks at the database."""
        new = [id for id in dict.fromkeys(ids) if id not in self._queries]
        bodies = self._bodies(new, "query")
        self._queries |= {id: tuple(bodies[id]["candidates"]) for id in new}
        self._load({c for id in new for c in self._queries[id]})

    def _load(self, ids: set[str]) -> None:
        new = [id for id in ids if id not in self._loaded]
        for id, body in self._bodies(new, "candidate").items():
            self._loaded[id] = load_candidate(id, body, self.folder / "blobs")

    def _bodies(self, ids: Sequence[str], kind: str) -> Json:
        """What was said of queries or candidates when they were asked."""
        with self.log.reading() as connection:
            found = bodies(connection, ids)
        if missing := [id for id in ids if id not in found]:
            raise StoreError(f"the store in {self.folder} holds no {kind} {missing[0][:12]}")
        return found

    def gold(self, candidates: Sequence[C]) -> list[Floats]:
        """The hidden values of candidates: for oracles and evaluation only."""
        return [read_arrays(self.folder / "gold", c.id)["gold"] for c in candidates]

    def counts(self) -> dict[str, int]:
        """How many queries were asked, how many answers and how many skips stand; and of the answers, where there are
        any, how many are demonstrations."""
        columns = (sql.func.count(), sql.func.sum(asked.c.judged), sql.func.sum(asked.c.skipped + asked.c.incomparable))
        with self.log.reading() as connection:
            numbers = connection.execute(sql.select(*columns).where(asked.c.purpose == "label")).one()
            shown = connection.scalar(sql.select(sql.func.count()).where(standing.c.kind == "demonstration"))
        counts = dict(zip(("asked", "answered", "skipped"), (int(n or 0) for n in numbers), strict=True))
        return counts | ({"demonstrations": int(shown)} if shown else {})

    def progress(self) -> tuple[int, int, int]:
        """How many queries were asked, how many of them have a judgement, and how many have nothing but skips."""
        judged, skips = asked.c.judged > 0, asked.c.skipped + asked.c.incomparable > 0
        done, left = sql.case((judged, 1), else_=0), sql.case((~judged & skips, 1), else_=0)
        columns = (sql.func.count(), sql.func.sum(done), sql.func.sum(left))
        with self.log.reading() as connection:
            numbers = connection.execute(sql.select(*columns).where(asked.c.purpose == "label")).one()
        total, answered, skipped = (int(n or 0) for n in numbers)
        return total, answered, skipped

    def attention(self) -> float:
        """Seconds that people took to answer, checks and repetitions included, as far as a page timed them."""
        timed = sql.select(event.c.body).where(event.c.body.cast(sql.Text).contains('"decision_ms":'))
        with self.log.reading() as connection:
            abouts = [body.get("about") or {} for body in connection.scalars(timed)]
        return sum((about.get("timings") or {}).get("decision_ms") or 0.0 for about in abouts) / 1000

    def asked_before(self, ids: Sequence[str], sequence: int) -> set[str]:
        """Which of these queries and candidates had been asked about by then."""
        found: set[str] = set()
        with self.log.reading() as connection:
            for some in chunks(ids, CHUNK):
                known = sql.select(event.c.id).where(event.c.id.in_(some), event.c.seq <= sequence)
                found |= set(connection.scalars(known))
        return found


def _rows(candidates: Iterable[Candidate]) -> list[Json]:
    """The events that add candidates."""
    return [row(candidate.id, "candidate", body=describe(candidate)) for candidate in candidates]


def _sizes(tx: Transaction, ids: Iterable[str]) -> dict[str, int]:
    """How many candidates each query has, of those that were asked."""
    found: dict[str, int] = {}
    for some in chunks(ids, CHUNK):
        if len(some) == 1:
            rows = tx.connection.execute(_SIZE, {"b_id": some[0]})
        else:
            rows = tx.connection.execute(sql.select(asked.c.id, asked.c.size).where(asked.c.id.in_(some)))
        found |= {one.id: one.size for one in rows}
    return found


def _check_size(answer: Answer, size: int) -> None:
    try:
        check_fits(answer, size)
    except ValueError as error:
        raise StoreError(str(error)) from None
