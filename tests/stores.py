"""Small stores with some of everything in them, for tests of the store itself."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from pathlib import Path
from typing import Any

from prefrl.judgements import Choice, Comparison, Ranking, Skip
from prefrl.storage.log import row
from prefrl.storage.projection import dump
from prefrl.store import Store
from prefrl.types import Query, Response


def responses(count: int, size: int = 2) -> list[Query[Response]]:
    """Queries over short texts."""
    return [Query(tuple(Response(f"prompt {i}", f"réponse {i}.{k}") for k in range(size))) for i in range(count)]


def fill(store: Store[Response], count: int = 12) -> None:
    """Questions, checks, assignments, answers of every sort, retractions, people and their keys."""
    pairs, triples = responses(count), responses(count, 3)
    store.ask([*pairs, *triples[1:]])
    store.ask(triples[:1], purpose="check", expected=[2])
    with store.log.transaction() as tx:
        tx.append(row("annotator:ann", "annotator", actor="ann", body={"role": "annotator"}))
        tx.append(row("annotator:bob", "annotator", actor="bob", body={"role": "admin"}))
        for number, who in enumerate(("ann", "bob", "bob")):
            tx.append(row(f"token:{number:064x}", "token", actor=who, body={"use": "session"}))
        tx.append(row("revoke:1", "revoke", subject=f"{1:064x}", actor="bob"))
        tx.append(row("state:1", "state", actor="ann", body={"state": "paused"}))
        tx.append(row("guideline:1", "guideline", actor="bob", body={"text": "Look twice.\n"}))
        tx.append(row("project:1", "project", actor="bob", body={"overlap": 3}))
        tx.append(row("flag:1", "flag", pairs[0].id, "ann", {"text": "too dark"}))
        for number, query in enumerate(pairs):
            put(store, tx, number, query, "ann")
        tx.append(row(f"{999:032x}", "assign", pairs[0].id, "ann", {"shown": [1, 0], "purpose": "repeat"}))
        again = {"answer": {"kind": "comparison", "preference": 0.0}, "about": {"assignment": f"{999:032x}"}}
        tx.append(row(f"repeat:{999:032x}", "repeat", pairs[0].id, "ann", again))
    store.answer([Ranking(q.id, (0, 1, 1), "bob", (2, 0, 1)) for q in triples[1:4]])
    store.answer([Choice(triples[4].id, 1, "bob"), Skip(pairs[0].id, "skip", "bob"), Comparison(pairs[-1].id, 0.25)])
    store.retract(triples[2].id, "bob")
    store.answer([Ranking(triples[2].id, (2, 1, 0), "bob")])
    store.answer([Ranking(triples[0].id, (1, 1, 0), "bob")])


def put(store: Store[Response], tx: Any, number: int, query: Query[Response], who: str) -> None:
    """One assignment and its answer."""
    tx.append(row(f"{number:032x}", "assign", query.id, who, {"shown": [1, 0], "purpose": "label", "guideline": "g"}))
    about = {"submission": f"{number:032x}", "digest": "d", "assignment": f"{number:032x}"}
    kinds = (Comparison(query.id, 1.0, who, (1, 0)), Skip(query.id, "incomparable", who), Skip(query.id, "skip", who))
    store.put(tx, kinds[number % 3], about)


def seal(bundle: Path) -> None:
    """Make the manifest fit what lies there, as somebody who means harm would."""
    files = [path for path in bundle.rglob("*") if path.is_file() and path.name != "MANIFEST.json"]
    hashes = {path.relative_to(bundle).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    (bundle / "MANIFEST.json").write_text(json.dumps(hashes))


def checkpoint(store: Store[Response]) -> None:
    """Move everything from the write-ahead log into the database's file."""
    assert store.log._writer is not None
    with store.log._writer.connect() as connection:
        connection.exec_driver_sql("COMMIT")
        connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.exec_driver_sql("BEGIN")


def derived(folder: Path) -> list[str]:
    """The derived tables, line by line."""
    with Store[Response](folder, write=False) as store, store.log.reading() as connection:
        return list(dump(connection))


def logical(path: Path) -> list[Any]:
    """All that a database says, whatever lies where in its file; with faults where it cannot be read."""
    found: list[Any] = []
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
    try:
        for (name,) in connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
        ).fetchall():
            found.append((name, sorted(map(repr, connection.execute(f"SELECT * FROM {name}")))))
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        found.append(json.dumps(str(error)))
    finally:
        connection.close()
    return found
