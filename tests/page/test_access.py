"""Links, sessions and roles: nobody comes in who was not asked in, and who was sent away stays out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from web_service import browser, invite, log_in, serving

from prefrl.page.access import Access, check_name, digest
from prefrl.page.people import cookie_name
from prefrl.page.service import Service
from prefrl.store import Store
from prefrl.types import Segment


@pytest.fixture
def service(store: Store[Segment]) -> Iterator[Service]:
    with serving(store) as opened:
        yield opened


def test_a_link_can_be_exchanged_for_a_session_and_a_session_cannot(service: Service) -> None:
    client = log_in(service, "ann")
    assert client.get("/api/me").json()["name"] == "ann"
    stolen = client.cookies[cookie_name(service)]
    assert browser(service).post("/api/session", json={"token": stolen}).status_code == 401


def test_a_link_does_not_do_for_a_session(service: Service) -> None:
    client = browser(service)
    client.cookies.set(cookie_name(service), invite(service, "ann"))
    assert client.get("/api/me").status_code == 401


@pytest.mark.parametrize("token", ["x", "A" * 43, "\u00e4", "' OR 1=1 --"])
def test_a_guessed_token_lets_nobody_in(service: Service, token: str) -> None:
    invite(service, "ann")
    assert browser(service).post("/api/session", json={"token": token}).status_code == 401


def test_the_session_cookie_is_out_of_reach_of_scripts_and_other_sites(service: Service) -> None:
    answer = browser(service).post("/api/session", json={"token": invite(service, "ann")})
    told = answer.headers["set-cookie"].lower()
    assert "httponly" in told
    assert "samesite=strict" in told
    assert "domain" not in told


def test_logging_out_ends_this_session_and_no_other(service: Service) -> None:
    one, other = log_in(service, "ann"), log_in(service, "ann")
    cookie = one.cookies[cookie_name(service)]
    assert one.delete("/api/session").status_code == 204
    one.cookies.set(cookie_name(service), cookie)
    assert one.get("/api/me").status_code == 401
    assert other.get("/api/me").status_code == 200


def test_a_session_that_is_noted_after_its_person_was_sent_away_lets_nobody_in() -> None:
    """Somebody logs in while an admin revokes them: the login comes second."""
    access = Access()
    access.note(access.invite("ann")[1])
    token, session = access.session("ann")
    access.note(access.change("ann", "revoked"))
    access.note(session)
    assert access.who(token, "session") is None


def test_people_and_sessions_outlive_a_restart(store: Store[Segment]) -> None:
    with serving(store) as service:
        cookie = log_in(service, "ann").cookies[cookie_name(service)]
    with serving(store) as service:
        client = browser(service)
        client.cookies.set(cookie_name(service), cookie)
        assert client.get("/api/me").json()["name"] == "ann"


def test_a_browser_is_logged_in_to_two_projects_of_one_host(tmp_path: Path) -> None:
    with Store[Any](tmp_path / "one") as one, Store[Any](tmp_path / "other") as other:
        with serving(one, "text") as first, serving(other, "text") as second:
            here, there = log_in(first, "ann"), log_in(second, "ben")
            here.cookies.update(there.cookies)
            there.cookies.update(here.cookies)
            assert len(here.cookies) == 2
            told = [client.get("/api/me").json() for client in (here, there)]
            assert [one["name"] for one in told] == ["ann", "ben"]
            assert told[0]["store"] != told[1]["store"]
            assert here.delete("/api/session").status_code == 204
            assert there.get("/api/me").status_code == 200
            kept = told[1]["store"]
        with serving(other, "text") as again:
            assert log_in(again, "ben").get("/api/me").json()["store"] == kept


def test_only_hashes_of_tokens_are_kept(service: Service, store: Store[Segment]) -> None:
    token = invite(service, "ann")
    client = log_in(service, "ben")
    kept = json.dumps([one | {"hash": ""} for one in store.log.since(0)])
    assert token not in kept
    assert client.cookies[cookie_name(service)] not in kept
    assert digest(token) in kept
    assert all(token.encode() not in path.read_bytes() for path in store.folder.glob("store.db*"))


def test_who_is_revoked_is_out_at_once_and_cannot_be_invited_again(service: Service) -> None:
    boss, ann = log_in(service, "boss", "admin"), log_in(service, "ann")
    link = invite(service, "ann")
    assert boss.post("/api/admin/annotators/ann/revoke").status_code == 200
    assert ann.get("/api/me").status_code == 401
    assert browser(service).post("/api/session", json={"token": link}).status_code == 401
    assert boss.post("/api/admin/annotators/ann/resume").status_code == 409
    assert boss.post("/api/admin/annotators/ann/invite").status_code == 422


def test_who_is_paused_is_given_nothing_but_stays_in(service: Service) -> None:
    boss, ann = log_in(service, "boss", "admin"), log_in(service, "ann")
    boss.post("/api/admin/annotators/ann/pause")
    assert ann.post("/api/assignments", json={"want": 1}).json() == {"assignments": [], "reason": "paused"}
    assert ann.get("/api/state").json()["paused"]
    boss.post("/api/admin/annotators/ann/resume")
    assert ann.post("/api/assignments", json={"want": 1}).json()["reason"] == "waiting"


@pytest.mark.parametrize("role", ["annotator", "trainer"])
def test_what_admins_do_is_for_admins(service: Service, role: str) -> None:
    client = browser(service)
    if role == "annotator":
        client = log_in(service, "ann")
    else:
        client.headers["authorization"] = f"Bearer {invite(service, 'run', 'trainer')}"
    for path, body in (
        ("annotators", {"name": "eve", "role": "admin"}),
        ("annotators/ann/revoke", None),
        ("project", {"overlap": 2}),
        ("guideline", {"text": "x"}),
    ):
        assert client.post(f"/api/admin/{path}", json=body).status_code in (401, 403), path
    for path in ("overview", "export/bundle"):
        assert client.get(f"/api/admin/{path}").status_code in (401, 403), path
    assert service.access.person("eve") is None
    assert service.desk.policy.overlap == 1


def test_an_admin_can_invite_and_cannot_send_himself_away(service: Service) -> None:
    boss = log_in(service, "boss", "admin")
    answer = boss.post("/api/admin/annotators", json={"name": "ann & <b>", "role": "annotator"})
    token = answer.json()["link"].partition("#")[2]
    assert answer.json()["link"].startswith("http://127.0.0.1:8900/#")
    assert browser(service).post("/api/session", json={"token": token}).json()["name"] == "ann & <b>"
    assert boss.post("/api/admin/annotators", json={"name": "ann & <b>", "role": "admin"}).status_code == 409
    assert boss.post("/api/admin/annotators/boss/revoke").status_code == 409
    assert boss.post("/api/admin/annotators/nobody/pause").status_code == 404


def test_a_trainer_reads_labels_and_nothing_else(service: Service) -> None:
    token = invite(service, "run", "trainer")
    client = browser(service)
    assert client.post("/api/session", json={"token": token}).status_code == 403
    client.headers["authorization"] = f"Bearer {token}"
    assert client.get("/api/labels").json() == {"labels": []}
    assert client.get("/api/me").status_code == 401
    assert client.post("/api/assignments", json={"want": 1}).status_code == 401
    client.headers["authorization"] = f"Bearer {invite(service, 'ann')}"
    assert client.get("/api/labels").status_code == 403
    client.headers["authorization"] = "Bearer nonsense"
    assert client.get("/api/labels").status_code == 401


@pytest.mark.parametrize("name", ["", " ann", "a/b", "a\\b", "..", "a\nb", "a\u202eb", "x" * 81, "\ud800"])
def test_names_that_would_fool_somebody_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="printable"):
        check_name(name)


def test_inviting_somebody_known_makes_a_new_link_and_no_new_person() -> None:
    access = Access()
    _, events = access.invite("ann")
    access.note(events)
    token, again = access.invite("ann", "admin")
    access.note(again)
    assert [one["kind"] for one in again] == ["token"]
    found = access.who(token, "invite")
    assert found is not None
    assert found.role == "annotator"
    access.note(access.forget_invites("ann"))
    assert access.who(token, "invite") is None
