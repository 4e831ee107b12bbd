from __future__ import annotations

import base64
import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError
from small_pictures import small_digits

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.digits import Digits, real_digits
from prefrl.judgements import Comparison, Ranking, Skip
from prefrl.label.vision_judge import VisionJudge, VisionJudgeSettings, read_reply
from prefrl.store import Store
from prefrl.types import Picture, Query

PIXELS, _ = real_digits()


class Server(ThreadingHTTPServer):
    """Answers as it is told, and keeps what it was asked."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.reply: Callable[[dict[str, Any]], tuple[int, Any]] = says("A")
        self.asked: list[dict[str, Any]] = []
        self.keys: list[str | None] = []
        self.drops: list[str] = []

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        question = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append(question)
        self.server.keys.append(self.headers["Authorization"])
        if self.server.drops:
            self.drop(self.server.drops.pop())
            return
        status, said = self.server.reply(question) if self.path == "/v1/chat/completions" else (404, "not here")
        body = said.encode() if isinstance(said, str) else json.dumps(said).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def drop(self, sent: str) -> None:
        """Break off after some of the answer, or none."""
        self.wfile.write(sent.encode())
        self.close_connection = True

    def log_message(self, format: str, *arguments: object) -> None:
        """Quietly."""


def says(word: str | None) -> Callable[[dict[str, Any]], tuple[int, Any]]:
    return lambda _: (200, {"choices": [{"message": {"content": word}}]})


def darker(question: dict[str, Any]) -> tuple[int, Any]:
    """Looks at both pictures, and likes the one with more ink."""
    first, second = ink(question)
    return says("A" if first > second else "B.")(question)


def ink(question: dict[str, Any]) -> list[float]:
    parts = question["messages"][0]["content"]
    urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
    data = [base64.b64decode(url.removeprefix("data:image/png;base64,")) for url in urls]
    return [255 - float(np.asarray(Image.open(io.BytesIO(one))).mean()) for one in data]


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as found:
        thread = threading.Thread(target=found.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield found
        found.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def task() -> Digits:
    return small_digits()


def judge(task: Digits, server: Server, **changes: Any) -> VisionJudge:
    return VisionJudgeSettings.model_validate({"address": server.address, "pause_seconds": 0, **changes}).build(task)


def pairs(count: int, size: int = 2) -> list[Query[Picture]]:
    return [Query(tuple(Picture("a three", one) for one in PIXELS[size * i : size * (i + 1)])) for i in range(count)]


def answered(one: VisionJudge, queries: list[Query[Picture]], folder: Path) -> list[Any]:
    with Store[Picture](folder) as store:
        store.ask(queries)
        one.answer(store, np.random.default_rng(0))
        found = {answer.query: answer for answer in store.answers()}
    return [found.get(query.id) for query in queries]


def test_it_sees_both_pictures_in_both_orders(task: Digits, server: Server, tmp_path: Path) -> None:
    server.reply, queries = darker, pairs(6)
    one = judge(task, server, criterion="Which is darker?")
    for query, answer in zip(queries, answered(one, queries, tmp_path), strict=True):
        first, second = (candidate.pixels.mean() for candidate in query.candidates)
        assert isinstance(answer, Comparison)
        assert answer.preference == float(first > second)
    assert one.metrics == {"pairs": 6.0, "refused": 0.0, "position_bias": 0.0, "flipped": 0.0}
    assert len(server.asked) == 12
    assert all(sorted(ink(a)) == ink(a) or sorted(ink(a)) == ink(a)[::-1] for a in server.asked)
    said = [part["text"] for part in server.asked[0]["messages"][0]["content"] if part["type"] == "text"]
    assert '"a three"' in said[0]
    assert said[-1] == "Which is darker? Answer with one letter, A or B."
    assert server.keys == [None] * 12


def test_four_pictures_are_a_ranking(task: Digits, server: Server, tmp_path: Path) -> None:
    server.reply, (query,) = darker, pairs(1, size=4)
    (answer,) = answered(judge(task, server), [query], tmp_path)
    assert isinstance(answer, Ranking)
    means = [candidate.pixels.mean() for candidate in query.candidates]
    assert np.argsort(answer.ranks).tolist() == np.argsort(means)[::-1].tolist()


def test_one_that_always_says_first_is_told_by_its_position_bias(task: Digits, server: Server, tmp_path: Path) -> None:
    one = judge(task, server)
    found = answered(one, pairs(3), tmp_path)
    assert [answer.preference for answer in found] == [0.5, 0.5, 0.5]
    assert one.metrics == {"pairs": 3.0, "refused": 0.0, "position_bias": 0.5, "flipped": 1.0}


@pytest.mark.parametrize("word", ["I cannot judge people's handwriting.", "", None, "AB"])
def test_refusals_are_skips(task: Digits, server: Server, tmp_path: Path, word: str | None) -> None:
    server.reply = says(word)
    one = judge(task, server)
    assert all(isinstance(answer, Skip) for answer in answered(one, pairs(2), tmp_path))
    assert one.metrics["refused"] == 1.0


def test_what_comes_too_late_is_asked_again_and_then_skipped(task: Digits, server: Server, tmp_path: Path) -> None:
    def late(question: dict[str, Any]) -> tuple[int, Any]:
        time.sleep(0.4)
        return says("A")(question)

    server.reply = late
    one = judge(task, server, timeout_seconds=0.1, retries=1)
    assert all(isinstance(answer, Skip) for answer in answered(one, pairs(1), tmp_path))
    assert len(server.asked) == 4


def test_a_server_that_fails_once_is_asked_again(task: Digits, server: Server, tmp_path: Path) -> None:
    seen: list[int] = []

    def failing(question: dict[str, Any]) -> tuple[int, Any]:
        seen.append(1)
        return (503, "busy") if len(seen) == 1 else darker(question)

    server.reply = failing
    (answer,) = answered(judge(task, server, at_once=1), pairs(1), tmp_path)
    assert isinstance(answer, Comparison)
    assert len(seen) == 3


CHUNKED = "HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n40\r\n{"
SHORT = "HTTP/1.1 200 OK\r\nContent-Length: 500\r\n\r\n{"


@pytest.mark.parametrize("sent", ["", "no HTTP\r\n\r\n", SHORT, CHUNKED])
def test_a_connection_that_breaks_is_tried_again_and_then_a_skip(
    task: Digits, server: Server, tmp_path: Path, sent: str
) -> None:
    server.reply, server.drops = darker, [sent]
    one = judge(task, server, at_once=1)
    assert isinstance(answered(one, pairs(1), tmp_path / "once")[0], Comparison)
    assert len(server.asked) == 3
    server.drops = [sent] * 4
    assert isinstance(answered(one, pairs(1), tmp_path / "always")[0], Skip)


def test_pauses_grow(task: Digits, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    paused: list[float] = []
    monkeypatch.setattr(time, "sleep", paused.append)
    server.reply = lambda _: (429, "too many")
    first, second = pairs(1)[0].candidates
    (found,) = judge(task, server, at_once=1, retries=3, pause_seconds=0.5).compare([(first, second)])
    assert np.isnan(found.preference)
    assert [x for x in paused if x >= 0.5] == [0.5, 1.0, 2.0] * 2


@pytest.mark.parametrize("answers", [("A", "A"), ("", "B"), ("A", "A "), ("A", " ")])
def test_answers_that_cannot_be_told_apart_are_refused(answers: tuple[str, str]) -> None:
    with pytest.raises(ValidationError, match="expected two answers that differ, neither empty"):
        VisionJudgeSettings(answers=answers)


def test_an_address_that_is_none_is_told(task: Digits) -> None:
    first, second = pairs(1)[0].candidates
    with pytest.raises(ConfigError, match=r"labeler.address: http://127.0.0.1:x/v1 is no address"):
        VisionJudgeSettings(address="http://127.0.0.1:x/v1").build(task).compare([(first, second)])


def test_a_server_that_cannot_be_used_is_told(task: Digits, server: Server, tmp_path: Path) -> None:
    first, second = pairs(1)[0].candidates
    server.reply = lambda _: (401, "no such key")
    with pytest.raises(ConfigError, match="the server refuses with 401: no such key"):
        judge(task, server).compare([(first, second)])
    server.reply = lambda _: (200, "<html>")
    with pytest.raises(ConfigError, match="does not speak JSON"):
        judge(task, server).compare([(first, second)])
    nobody = VisionJudgeSettings(address="http://127.0.0.1:9/v1").build(task)
    with pytest.raises(ConfigError, match=r"nobody answers at http://127.0.0.1:9/v1"):
        nobody.compare([(first, second)])
    with pytest.raises(ConfigError, match="key_file: cannot be read"):
        judge(task, server, key_file=tmp_path / "none")


def test_a_key_is_read_from_its_file_and_never_kept(task: Digits, server: Server, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("secret\n")
    one = judge(task, server, key_file=tmp_path / "key")
    first, second = pairs(1)[0].candidates
    one.compare([(first, second)])
    assert set(server.keys) == {"Bearer secret"}
    assert "secret" not in repr(one) + one.settings.model_dump_json()


def test_what_a_reply_says() -> None:
    said: list[object] = [{"choices": [{"message": {"content": word}}]} for word in ("A", "**B**", "Both", '"A".', 7)]
    found = [read_reply(one, ("A", "B")) for one in [*said, {}, [], None]]
    assert found[:2] == [1.0, 0.0]
    assert found[3] == 1.0
    assert all(np.isnan(x) for x in (found[2], *found[4:]))


@pytest.mark.parametrize(
    ("said", "value"),
    [
        (" A\n", 1.0),
        ("(B)", 0.0),
        ("Answer: B", 0.0),
        ("**Answer:** A.", 1.0),
        ("Picture B.", 0.0),
        ("The answer is picture A", 1.0),
        ("A three is clearer in B", None),
        ("A/B", None),
        ("A picture", None),
        ("Answer:", None),
        ("a", None),
        ("Theanswer A", None),
    ],
)
def test_only_an_answer_alone_or_after_a_lead_counts(said: str, value: float | None) -> None:
    found = read_reply({"choices": [{"message": {"content": said}}]}, ("A", "B"))
    assert np.isnan(found) if value is None else found == value


def test_words_and_marks_may_be_answers_and_what_is_both_is_none() -> None:
    def read(said: str, *answers: str) -> float:
        return read_reply({"choices": [{"message": {"content": said}}]}, (answers[0], answers[1]))

    assert read("Picture two.", "Picture one", "Picture two") == 0.0
    assert read("+", "+", "-") == 1.0
    assert np.isnan(read("-+", "+", "-"))


def test_only_pictures_are_looked_at() -> None:
    config = Config.load("control/toy", ["labeler.kind=vision_judge"])
    with pytest.raises(ConfigError, match="looks at pictures, but the task is of kind 'control'"):
        config.build_labeler(config.build_task())
    goal = Config.load("pictures/digits", ["labeler.kind=vision_judge"])
    assert goal.labeler.asking(goal.goal).model_dump()["criterion"] == "Which looks more like a three?"
