"""A text that people agree to before their first question."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from stores import responses
from web_service import STRENGTHS, answering, ask_for, browser, log_in, page

from prefrl.page.people import cookie_name
from prefrl.page.questions import Policy, Terms
from prefrl.page.service import Service
from prefrl.page.texts import version_of
from prefrl.store import Store

TERMS = Terms(page("text"), Policy(), STRENGTHS, rate=1e6)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store[Any]]:
    with Store[Any](tmp_path / "store") as opened:
        opened.ask(responses(4))
        yield opened


@contextmanager
def serving(store: Store[Any], consent: str) -> Iterator[Service]:
    service = Service(store, replace(TERMS, consent=consent))
    service.open()
    yield service
    service.close()


def back(service: Service, cookie: str) -> TestClient:
    """Somebody's browser after a restart."""
    client = browser(service)
    client.cookies.set(cookie_name(service), cookie)
    return client


def agree(client: TestClient, text: str) -> int:
    return client.post("/api/consent", json={"version": version_of(text)}).status_code


def test_nobody_is_given_a_question_before_they_have_agreed(store: Store[Any]) -> None:
    with serving(store, "It is *kept*.") as service:
        ann, ben = log_in(service, "ann"), log_in(service, "ben")
        told = ann.get("/api/consent").json()
        assert told == {"version": version_of("It is *kept*."), "text": "It is *kept*."}
        assert ann.get("/api/me").json()["consent"] == told["version"]
        refused = ann.post("/api/assignments", json={"want": 1}).json()
        assert refused == {"assignments": [], "reason": "consent"}
        assert agree(ann, "another text") == 409
        assert agree(ann, "") == 409
        assert agree(ann, "It is *kept*.") == 204
        assert ann.get("/api/state").json()["consent"] == ""
        assert ann.post("/api/answers", json=answering(ask_for(ann)[0]["assignment_id"])).status_code == 200
        assert ask_for(ben) == []


def test_who_agreed_to_what_and_when_is_in_the_log_and_holds_after_a_restart(store: Store[Any]) -> None:
    with serving(store, "one") as service:
        ann = log_in(service, "ann")
        cookie = ann.cookies[cookie_name(service)]
        agree(ann, "one")
    said = [one for one in store.log.since(0) if one["kind"] == "project"]
    assert [one["body"] for one in said] == [{"consent": "one"}, {"consent:ann": version_of("one")}]
    assert said[1]["actor"] == "ann"
    assert said[1]["at"] >= said[0]["at"]
    with serving(store, "one") as service:
        assert len(ask_for(back(service, cookie))) == 1
    with serving(store, "two") as service:
        ann = back(service, cookie)
        assert ask_for(ann) == []
        agree(ann, "two")
        assert len(ask_for(ann)) == 1
    with serving(store, "") as service:
        assert len(ask_for(log_in(service, "ben"))) == 1
        assert agree(back(service, cookie), "") == 409
    texts = [one["body"]["consent"] for one in store.log.since(0) if "consent" in one["body"]]
    assert texts == ["one", "two", ""]


def test_nobody_is_asked_to_agree_to_nothing(store: Store[Any]) -> None:
    with serving(store, "") as service:
        ann = log_in(service, "ann")
        assert ann.get("/api/me").json()["consent"] == ""
        assert len(ask_for(ann)) == 1
    assert not [one for one in store.log.since(0) if one["kind"] == "project"]
