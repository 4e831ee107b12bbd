"""The application: what people do on the page, from the first question to the store."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient
from web_service import answering, ask_for, browser, invite, log_in, serving

from prefrl.judgements import Comparison, Ranking, Skip
from prefrl.page.app import routes
from prefrl.page.people import cookie_name
from prefrl.page.service import Service
from prefrl.storage.log import StoreFull
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

Ask = Callable[..., Query[Segment]]


@pytest.fixture
def service(store: Store[Segment], make_query: Ask) -> Iterator[Service]:
    store.ask([make_query(0.0, 1.0) for _ in range(5)])
    with serving(store) as opened:
        yield opened


@pytest.fixture
def ann(service: Service) -> TestClient:
    return log_in(service, "ann")


def shown(service: Service, assignment: dict[str, Any]) -> tuple[int, ...]:
    """In which order the log says that the candidates stood."""
    found = next(one for one in service.store.log.since(0) if one["id"] == assignment["assignment_id"])
    return tuple(found["body"]["shown"])


# --- questions -----------------------------------------------------------------------------------------------------


def test_a_question_tells_nothing_but_what_is_judged(service: Service, ann: TestClient) -> None:
    for one in ask_for(ann, 4):
        assert set(one) == {"assignment_id", "query_id", "kind", "prompt", "items", "guideline", "lease_seconds"}
        for item in one["items"]:
            assert set(item) == {"slot", "media", "steps", "fps", "text", "actions"}
            assert item["actions"] is None
        text = json.dumps(one)
        for word in ("gold", "reward", "episode", "batch", "purpose", "expected", "labeler", "policy"):
            assert word not in text


def test_texts_are_shown_in_the_order_that_the_log_keeps(text_store: Store[Response]) -> None:
    query = Query(tuple(Response("p", text) for text in "abcd"))
    text_store.ask([query])
    with serving(text_store, "text") as service:
        card = ask_for(log_in(service, "ann"))[0]
        assert card["prompt"] == "p"
        order = shown(service, card)
        assert [item["text"] for item in card["items"]] == [query.candidates[i].text for i in order]


def test_a_text_that_breaks_off_within_a_character_is_shown_and_those_after_it(text_store: Store[Response]) -> None:
    texts = ("cut emoji \ud83d", "\udc00whole \U0001f600")
    text_store.ask([Query(tuple(Response("p\udfff", text) for text in texts))])
    with serving(text_store, "text") as service:
        ann = log_in(service, "ann")
        [card] = ask_for(ann, 6)
        assert card["prompt"] == "p\ufffd"
        assert {item["text"] for item in card["items"]} == {"cut emoji \ufffd", "\ufffdwhole \U0001f600"}
        assert ann.post("/api/answers", json=answering(card["assignment_id"])).status_code == 200
        assert ann.get("/api/history").json()["entries"][0]["assignment"] == card


def test_the_same_questions_come_after_a_reload_in_a_second_tab_and_after_a_restart(
    store: Store[Segment], make_query: Ask
) -> None:
    store.ask([make_query() for _ in range(9)])
    with serving(store) as service:
        ann = log_in(service, "ann")
        first = ask_for(ann, 3)
        assert ask_for(ann, 3) == first
        cookie = ann.cookies[cookie_name(service)]
    with serving(store) as service:
        again = browser(service)
        again.cookies.set(cookie_name(service), cookie)
        assert ask_for(again, 3) == first
        ben = log_in(service, "ben")
        assert not {q["query_id"] for q in ask_for(ben, 4)} & {q["query_id"] for q in first}


def test_what_is_asked_later_is_given_out_once_the_desk_knows(
    service: Service, ann: TestClient, make_query: Ask
) -> None:
    new = make_query()
    service.store.ask([new])
    service.refresh()
    assert ask_for(ann)[0]["query_id"] == new.id
    assert ann.get("/api/state").json()["progress"]["asked"] == 6


def test_who_has_answered_all_is_told_to_wait_or_that_all_is_done(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query()])
    for fixed, reason in ((False, "waiting"), (True, "done")):
        with serving(store, fixed=fixed) as service:
            ann = log_in(service, "ann")
            for card in ask_for(ann, 4):
                ann.post("/api/answers", json=answering(card["assignment_id"]))
            assert ann.post("/api/assignments", json={"want": 1}).json() == {"assignments": [], "reason": reason}


# --- answers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outcome", "strength", "left"),
    [
        ("first", None, 1.0),
        ("second", None, 0.0),
        ("tie", None, 0.5),
        ("first", "slight", 0.73),
        ("second", "much", 0.05),
    ],
)
def test_answers_are_kept_in_the_querys_own_order(
    service: Service, ann: TestClient, outcome: str, strength: str | None, left: float
) -> None:
    for card in ask_for(ann, 4):
        body = answering(card["assignment_id"], outcome, strength=strength)
        assert ann.post("/api/answers", json=body).json()["duplicate"] is False
    answers = service.store.answers()
    assert len(answers) == 4
    for answer in answers:
        assert isinstance(answer, Comparison)
        assert answer.labeler == "ann"
        assert sorted(answer.shown) == [0, 1]
        assert answer.preference == pytest.approx(left if answer.shown == (0, 1) else 1 - left)


def test_a_ranking_is_turned_from_slots_to_candidates(text_store: Store[Response]) -> None:
    query = Query(tuple(Response("p", text) for text in "abcd"))
    text_store.ask([query])
    with serving(text_store, "text") as service:
        ann = log_in(service, "ann")
        card = ask_for(ann)[0]
        wanted = {"a": 2, "b": 0, "c": 1, "d": 0}
        ranks = [wanted[item["text"]] for item in card["items"]]
        assert ann.post("/api/answers", json=answering(card["assignment_id"], "first")).status_code == 422
        short = answering(card["assignment_id"], "ranking", ranking=[0, 1])
        assert ann.post("/api/answers", json=short).status_code == 422
        body = answering(card["assignment_id"], "ranking", ranking=ranks, touched=False)
        assert ann.post("/api/answers", json=body).status_code == 200
        [answer] = text_store.answers()
        assert isinstance(answer, Ranking)
        assert answer.ranks == tuple(wanted[c.text] for c in query.candidates)


@pytest.mark.parametrize("reason", ["skip", "incomparable"])
def test_a_skip_is_asked_again_of_somebody_else_and_incomparable_is_an_answer(
    store: Store[Segment], make_query: Ask, reason: str
) -> None:
    store.ask([make_query()])
    with serving(store) as service:
        ann, ben = log_in(service, "ann"), log_in(service, "ben")
        ann.post("/api/answers", json=answering(ask_for(ann)[0]["assignment_id"], reason))
        assert store.answers() == [Skip(store.answers()[0].query, reason, "ann", store.answers()[0].shown)]  # type: ignore[arg-type]
        assert len(ask_for(ben)) == (reason == "skip")
        assert ask_for(ann) == []


def test_how_an_answer_came_about_is_kept_beside_it(service: Service, ann: TestClient) -> None:
    timings = {"visible_ms": 900, "decision_ms": 400.5, "replays": 2, "speed": 2, "watched": [1, 0.5]}
    body = answering(ask_for(ann)[0]["assignment_id"], comment="hm", flags=["blurred"], timings=timings, input="touch")
    ann.post("/api/answers", json=body)
    about = list(service.store.log.since(0))[-1]["body"]["about"]
    assert about["submission"] == body["submission_id"]
    assert about["assignment"] == body["assignment_id"]
    assert (about["comment"], about["flags"], about["input"]) == ("hm", ["blurred"], "touch")
    assert about["timings"]["decision_ms"] == 400.5
    assert about["timings"]["hidden_ms"] == 0
    assert service.store.attention() == 0.4005


def test_the_same_submission_twice_is_one_answer_with_one_number(service: Service, ann: TestClient) -> None:
    body = answering(ask_for(ann)[0]["assignment_id"])
    first, again = (ann.post("/api/answers", json=body).json() for _ in range(2))
    assert again == first | {"duplicate": True}
    other = ann.post("/api/answers", json=body | {"outcome": "second"})
    assert other.status_code == 409
    assert len(service.store.answers()) == 1


def test_a_second_answer_to_a_question_changes_nothing(service: Service, ann: TestClient) -> None:
    card = ask_for(ann)[0]
    first = ann.post("/api/answers", json=answering(card["assignment_id"], "first")).json()
    second = answering(card["assignment_id"], "second")
    for _ in range(2):
        assert ann.post("/api/answers", json=second).json() == {"seq": first["seq"], "duplicate": True}
    assert ann.post("/api/answers", json=second | {"outcome": "tie"}).status_code == 409
    assert len(service.store.answers()) == 1


def test_nobody_can_answer_undo_or_report_for_somebody_else(service: Service, ann: TestClient) -> None:
    ben, card = log_in(service, "ben"), ask_for(ann)[0]
    body = answering(card["assignment_id"])
    assert ben.post("/api/answers", json=body).status_code == 409
    ann.post("/api/answers", json=body)
    assert ben.post("/api/answers", json=body).status_code == 409
    undo = {"submission_id": secrets.token_hex(16), "assignment_id": card["assignment_id"]}
    assert ben.post("/api/undo", json=undo).status_code == 409
    assert ben.post("/api/flags", json=undo | {"text": "x"}).status_code == 409
    assert ben.post("/api/answers", json=answering("0" * 32)).status_code == 404
    assert [one.labeler for one in service.store.answers()] == ["ann"]


def test_a_late_answer_is_kept(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query()])
    with serving(store, lease_seconds=60) as service:
        ann, ben = log_in(service, "ann"), log_in(service, "ben")
        late = ask_for(ann)[0]
        service.clock.now += 61  # type: ignore[attr-defined]
        ben.post("/api/answers", json=answering(ask_for(ben)[0]["assignment_id"]))
        assert ask_for(ann) == []
        assert ann.post("/api/answers", json=answering(late["assignment_id"])).json()["duplicate"] is False
        assert {one.labeler for one in store.answers()} == {"ann", "ben"}


def test_a_sign_of_life_keeps_a_question(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query()])
    with serving(store, lease_seconds=60) as service:
        ann, ben = log_in(service, "ann"), log_in(service, "ben")
        card = ask_for(ann)[0]
        for _ in range(3):
            service.clock.now += 50  # type: ignore[attr-defined]
            assert ann.post("/api/heartbeat", json={"assignments": [card["assignment_id"]]}).status_code == 204
        assert ask_for(ben) == []


# --- taking back ---------------------------------------------------------------------------------------------------


def undo(client: TestClient, assignment: str) -> Any:
    return client.post("/api/undo", json={"submission_id": secrets.token_hex(16), "assignment_id": assignment})


@pytest.mark.parametrize("outcome", ["first", "tie", "skip", "incomparable"])
def test_an_answer_can_be_taken_back_and_given_anew(service: Service, ann: TestClient, outcome: str) -> None:
    card = ask_for(ann)[0]
    ann.post("/api/answers", json=answering(card["assignment_id"], outcome, comment="oops"))
    taken = undo(ann, card["assignment_id"]).json()
    assert taken["assignment"] == card
    assert (taken["answer"]["outcome"], taken["answer"]["comment"]) == (outcome, "oops")
    assert undo(ann, card["assignment_id"]).json() == taken
    assert service.store.answers() == []
    assert ask_for(ann)[0] == card
    assert ann.post("/api/answers", json=answering(card["assignment_id"], "second")).json()["duplicate"] is False
    assert len(service.store.answers()) == 1
    assert [one["kind"] for one in service.store.log.since(0) if one["subject"] == card["query_id"]].count(
        "retract"
    ) == 1


def test_history_shows_the_last_answers_and_no_more_can_be_taken_back(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query() for _ in range(55)])
    with serving(store) as service:
        ann = log_in(service, "ann")
        done = []
        while cards := ask_for(ann, 4):
            for card in cards:
                ann.post("/api/answers", json=answering(card["assignment_id"], "tie"))
                done.append(card)
        entries = ann.get("/api/history").json()["entries"]
        assert [one["assignment"] for one in entries] == done[:4:-1]
        assert {one["answer"]["outcome"] for one in entries} == {"tie"}
        assert undo(ann, done[0]["assignment_id"]).status_code == 409
        assert undo(ann, done[5]["assignment_id"]).status_code == 200
        assert len(ann.get("/api/history").json()["entries"]) == 50


def test_what_was_not_answered_cannot_be_taken_back(ann: TestClient) -> None:
    assert undo(ann, ask_for(ann)[0]["assignment_id"]).status_code == 409
    assert undo(ann, "0" * 32).status_code == 404


def test_a_repeat_looks_like_any_question_trains_nothing_and_can_be_taken_back(
    store: Store[Segment], make_query: Ask
) -> None:
    store.ask([make_query() for _ in range(40)])
    with serving(store, repeat_share=0.45) as service:
        ann, asked = log_in(service, "ann"), list[str]()
        while True:
            card = ask_for(ann)[0]
            asked.append(card["query_id"])
            ann.post("/api/answers", json=answering(card["assignment_id"], "first"))
            if len(set(asked)) < len(asked):
                break
        assert len(store.judged()) == len(set(asked))
        assert ann.get("/api/history").json()["entries"][0]["assignment"] == card
        first = next(one for one in store.answers() if one.query == card["query_id"])
        assert shown(service, card) == first.shown[::-1]
        assert undo(ann, card["assignment_id"]).json()["assignment"] == card
        assert ask_for(ann)[0] == card
        body = answering(card["assignment_id"], "second")
        assert ann.post("/api/answers", json=body).json()["duplicate"] is False
        assert ann.post("/api/answers", json=body).json()["duplicate"] is True
        assert first in store.answers()
        assert len([one for one in store.log.since(0) if one["kind"] == "repeat"]) == 2


# --- the project ---------------------------------------------------------------------------------------------------


def test_overlap_can_be_raised_and_lowered_while_people_label(service: Service, ann: TestClient) -> None:
    boss, ben = log_in(service, "boss", "admin"), log_in(service, "ben")
    while cards := ask_for(ann, 4):
        for card in cards:
            ann.post("/api/answers", json=answering(card["assignment_id"]))
    assert ask_for(ben) == []
    assert boss.post("/api/admin/project", json={"overlap": 2}).status_code == 204
    assert ann.get("/api/state").json()["progress"] == {"mine": 5, "answered": 0, "asked": 5, "waiting": 0}
    cards = ask_for(ben, 4)
    assert len(cards) == 4
    ben.post("/api/answers", json=answering(cards[0]["assignment_id"]))
    assert boss.post("/api/admin/project", json={"overlap": 1}).status_code == 204
    assert ask_for(ben, 4) == []
    assert ann.get("/api/state").json()["progress"]["answered"] == 5
    assert ask_for(ann) == []


def test_a_new_guideline_is_a_new_version_and_answers_say_which(service: Service, ann: TestClient) -> None:
    boss = log_in(service, "boss", "admin")
    old = ask_for(ann)[0]
    made = boss.post("/api/admin/guideline", json={"text": "Look at the feet.\n"}).json()
    assert len(made["version"]) == 12
    assert ann.get("/api/guideline").json() == made
    assert ann.get("/api/state").json()["guideline"] == made["version"]
    assert [card["guideline"] for card in ask_for(ann, 2)] == [old["guideline"], made["version"]]
    ann.post("/api/answers", json=answering(old["assignment_id"], guideline=made["version"]))
    ann.post("/api/answers", json=answering(ask_for(ann)[0]["assignment_id"]))
    answers = [event["body"]["about"] for event in service.store.events() if event["kind"] == "comparison"]
    assert [about["guideline"] for about in answers] == [made["version"]] * 2, "as the page says, else as it was given"
    stale = answering(ask_for(ann)[0]["assignment_id"], guideline="not a version")
    assert ann.post("/api/answers", json=stale).status_code == 422


def test_a_problem_can_be_reported_once(service: Service, ann: TestClient) -> None:
    card = ask_for(ann)[0]
    body = {"submission_id": secrets.token_hex(16), "assignment_id": card["assignment_id"], "text": "black clip"}
    first, again = (ann.post("/api/flags", json=body).json() for _ in range(2))
    assert again == {"seq": first["seq"], "duplicate": True}
    assert ann.post("/api/flags", json=body | {"text": "x"}).status_code == 409
    boss = log_in(service, "boss", "admin")
    [flag] = boss.get("/api/admin/overview").json()["flags"]
    assert (flag["actor"], flag["query"], flag["text"]) == ("ann", card["query_id"], "black clip")


def test_the_state_is_sent_only_when_it_has_changed(ann: TestClient) -> None:
    first = ann.get("/api/state?since=0")
    same = ann.get("/api/state", headers={"if-none-match": first.headers["etag"]})
    assert same.status_code == 304
    assert not same.content
    ann.post("/api/answers", json=answering(ask_for(ann)[0]["assignment_id"]))
    changed = ann.get("/api/state", headers={"if-none-match": first.headers["etag"]})
    assert changed.json()["progress"] == {"mine": 1, "answered": 1, "asked": 5, "waiting": 4}
    assert changed.json()["seq"] > first.json()["seq"]


def test_a_full_disk_is_told_and_labelling_goes_on_when_there_is_room(
    service: Service, ann: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = answering(ask_for(ann)[0]["assignment_id"])

    def full() -> Any:
        service.store.log.full = True
        raise StoreFull("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(service.store.log, "transaction", full)
        answer = ann.post("/api/answers", json=body)
        assert (answer.status_code, answer.json()) == (507, {"error": "the disk is full"})
        assert ann.post("/api/assignments", json={"want": 1}).json()["reason"] == "read-only"
        assert ann.get("/api/state").json()["read_only"]
        assert ann.get("/healthz").status_code == 503
    assert ann.post("/api/answers", json=body).json()["duplicate"] is False
    assert not ann.get("/api/state").json()["read_only"]
    assert ann.get("/healthz").status_code == 200


def test_a_transaction_that_fails_gives_its_questions_back(
    service: Service, ann: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> Any:
        raise RuntimeError

    with monkeypatch.context() as patch:
        patch.setattr(service.store.log, "transaction", broken)
        assert ann.post("/api/assignments", json={"want": 4}).status_code == 503
    cards = ask_for(ann, 4)
    for card in cards:
        assert ann.post("/api/answers", json=answering(card["assignment_id"])).status_code == 200
    assert len({card["query_id"] for card in cards}) == 4


def test_a_trainer_reads_answers_as_they_come_and_never_checks(
    service: Service, ann: TestClient, make_query: Ask
) -> None:
    check = make_query()
    service.store.ask([check], purpose="check", expected=[0])
    service.store.answer([Comparison(check.id, 1.0, "ann")])
    client = browser(service)
    client.headers["authorization"] = f"Bearer {invite(service, 'run', 'trainer')}"
    card = ask_for(ann)[0]
    ann.post("/api/answers", json=answering(card["assignment_id"]))
    [label] = client.get("/api/labels?after_seq=0&limit=10").json()["labels"]
    assert (label["kind"], label["subject"], label["actor"]) == ("comparison", card["query_id"], "ann")
    undo(ann, card["assignment_id"])
    [taken] = client.get(f"/api/labels?after_seq={label['seq']}").json()["labels"]
    assert taken["kind"] == "retract"
    assert client.get("/api/labels?limit=0").status_code == 422


def test_an_admin_sees_the_project_and_takes_it_along(service: Service, ann: TestClient) -> None:
    boss = log_in(service, "boss", "admin")
    ann.post("/api/answers", json=answering(ask_for(ann)[0]["assignment_id"]))
    found = boss.get("/api/admin/overview").json()
    assert (found["asked"], found["answered"], found["open"], found["overlap"]) == (5, 1, 4, 1)
    assert {one["name"] for one in found["annotators"]} == {"ann", "boss"}
    assert found["health"]["store"] == "ok"
    for name in found["exports"]:
        taken = boss.get(f"/api/admin/export/{name}")
        assert taken.status_code == 200, name
        assert taken.headers["content-disposition"].startswith(f'attachment; filename="{name}')
        assert (taken.content[:2] == b"PK") == (name in ("bundle", "minari"))
        about = json.loads(taken.headers["prefrl-about"])
        assert about["file"] in taken.headers["content-disposition"]
        assert (about["written"], set(about)) == (1, {"file", "written", "left_out", "notes"})
    assert boss.get("/api/admin/export/nothing").status_code == 404


# --- the page ------------------------------------------------------------------------------------------------------


def test_every_address_of_the_page_is_the_same_page_and_its_files_are_there(service: Service) -> None:
    client = browser(service)
    pages = {client.get(path).text for path in ("/", "/label", "/history", "/guide", "/admin")}
    assert len(pages) == 1
    file = client.get("/static/app.js")
    assert file.headers["content-type"].startswith("text/javascript")
    assert client.get("/static/app.js", headers={"if-none-match": file.headers["etag"]}).status_code == 304


def test_the_interface_describes_itself_but_not_to_everybody(service: Service) -> None:
    told = routes(service).openapi()
    assert "409" in told["paths"]["/api/answers"]["post"]["responses"]
    assert len(told["paths"]) > 20
    for path in ("/docs", "/redoc", "/openapi.json"):
        assert browser(service).get(path).status_code == 404
