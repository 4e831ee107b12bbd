"""The same store over a PostgreSQL server, which these tests start for themselves."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sql
from sqlalchemy.exc import DBAPIError
from stores import derived, fill, responses

from prefrl.log import DamagedStore, StoreError
from prefrl.maintenance import backup, repair_derived, verify_store
from prefrl.projection import dump, rebuild
from prefrl.store import Store
from prefrl.types import Comparison, Response, Skip

pytest.importorskip("psycopg")


def program(name: str) -> str | None:
    """Debian keeps the server's programs off the path."""
    found = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    return str(found[-1]) if found else shutil.which(name)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The URL of a server of our own, on a free port of this machine. It refuses to run as root."""
    initdb, postgres = program("initdb"), program("postgres")
    if initdb is None or postgres is None:
        pytest.skip("no PostgreSQL server is installed: apt-get install -y postgresql")
    folder = tmp_path_factory.mktemp("postgres")
    user = "nobody" if os.getuid() == 0 else None
    if user:
        for path in (folder, *folder.parents[:2]):
            path.chmod(0o755)
        shutil.chown(folder, user)
    data = folder / "data"
    init = [initdb, "-D", str(data), "-U", "prefrl", "-A", "trust", "--no-sync", "-E", "UTF8", "--locale=C"]
    subprocess.run(init, user=user, check=True, capture_output=True, cwd=folder)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [postgres, "-D", str(data), "-p", str(port), "-k", "", "-h", "127.0.0.1", "-F"]
    running = subprocess.Popen(command, user=user, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"postgresql+psycopg://prefrl@127.0.0.1:{port}/postgres"
    try:
        _wait(url)
        yield url
    finally:
        running.terminate()
        running.wait(20)


def _wait(url: str) -> None:
    engine = sql.create_engine(url)
    for _ in range(200):
        try:
            engine.connect().close()
            break
        except DBAPIError:
            time.sleep(0.1)
    engine.dispose()


@pytest.fixture
def url(server: str, request: pytest.FixtureRequest) -> str:
    """A new database."""
    name = f"test_{abs(hash(request.node.name))}"
    engine = sql.create_engine(server, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.exec_driver_sql(f"CREATE DATABASE {name}")
    engine.dispose()
    return server.replace("/postgres", f"/{name}")


@pytest.fixture
def folder(tmp_path: Path, url: str) -> Path:
    """A store's folder that names its database."""
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "store.url").write_text(url + "\n")
    return tmp_path / "store"


def test_it_holds_the_same_as_sqlite(folder: Path, tmp_path: Path) -> None:
    with Store[Response](folder) as store, Store[Response](tmp_path / "sqlite") as other:
        fill(store)
        fill(other)
        assert store.counts() == other.counts()
        assert [j.judgement for j in store.judged()] == [j.judgement for j in other.judged()]
        assert store.answers() == other.answers()
        assert [q.id for q in store.open_queries("bob")] == [q.id for q in other.open_queries("bob")]
        assert [e["body"] for e in store.events()] == [e["body"] for e in other.events()]
        assert derived(folder) == derived(tmp_path / "sqlite")
    assert not (folder / "store.db").exists()


def test_derived_tables_are_the_same_when_written_again(folder: Path) -> None:
    with Store[Response](folder) as store:
        fill(store)
        before = derived(folder)
        with store.log.transaction() as tx:
            rebuild(tx.connection)
        with store.log.reading() as connection:
            assert list(dump(connection)) == before


def test_snapshots_retractions_and_doubles(folder: Path) -> None:
    first, second = responses(2)
    with Store[Response](folder) as store:
        store.ask([first, second])
        for _ in range(2):
            store.answer([Comparison(first.id, 1.0, "me")])
        snapshot = store.sequence
        store.retract(first.id, "me")
        store.answer([Comparison(first.id, 0.0, "me"), Skip(second.id, "skip", "me")])
        assert store.judged(snapshot)[0].judgement == Comparison(first.id, 1.0, "me")
        assert store.judged()[0].judgement == Comparison(first.id, 0.0, "me")
        assert store.counts() == {"asked": 2, "answered": 1, "skipped": 1}


def test_a_transaction_that_fails_leaves_nothing(folder: Path) -> None:
    first, second = responses(2)
    with Store[Response](folder) as store:
        store.ask([first])
        with pytest.raises(StoreError, match="never asked"):
            store.answer([Comparison(first.id, 1.0), Comparison(second.id, 1.0)])
        with store.log.transaction() as tx:
            store.put(tx, Comparison(first.id, 1.0, "a"), {})
            with contextlib.suppress(StoreError), tx.savepoint():
                store.put(tx, Comparison(first.id, 1.0, "b"), {})
                raise StoreError("no")
        assert [a.labeler for a in store.answers()] == ["a"]
    assert verify_store(folder).ok


def test_the_database_refuses_changes_to_the_log(folder: Path, url: str) -> None:
    with Store[Response](folder) as store:
        store.ask(responses(2))
    engine = sql.create_engine(url)
    for statement in ("UPDATE event SET actor = 'eve'", "DELETE FROM event", "TRUNCATE event"):
        with pytest.raises(DBAPIError, match="append-only"), engine.begin() as connection:
            connection.exec_driver_sql(statement)
    engine.dispose()


def test_a_second_writer_on_another_machine_is_refused(folder: Path, url: str, tmp_path: Path) -> None:
    with Store[Response](folder):
        with pytest.raises(StoreError, match="another process is writing"):
            Store[Response](tmp_path / "elsewhere", url=url)
        with Store[Response](tmp_path / "elsewhere", write=False, url=url) as reader:
            assert reader.counts()["asked"] == 0
    Store[Response](tmp_path / "elsewhere", url=url).close()


def test_changes_behind_its_back_are_found_repaired_and_copied(folder: Path, url: str, tmp_path: Path) -> None:
    with Store[Response](folder) as store:
        fill(store)
    assert verify_store(folder).ok
    engine = sql.create_engine(url)
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE query SET judged = 9")
    assert not verify_store(folder).ok
    repair_derived(folder)
    assert backup(folder, tmp_path / "copy") == verify_store(folder).events
    assert verify_store(tmp_path / "copy").ok
    with engine.begin() as connection:
        connection.exec_driver_sql("DROP TRIGGER event_append_only ON event")
        connection.exec_driver_sql("DELETE FROM event WHERE seq = (SELECT max(seq) FROM event)")
    engine.dispose()
    assert not verify_store(folder).ok
    with pytest.raises(DamagedStore):
        Store[Response](folder)
