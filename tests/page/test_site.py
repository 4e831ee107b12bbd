"""The page of a pool or a round: what is waited for, and for how long; what is said when it opens."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from stores import responses
from web_service import answering, ask_for, log_in

from prefrl.components import ConfigError
from prefrl.envs.toys import PointSettings
from prefrl.kinds import SEGMENTS
from prefrl.label import web
from prefrl.label.web import WebLabeler, WebSettings
from prefrl.page import site
from prefrl.page.service import Service
from prefrl.store import Store
from prefrl.types import Query, Segment

SOON = 40.0
"""Seconds in which everything here must have happened, on a machine that does other things too."""
LEASE = 0.2


class Waiting:
    """A labeler that waits in a thread for the answers of people, who are here."""

    def __init__(self, store: Store[Any], fixed: bool, **settings: Any) -> None:
        chosen = {"port": 0, "check_share": 0, "repeat_share": 0} | settings
        task: Any = SimpleNamespace(kind="text", name="short stories")
        self.labeler = WebLabeler(WebSettings.model_validate(chosen), task)
        self.notes = self.labeler.open(store, fixed)
        self._thread = threading.Thread(target=self.labeler.answer, args=(store, np.random.default_rng(0)), daemon=True)
        self._thread.start()

    @property
    def service(self) -> Service:
        assert self.labeler._site is not None
        return self.labeler._site.service

    def come(self, name: str = "me") -> TestClient:
        return log_in(self.service, name)

    def goes_on(self) -> bool:
        """Whether answers are still waited for, after a while."""
        self._thread.join(1.5)
        return self._thread.is_alive()

    def ends(self) -> bool:
        self._thread.join(SOON)
        return not self._thread.is_alive()


Wait = Callable[..., Waiting]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store[Any]]:
    with Store[Any](tmp_path / "store") as opened:
        yield opened


@pytest.fixture
def wait(store: Store[Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[Wait]:
    """`wait(count, fixed, **settings)`: ask so many questions, and wait for answers."""
    monkeypatch.setattr(site, "GOODBYE_SECONDS", 0.5)
    made: list[Waiting] = []

    def begin(count: int, fixed: bool = True, **settings: Any) -> Waiting:
        store.ask(responses(count))
        made.append(Waiting(store, fixed, **settings))
        return made[-1]

    yield begin
    for one in made:
        one.labeler.close()


def answer(client: TestClient, count: int, outcome: str = "first") -> list[str]:
    """Answer so many questions, or all that there are; the assignments."""
    done: list[str] = []
    while len(done) < count and (cards := ask_for(client)):
        assert client.post("/api/answers", json=answering(cards[0]["assignment_id"], outcome)).status_code == 200
        done.append(cards[0]["assignment_id"])
    return done


# --- what is waited for --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fixed", [True, False], ids=["pool", "round"])
def test_questions_that_were_given_and_left_are_waited_for_and_come_again(
    wait: Wait, store: Store[Any], fixed: bool
) -> None:
    waiting = wait(5, fixed, enough=1.0, lease_seconds=LEASE)
    me = waiting.come()
    left = ask_for(me, 6)
    assert len(left) == 5
    time.sleep(2 * LEASE)
    assert me.get("/api/state").status_code == 200  # as a page does, hidden or not
    assert waiting.goes_on()
    assert ask_for(me, 6) == left
    time.sleep(2 * LEASE)
    assert len(answer(waiting.come("ann"), 9)) == 5
    assert waiting.ends()
    assert store.counts()["answered"] == 5


@pytest.mark.parametrize("fixed", [True, False], ids=["pool", "round"])
def test_while_everybody_is_paused_all_is_waited_for(
    wait: Wait, fixed: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    waiting = wait(2, fixed, enough=1.0)
    me = waiting.come()
    answer(me, 1, "skip")
    assert me.post("/api/admin/annotators/me/pause").status_code == 200
    assert waiting.goes_on()
    assert waiting.labeler._site is not None
    waiting.labeler._tell(waiting.labeler._site, 2)
    assert "nobody can answer just now" in capsys.readouterr().out
    assert me.post("/api/admin/annotators/me/resume").status_code == 200
    answer(me, 1)
    assert waiting.ends()


def test_a_pool_that_needs_more_people_waits_until_they_are_invited(
    wait: Wait, store: Store[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    waiting = wait(3, overlap=2, lease_seconds=LEASE)
    assert len(answer(waiting.come(), 9)) == 3
    assert waiting.goes_on()
    assert waiting.labeler._site is not None
    waiting.labeler._tell(waiting.labeler._site, 3)
    assert "3 more questions" in (told := capsys.readouterr().out)
    assert "each needs 2 different people: invite more on the page" in told
    ann = waiting.come("ann")
    answer(ann, 1, "skip")
    answer(ann, 9)
    assert waiting.goes_on(), "one question was judged, and skipped by the other: it needs a third"
    answer(waiting.come("ben"), 9)
    assert waiting.ends()
    assert store.counts() == {"asked": 3, "answered": 6, "skipped": 1}


def test_a_pool_ends_when_everybody_has_skipped_what_is_left(wait: Wait, store: Store[Any]) -> None:
    waiting = wait(3)
    me, ann = waiting.come(), waiting.come("ann")
    answer(me, 2, "skip")
    answer(me, 1)
    assert waiting.goes_on()
    answer(ann, 9, "skip")
    assert waiting.ends()
    assert store.counts() == {"asked": 3, "answered": 1, "skipped": 4}


@pytest.mark.parametrize(("mode", "skips", "needed"), [("wait", 5, 3), ("continue", 1, 1)])
def test_skips_are_no_judgements(wait: Wait, mode: str, skips: int, needed: int) -> None:
    waiting = wait(10, False, when_empty=mode, enough=0.5)
    me = waiting.come()
    answer(me, skips, "skip")
    answer(me, needed - 1)
    assert waiting.goes_on()
    answer(me, 1)
    assert waiting.ends()


def test_an_answer_taken_back_while_goodbye_is_said_is_waited_for_again(
    wait: Wait, store: Store[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    goodbye, taken_back = threading.Event(), threading.Event()

    def sleep(seconds: float) -> None:
        if seconds == site.GOODBYE_SECONDS:
            goodbye.set()
            taken_back.wait(SOON)
        else:
            time.sleep(seconds)

    waiting = wait(3)
    monkeypatch.setattr(site, "time", SimpleNamespace(sleep=sleep, thread_time=time.thread_time))
    me = waiting.come()
    last = answer(me, 9)[-1]
    assert goodbye.wait(SOON)
    assert waiting.service.finished
    undo = {"submission_id": secrets.token_hex(16), "assignment_id": last}
    assert me.post("/api/undo", json=undo).status_code == 200
    taken_back.set()
    assert waiting.goes_on()
    assert ask_for(me)[0]["assignment_id"] == last
    answer(me, 9, "second")
    assert waiting.ends()
    assert store.counts()["answered"] == 3


def test_a_pool_that_stays_open_takes_more_questions(wait: Wait, store: Store[Any]) -> None:
    waiting = wait(1, stay_open=True)
    me = waiting.come()
    answer(me, 9)
    assert me.post("/api/assignments", json={"want": 1}).json()["reason"] == "waiting"
    assert waiting.goes_on()
    store.ask(responses(3))
    waiting.service.refresh()
    assert len(answer(me, 9)) == 2
    assert not waiting.service.finished


# --- check questions -----------------------------------------------------------------------------------------------


def make(number: int) -> Query[Segment]:
    rng = np.random.default_rng(number)

    def segment(part: int) -> Segment:
        steps = rng.normal(size=(5, 2)).astype(np.float32)
        return Segment(steps, steps, f"e{number}-{part}", 0, gold=rng.normal(size=5))

    return Query((segment(0), segment(1)))


@pytest.mark.parametrize(("share", "loaded"), [(0.0, 0), (0.05, 2 * 20)])
def test_only_a_part_of_the_segments_is_loaded_to_choose_checks(
    store: Store[Any], share: float, loaded: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "named", lambda _: replace(SEGMENTS, looked_at=20))
    store.ask([make(number) for number in range(60)])
    labeler = WebSettings(port=0, check_share=share).build(PointSettings().build())
    labeler.open(store)
    assert labeler._site is not None
    labeler._file_checks(labeler._site, store, np.random.default_rng(0))
    assert len(store._loaded) == loaded
    assert len(labeler._site.open_queries()) == 60
    labeler._site.service.refresh()
    assert len(labeler._site.service.desk._checks) == (3 if share else 0)
    labeler.close()


# --- opening -------------------------------------------------------------------------------------------------------


def open_and_close(store: Store[Any], **settings: Any) -> list[str]:
    labeler = WebSettings.model_validate({"port": 0} | settings).build(PointSettings().build())
    try:
        return labeler.open(store)
    finally:
        labeler.close()


def test_settings_that_the_store_overrules_are_named(store: Store[Any], wait: Wait) -> None:
    waiting = wait(1, overlap=2, guideline="first")
    waiting.come().post("/api/admin/project", json={"overlap": 3})
    waiting.labeler.close()
    notes = open_and_close(store, overlap=1, guideline="second")[1:]
    assert len(notes) == 2
    assert notes[0].startswith("labeler.overlap=1 is not used: an admin has set 3")
    assert notes[1].startswith("labeler.guideline is not used: the store has one already")
    assert open_and_close(store, overlap=3, guideline="first")[1:] == []


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            {"tls_cert": "no-such.pem", "tls_key": "no-such.key"},
            r"labeler\.tls_cert=no-such\.pem: cannot be read \(No such",
        ),
        ({"tls_cert": __file__, "tls_key": "no-such.key"}, r"labeler\.tls_key=no-such\.key: cannot be read"),
        ({"tls_cert": __file__, "tls_key": __file__}, r"labeler\.tls_cert and labeler\.tls_key hold no certificate"),
        ({"host": "no.such.host.invalid"}, r"labeler\.host=no\.such\.host\.invalid: there is no such host"),
        ({"host": "192.0.2.1"}, r"labeler\.host=192\.0\.2\.1: that is no address of this machine"),
    ],
)
def test_what_the_page_cannot_be_opened_with_is_named(store: Store[Any], settings: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        open_and_close(store, **settings)
    assert not [t for t in threading.enumerate() if t.name.startswith("prefrl-")]
