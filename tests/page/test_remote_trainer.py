"""A trainer in another process: it asks about texts, and reads what was asked and answered."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from stores import responses
from web_service import answering, ask_for, browser, invite, log_in, serving

from prefrl.judgements import Comparison
from prefrl.page.security import BODY, LARGER
from prefrl.page.service import Service
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

PAIR = {"prompt": "Say hello", "responses": ["hello", "go away"]}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with Store[Any](tmp_path / "texts") as store, serving(store, "text") as opened:
        yield opened


def trainer(service: Service) -> TestClient:
    client = browser(service)
    del client.headers["origin"]  # a program is no browser
    client.headers["authorization"] = f"Bearer {invite(service, 'run', 'trainer')}"
    return client


def asked(client: TestClient, **how: int) -> list[dict[str, Any]]:
    found = client.get("/api/queries", params=how)
    assert found.status_code == 200, found.text
    queries: list[dict[str, Any]] = found.json()["queries"]
    return queries


def test_what_a_trainer_asks_is_given_out_and_read_back_with_its_answer(service: Service) -> None:
    run, ann = trainer(service), log_in(service, "ann")
    triple = {"prompt": "Count", "responses": ["1 2", "1 2 3", "one"]}
    sent = run.put("/api/queries", json={"queries": [PAIR, triple]})
    assert sent.status_code == 200, sent.text
    pair = Query(tuple(Response("Say hello", text) for text in PAIR["responses"]))
    assert sent.json()["ids"][0] == pair.id
    told = {one["id"]: one for one in asked(run)}
    assert list(told) == sent.json()["ids"]
    assert told[pair.id]["candidates"] == [
        {"id": one.id, "prompt": "Say hello", "text": one.text} for one in pair.candidates
    ]
    card = next(one for one in ask_for(ann, 4) if one["query_id"] == pair.id)
    better = "first" if card["items"][0]["text"] == "hello" else "second"
    ann.post("/api/answers", json=answering(card["assignment_id"], better))
    [label] = run.get("/api/labels").json()["labels"]
    texts = [one["text"] for one in told[label["subject"]]["candidates"]]
    assert texts[label["body"]["preference"] == 0.0] == "hello"


def test_asking_again_is_asking_once(service: Service) -> None:
    run = trainer(service)
    turned = PAIR | {"responses": PAIR["responses"][::-1]}
    ids = [run.put("/api/queries", json={"queries": some}).json()["ids"] for some in ([PAIR, turned, PAIR], [turned])]
    assert {one for some in ids for one in some} == {asked(run)[0]["id"]}
    assert service.store.counts()["asked"] == service.desk.counts().asked == 1


def test_queries_come_in_the_order_of_asking_from_a_number_on_and_checks_not_at_all(service: Service) -> None:
    queries = responses(5)
    service.store.ask(queries[:4])
    service.store.ask(queries[4:], purpose="check", expected=[0])
    run = trainer(service)
    found = asked(run)
    assert [one["id"] for one in found] == [one.id for one in queries[:4]]
    assert asked(run, after_seq=found[1]["seq"], limit=1) == found[2:3]
    assert asked(run, after_seq=found[-1]["seq"]) == []


def test_texts_come_out_as_they_went_in(service: Service) -> None:
    query = Query((Response("p", "cut emoji \ud83d"), Response("p", "\u2028 \u0000")))
    service.store.ask([query])
    [found] = asked(trainer(service))
    assert [one["text"] for one in found["candidates"]] == [one.text for one in query.candidates]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"queries": []}, 422),
        ({"queries": [{"prompt": "p", "responses": ["a"]}]}, 422),
        ({"queries": [{"prompt": "p", "responses": ["a", "a"]}]}, 422),
        ({"queries": [{"prompt": "p", "responses": list("abcdefghi")}]}, 422),
        ({"queries": [PAIR | {"gold": [1, 0]}]}, 422),
        ({"queries": [{"prompt": 1, "responses": ["a", "b"]}]}, 422),
        ({"queries": [{"prompt": "x" * LARGER["PUT", "/api/queries"], "responses": ["a", "b"]}]}, 413),
    ],
)
def test_what_is_no_query_is_refused(service: Service, body: dict[str, Any], status: int) -> None:
    answer = trainer(service).put("/api/queries", json=body)
    assert answer.status_code == status
    assert service.store.counts()["asked"] == 0


def test_only_these_requests_may_be_larger(service: Service) -> None:
    long = {"prompt": "x" * BODY, "responses": ["a", "b"]}
    assert trainer(service).put("/api/queries", json={"queries": [long]}).status_code == 200
    sent = json.dumps({"queries": [long]}).encode()
    posted = log_in(service, "ann").post("/api/flags", content=sent, headers={"content-type": "application/json"})
    assert posted.status_code == 413


def test_nobody_else_may_ask_or_read(service: Service) -> None:
    body = {"queries": [PAIR]}
    for client in (browser(service), log_in(service, "ann"), log_in(service, "boss", "admin")):
        assert client.put("/api/queries", json=body).status_code == 401
        assert client.get("/api/queries").status_code == 401
    person = browser(service)
    person.headers["authorization"] = f"Bearer {invite(service, 'ann')}"
    assert person.put("/api/queries", json=body).status_code == 403
    assert service.store.counts()["asked"] == 0


def test_clips_are_asked_about_by_their_own_run(
    store: Store[Segment], make_query: Callable[..., Query[Segment]]
) -> None:
    query = make_query()
    store.ask([query])
    store.answer([Comparison(query.id, 1.0, "oracle")])
    with serving(store) as service:
        run = trainer(service)
        refused = run.put("/api/queries", json={"queries": [PAIR]})
        assert refused.status_code == 409
        assert "its own run" in refused.json()["error"]
        [found] = asked(run)
        assert found["candidates"] == [{"id": one.id, "prompt": None, "text": None} for one in query.candidates]
