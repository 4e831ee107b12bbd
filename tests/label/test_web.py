"""People in a browser as a labeler: settings, links, waiting, and the server itself, over real connections."""

from __future__ import annotations

import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np
import pytest
from starlette.testclient import TestClient

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs.toys import PointSettings
from prefrl.kinds import named
from prefrl.label.web import WebLabeler, WebSettings, terms_of
from prefrl.page import serve
from prefrl.page.site import Address
from prefrl.protocols import Attended
from prefrl.rundir import Run, RunError
from prefrl.stages import label
from prefrl.stages import serve as serve_folder
from prefrl.store import Store
from prefrl.types import Query, Segment

Come = Callable[[str], httpx.Client]
SOON = 40.0
"""Seconds in which everything here must have happened, on a machine that does other things too."""
QUICK: dict[str, Any] = {"port": 0, "clips": {"ahead_seconds": 0}}


def labeler(**settings: Any) -> WebLabeler:
    return WebSettings.model_validate(QUICK | settings).build(PointSettings().build())


@pytest.fixture
def asked(store: Store[Segment], make_query: Callable[..., Query[Segment]]) -> Store[Segment]:
    store.ask([make_query(0.0, float(n)) for n in range(10)])
    return store


@pytest.fixture
def opened(asked: Store[Segment]) -> Iterator[tuple[WebLabeler, str]]:
    """A labeler with its page open, and the link."""
    made = labeler(check_share=0, repeat_share=0)
    yield made, link(made.open(asked))
    made.close()


def link(notes: list[str]) -> str:
    return notes[0].removeprefix("label here: ")


@pytest.fixture
def come() -> Iterator[Callable[[str], httpx.Client]]:
    """Somebody who opens a link."""
    clients = list[httpx.Client]()

    def opens(link: str) -> httpx.Client:
        base, _, token = link.partition("/#")
        clients.append(httpx.Client(base_url=base, headers={"origin": base}, timeout=SOON))
        answer = clients[-1].post("/api/session", json={"token": token})
        assert answer.status_code == 200, answer.text
        return clients[-1]

    yield opens
    for client in clients:
        client.close()


def label_some(client: httpx.Client | TestClient, count: int, outcome: str = "first") -> int:
    """Answer up to `count` questions; returns how many there were."""
    for done in range(count):
        cards = client.post("/api/assignments", json={"want": 1}).json()["assignments"]
        if not cards:
            return done
        ids = {"submission_id": secrets.token_hex(16), "assignment_id": cards[0]["assignment_id"]}
        assert client.post("/api/answers", json={**ids, "outcome": outcome}).status_code == 200
    return count


def answer_in_thread(made: WebLabeler, store: Store[Any]) -> threading.Thread:
    thread = threading.Thread(target=made.answer, args=(store, np.random.default_rng(0)), daemon=True)
    thread.start()
    return thread


# --- settings ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["control/toy", "text/toy"])
def test_without_a_guideline_people_read_one_that_says_what_is_asked_and_how_to_answer(preset: str) -> None:
    config = Config.load(preset, ["labeler.kind=web"])
    task = config.build_task()
    made: Any = config.build_labeler(task)
    terms = terms_of(made.settings, task, fixed=True)
    assert terms.guideline.startswith(f"**{config.goal}**")
    assert all(one in terms.guideline for one in ("Tie", "Can't compare", "Skip", *named(task.kind).hints))
    assert terms_of(WebSettings(guideline=""), task, fixed=True).guideline == ""
    assert terms_of(WebSettings(guideline="Look."), task, fixed=True).guideline == "Look."


def test_the_guideline_that_we_ship_gives_way_to_the_stores_own(asked: Store[Segment]) -> None:
    for settings, text in (({"guideline": "Look."}, "Look."), ({}, "Look."), ({"guideline": ""}, "Look.")):
        assert opened_guideline(asked, **settings) == text


@pytest.mark.parametrize("given", ["Look.", ""])
def test_a_guideline_of_ones_own_takes_the_place_of_the_shipped_one(asked: Store[Segment], given: str) -> None:
    for settings, text in (({}, "**Which clip is better?**"), ({"question": "Calmer?"}, "**Calmer?**")):
        assert opened_guideline(asked, **settings).startswith(text)
    assert opened_guideline(asked, guideline=given) == given


def opened_guideline(store: Store[Segment], **settings: str) -> str:
    made = labeler(**settings)
    assert len(made.open(store)) == 1, "no setting is said to be ignored"
    assert made._site is not None
    text = made._site.service.guideline.text
    made.close()
    return text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("labeler.enough=0", "labeler.enough"),
        ("labeler.name=a/b", "labeler.name"),
        ("labeler.tls_key=x", "tls_cert and tls_key"),
        ("labeler.check_share=0.5", "must leave room"),
        ("labeler.overlapp=2", "overlap"),
    ],
)
def test_impossible_settings_are_refused_by_name(change: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Config.load("control/toy", ["labeler.kind=web", "labeler.repeat_share=0.5", change])


def test_presets_take_it_and_the_settings_come_back_as_they_were() -> None:
    for name in ("control/toy", "text/toy"):
        config = Config.load(name, ["labeler.kind=web", "labeler.tls_cert=a.pem", "labeler.tls_key=b.pem"])
        assert config.labeler.model_dump()["kind"] == "web"
        assert Config.parse(config.model_dump(mode="json")) == config


def test_only_names_that_were_allowed_reach_the_page_and_open_pages_are_warned_about() -> None:
    assert Address().names() == {"127.0.0.1", "localhost", "[::1]"}
    assert Address().warnings() == []
    everywhere = Address("0.0.0.0", allowed_hosts=("Lab.example.org",))
    assert "lab.example.org" in everywhere.names()
    assert "0.0.0.0" not in everywhere.names()
    assert "without TLS" in " ".join(everywhere.warnings())
    assert "allowed_hosts" in " ".join(Address("0.0.0.0").warnings())


# --- the labeler ---------------------------------------------------------------------------------------------------


def test_it_is_attended_and_answers_nothing_while_it_is_closed(asked: Store[Segment]) -> None:
    made = labeler()
    assert isinstance(made, Attended)
    made.answer(asked, np.random.default_rng(0))
    made.close()


def test_a_round_waits_until_enough_is_judged(
    come: Come, asked: Store[Segment], opened: tuple[WebLabeler, str]
) -> None:
    made, address = opened
    waiting, client = answer_in_thread(made, asked), come(address)
    assert label_some(client, 4) == 4
    waiting.join(1.5)
    assert waiting.is_alive()
    label_some(client, 1)
    waiting.join(SOON)
    assert not waiting.is_alive()
    assert len(asked.judged()) == 5


def test_with_continue_only_the_very_first_judgement_is_waited_for(come: Come, asked: Store[Segment]) -> None:
    made = labeler(when_empty="continue", check_share=0)
    client = come(link(made.open(asked)))
    waiting = answer_in_thread(made, asked)
    waiting.join(0.5)
    assert waiting.is_alive()
    label_some(client, 1)
    waiting.join(SOON)
    assert not waiting.is_alive()
    made.answer(asked, np.random.default_rng(0))
    made.close()


def test_what_everybody_skipped_is_not_waited_for(
    come: Come, asked: Store[Segment], opened: tuple[WebLabeler, str]
) -> None:
    made, address = opened
    assert label_some(come(address), 10, "skip") == 10
    made.answer(asked, np.random.default_rng(0))
    assert asked.counts()["skipped"] == 10


def test_check_questions_are_filed_where_gold_tells_them_and_never_train(come: Come, asked: Store[Segment]) -> None:
    made = labeler(check_share=0.5, repeat_share=0, enough=1.0)
    client = come(link(made.open(asked)))
    waiting = answer_in_thread(made, asked)
    answered = 0
    while waiting.is_alive() and answered < 40:
        answered += label_some(client, 1)
        waiting.join(0.1)
    made.close()
    kinds = [one["body"]["purpose"] for one in asked.log.since(0) if one["kind"] == "assign"]
    assert kinds.count("label") == 10
    assert kinds.count("check") >= 1
    assert len(asked.judged()) == 10


def test_a_new_start_makes_a_new_link_and_browsers_stay_logged_in(come: Come, asked: Store[Segment]) -> None:
    made = labeler()
    first = link(made.open(asked))
    client = come(first)
    made.close()
    second = link(made.open(asked))
    client.base_url = httpx.URL(second.partition("/#")[0])
    assert client.get("/api/me").json()["role"] == "admin"
    with pytest.raises(AssertionError):
        come(second.partition("#")[0] + "#" + first.partition("#")[2])
    made.close()


def test_a_port_that_is_taken_is_named_and_nothing_is_left_open(asked: Store[Segment]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        made = WebSettings(port=port).build(PointSettings().build())
        with pytest.raises(ConfigError, match=rf"labeler.port={port}.*choose another"):
            made.open(asked)
    made.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("prefrl-")]


def test_a_run_goes_on_at_another_address_and_with_no_other_setting(tmp_path: Path) -> None:
    web = ("labeler.kind=web", "labeler.port=0")
    with Run(Config.load("control/toy", web), tmp_path / "run") as run:
        assert run.store.sequence > 0
    words = ("labeler.guideline=Look twice.", "labeler.markdown=false")
    elsewhere = Config.load("control/toy", (*web, *words, "labeler.allowed_hosts=[lab.example.org]"))
    Run(elsewhere, tmp_path / "run").close()
    with Run.resume(tmp_path / "run") as run:
        assert run.config == elsewhere
    with pytest.raises(RunError, match=r"labeler\.enough"):
        Run(Config.load("control/toy", (*web, "labeler.enough=0.9")), tmp_path / "run")


def test_closing_does_not_wait_for_open_connections(
    come: Come, asked: Store[Segment], opened: tuple[WebLabeler, str]
) -> None:
    made, address = opened
    client = come(address)
    client.get("/healthz")
    made.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("prefrl-")], "it waits for the connection"
    with pytest.raises(httpx.HTTPError):
        client.get("/healthz")


# --- runs and single stages ----------------------------------------------------------------------------------------


def test_a_run_goes_on_while_somebody_labels(come: Come, tmp_path: Path) -> None:
    small = ["loop.labels=6", "loop.rounds=2", "learner.steps_per_round=400", "fitting.epochs=2"]
    small += ["labeler.kind=web", "labeler.port=0", "labeler.check_share=0"]
    with Run(Config.load("control/toy", small), tmp_path / "run") as run:
        client, rounds = come(link([n for n in run.notes if n.startswith("label here")])), list[int]()
        thread = threading.Thread(target=lambda: rounds.extend(r.number for r in run), daemon=True)
        thread.start()
        while thread.is_alive():
            label_some(client, 3)
            thread.join(0.1)
        assert rounds == [0, 1, 2]
        assert run.loop.reward.fitted
        clip = client.get("/api/history").json()["entries"][0]["assignment"]["items"][0]["media"][0]
        assert client.get(clip, headers={"range": "bytes=0-3"}).status_code == 206


def test_a_pool_is_served_until_all_of_it_is_answered(come: Come, tmp_path: Path) -> None:
    folder, told = tmp_path / "labels", list[str]()
    label(Config.load("control/toy", ["labeler.kind=oracle", "labeler.skip_below=1000", "loop.labels=4"]), folder)
    overrides = ["labeler.port=0", "labeler.check_share=0", "labeler.repeat_share=0"]
    counts: list[dict[str, int]] = []
    thread = threading.Thread(target=lambda: counts.append(serve_folder(folder, overrides, told.append)), daemon=True)
    thread.start()
    while not told:
        thread.join(0.1)
    client = come(link(told))
    assert label_some(client, 9) == 4
    assert client.post("/api/assignments", json={"want": 1}).json()["reason"] == "done"
    thread.join(SOON)
    assert counts[0]["answered"] == 4


# --- the server itself ---------------------------------------------------------------------------------------------


def test_silent_and_slow_clients_are_shown_out_and_others_are_served(
    come: Come, opened: tuple[WebLabeler, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serve, "CONNECTIONS", 20)
    monkeypatch.setattr(serve, "SILENT_SECONDS", 1.0)
    client = come(opened[1])
    port = client.base_url.port
    silent = [socket.create_connection(("127.0.0.1", port), timeout=SOON) for _ in range(60)]
    for one in silent[:30]:
        one.sendall(b"GET / HTTP/1.1\r\nHost: 127.0")
    assert come(opened[1]).get("/api/me").status_code == 200
    for one in silent:
        with one, suppress(ConnectionResetError):
            assert one.recv(1) in (b"", b"H")
    assert client.get("/api/me").status_code == 200


def test_a_huge_body_and_a_malformed_head_leave_the_server_at_work(come: Come, opened: tuple[WebLabeler, str]) -> None:
    client = come(opened[1])

    def chunks() -> Iterator[bytes]:
        for _ in range(5000):
            yield b"x" * 65_536

    headers = {"content-type": "application/json"}
    with suppress(httpx.HTTPError):  # the server may hang up while we still send
        assert client.post("/api/answers", content=chunks(), headers=headers).status_code == 413
    with socket.create_connection(("127.0.0.1", client.base_url.port or 0), timeout=SOON) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 100_000)
        assert raw.recv(12) == b"HTTP/1.1 400"
    assert client.get("/api/me").status_code == 200
