"""Answers that come while things change under them: the run ends, a person is sent away, the server closes (F38)."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from stores import responses
from web_service import answering, ask_for, browser, invite, log_in, serving

from prefrl.page import records
from prefrl.page.desk import Desk
from prefrl.page.people import cookie_name
from prefrl.page.questions import BETWEEN, Given, Past, Policy, Question
from prefrl.store import Store


@pytest.fixture
def texts(tmp_path: Path) -> Any:
    with Store[Any](tmp_path / "texts") as store:
        store.ask(responses(3))
        yield store


def held(client: TestClient) -> str:
    found: str = ask_for(client)[0]["assignment_id"]
    return found


def answers(store: Store[Any]) -> int:
    return store.counts()["answered"]


def test_an_answer_that_comes_when_the_run_needs_no_more_is_kept(texts: Store[Any]) -> None:
    with serving(texts, "text") as service:
        ann = log_in(service, "ann")
        task = held(ann)
        service.finished = True
        assert ann.get("/api/state").json()["finished"]
        assert ann.post("/api/assignments", json={"want": 1}).json() == {"assignments": [], "reason": "done"}
        assert ann.post("/api/answers", json=answering(task)).status_code == 200
    assert answers(texts) == 1


def test_an_answer_that_comes_after_a_pause_began_is_kept(texts: Store[Any]) -> None:
    with serving(texts, "text") as service:
        boss, ann = log_in(service, "boss", "admin"), log_in(service, "ann")
        task = held(ann)
        boss.post("/api/admin/annotators/ann/pause")
        assert ann.post("/api/answers", json=answering(task)).status_code == 200
        assert ann.get("/api/state").json()["paused"]
    assert answers(texts) == 1


def test_an_answer_of_who_was_sent_away_is_refused_and_the_question_goes_to_another(texts: Store[Any]) -> None:
    with serving(texts, "text") as service:
        boss, ann, ben = log_in(service, "boss", "admin"), log_in(service, "ann"), log_in(service, "ben")
        question = ask_for(ann)[0]
        boss.post("/api/admin/annotators/ann/revoke")
        refused = ann.post("/api/answers", json=answering(question["assignment_id"]))
        assert refused.status_code == 401
        assert "not logged in" in refused.json()["error"]
        service.clock.now += service.terms.policy.lease_seconds + 1  # type: ignore[attr-defined]
        assert question["query_id"] in {one["query_id"] for one in ask_for(ben, 4)}
    assert answers(texts) == 0


def test_an_answer_that_nobody_needs_any_more_is_kept(texts: Store[Any]) -> None:
    with serving(texts, "text", overlap=2) as service:
        boss, ann, ben = log_in(service, "boss", "admin"), log_in(service, "ann"), log_in(service, "ben")
        one, other = ask_for(ann)[0], ask_for(ben)[0]
        assert one["query_id"] == other["query_id"]
        assert boss.post("/api/admin/project", json={"overlap": 1}).status_code == 204
        for client, task in ((ann, one), (ben, other)):
            assert client.post("/api/answers", json=answering(task["assignment_id"])).status_code == 200
        assert service.desk.counts().answered == 1
    assert answers(texts) == 2


def test_an_answer_that_comes_while_the_server_closes_can_be_sent_again_later(texts: Store[Any]) -> None:
    with serving(texts, "text") as service:
        ann = log_in(service, "ann")
        cookie, sent = ann.cookies[cookie_name(service)], answering(held(ann))
    refused = ann.post("/api/answers", json=sent)
    assert refused.status_code == 503
    assert int(refused.headers["retry-after"]) > 0
    assert answers(texts) == 0
    with serving(texts, "text") as service:
        again = browser(service)
        again.cookies.set(cookie_name(service), cookie)
        receipts = [again.post("/api/answers", json=sent).json() for _ in range(2)]
    assert [one["duplicate"] for one in receipts] == [False, True]
    assert receipts[0]["seq"] == receipts[1]["seq"]
    assert answers(texts) == 1


def test_taking_back_that_arrives_twice_does_not_take_back_the_next_answer(texts: Store[Any]) -> None:
    with serving(texts, "text") as service:
        ann = log_in(service, "ann")
        task = held(ann)
        ann.post("/api/answers", json=answering(task, "first"))
        undo = {"submission_id": "b" * 32, "assignment_id": task}
        assert ann.post("/api/undo", json=undo).status_code == 200
        assert ann.post("/api/answers", json=answering(task, "second")).status_code == 200
        assert ann.post("/api/undo", json=undo).json()["assignment"]["assignment_id"] == task
        assert ann.get("/api/me").json()["progress"]["mine"] == 1
    assert answers(texts) == 1


def test_after_a_restart_a_question_is_held_by_who_was_given_it_last() -> None:
    question = Question("q", 1, 1, 2, names=BETWEEN.join(["ann", "ben"]))
    gone, at_work = Given("a" * 32, "q", "ann", "label", (0, 1)), Given("b" * 32, "q", "ben", "label", (1, 0))
    desk = Desk(Policy())
    desk.load([question], [gone, at_work], 0, 1)
    for name in ("ann", "ben"):
        desk.tell(name, Past(given=1))
    assert desk.pick("ann", 1) == ([], [])
    assert desk.pick("ben", 1) == ([at_work], [])


def test_what_a_run_asks_while_an_admin_changes_the_overlap_is_given_out(
    texts: Store[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(texts, "text") as service:
        read = records.unanswered

        def next_round() -> None:
            texts.ask(responses(6))
            service.refresh()

        run = threading.Thread(target=next_round)

        def slow(connection: Any) -> Any:
            found = read(connection)
            run.start()
            run.join(0.5)
            return found

        boss = log_in(service, "boss", "admin")
        with monkeypatch.context() as patch:
            patch.setattr(records, "unanswered", slow)
            assert boss.post("/api/admin/project", json={"overlap": 2}).status_code == 204
        run.join()
        assert service.desk.counts().asked == texts.counts()["asked"] == 6
        assert len(ask_for(log_in(service, "ann"), 6)) == 6


def test_of_two_admins_who_invite_the_same_name_at_once_the_first_one_stands(texts: Store[Any]) -> None:
    with serving(texts, "text") as service:
        both = [service.access.invite("zoe", role) for role in ("annotator", "admin")]
        for _, events in both:
            service.append(events)
        assert [service.access.who(token, "invite").role for token, _ in both] == ["annotator"] * 2  # type: ignore[union-attr]
    with serving(texts, "text") as service:
        assert service.access.person("zoe").role == "annotator"  # type: ignore[union-attr]
        assert invite(service, "zoe")
