"""Check questions, and who is paused since they do not look."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from stores import responses
from web_service import STRENGTHS, answering, ask_for, log_in, page

from prefrl.page import records
from prefrl.page.questions import Policy, Terms
from prefrl.page.service import Service
from prefrl.page.tallies import attention
from prefrl.store import Store


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store[Any]]:
    """Twenty checks, of which the first candidate is the best one, and a question that is never reached."""
    with Store[Any](tmp_path / "store") as opened:
        one, *checks = responses(21)
        opened.ask([one])
        opened.ask(checks, purpose="check", expected=[0] * len(checks))
        yield opened


@contextmanager
def serving(store: Store[Any], pause: float) -> Iterator[Service]:
    terms = Terms(page("text"), Policy(overlap=9, check_share=1.0), STRENGTHS, check_pause=pause, rate=1e6)
    service = Service(store, terms)
    service.open()
    yield service
    service.close()


def answer(service: Service, client: TestClient, rightly: bool, outcome: str = "") -> None:
    (card,) = ask_for(client)
    with service.store.log.reading() as connection:
        found = records.given(connection, card["assignment_id"])
    assert found is not None
    assert found[0].purpose == "check"
    sides = ("first", "second") if found[0].shown[0] == 0 else ("second", "first")
    sent = answering(card["assignment_id"], outcome or sides[not rightly])
    assert client.post("/api/answers", json=sent).status_code == 200


def paused(client: TestClient) -> bool:
    return bool(client.get("/api/state").json()["paused"])


def test_who_fails_checks_is_paused_and_counted_anew_once_they_may_go_on(store: Store[Any]) -> None:
    with serving(store, pause=0.6) as service:
        ann, boss = log_in(service, "ann"), log_in(service, "boss", "admin")
        answer(service, ann, rightly=False, outcome="skip")
        for failures in range(3):  # none of two may still be chance: the interval reaches up to 0.66
            assert not paused(ann), f"paused after {failures} failures"
            answer(service, ann, rightly=False)
        assert paused(ann)
        assert ann.post("/api/assignments", json={"want": 1}).json() == {"assignments": [], "reason": "paused"}
        state = [event for event in store.log.since(0) if event["kind"] == "state"][-1]
        assert (state["actor"], state["body"]["state"]) == ("ann", "paused")
        assert state["body"]["why"] == "checks answered as expected: 0% of 3, less than 60%"
        assert boss.post("/api/admin/annotators/ann/resume").status_code == 200
        answer(service, ann, rightly=False)
        assert not paused(ann)


def test_who_looks_is_not_paused_nor_is_an_admin(store: Store[Any]) -> None:
    with serving(store, pause=0.9) as service:
        ann, boss = log_in(service, "ann"), log_in(service, "boss", "admin")
        for _ in range(6):
            answer(service, ann, rightly=True)
            answer(service, boss, rightly=False)
        assert not paused(ann)
        assert not paused(boss)
        with store.log.reading() as connection:
            assert [attention(connection, name).value for name in ("ann", "boss", "nobody")] == [1.0, 0.0, None]


def test_nobody_is_paused_unless_asked(store: Store[Any]) -> None:
    with serving(store, pause=0.0) as service:
        ann, boss = log_in(service, "ann"), log_in(service, "boss", "admin")
        for _ in range(6):
            answer(service, ann, rightly=False)
        assert not paused(ann)
        (row,) = [one for one in boss.get("/api/admin/overview").json()["annotators"] if one["name"] == "ann"]
        assert row["concerns"][0] == "checks answered as expected: 0% of 6, less than 80%"
