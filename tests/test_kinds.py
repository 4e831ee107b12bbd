"""The kinds of candidate, and a fourth that no file of the product names: it goes through the house all the same."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from web_service import answering, ask_for, log_in

from prefrl import kinds
from prefrl.components import Settings
from prefrl.evaluate.lengths import context, length
from prefrl.exchange.ports import export_bundle, import_bundle
from prefrl.exchange.source import check_candidates
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit
from prefrl.judgements import Comparison
from prefrl.kinds import PICTURES, RESPONSES, SEGMENTS, Kind, Shown, find, kind_of, logged, named, only
from prefrl.label.oracle import OracleSettings
from prefrl.label.web import WebSettings, terms_of
from prefrl.page.clips import worker
from prefrl.page.service import Service
from prefrl.protocols import Selector
from prefrl.report.examples import save_examples
from prefrl.sample.select import ScoredSettings, UnscoredSettings
from prefrl.storage.events import describe, load_foreign
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Floats, Picture, Query, Response, Segment, State, digest

SIZE = 16


@dataclass(frozen=True, eq=False)
class Drawing:
    """What was drawn for a caption."""

    caption: str
    pixels: np.ndarray
    """(H, W) uint8."""
    gold: Floats | None = None

    @property
    def context(self) -> str:
        return self.caption

    @cached_property
    def id(self) -> str:
        return digest(self.caption, {"pixels": self.pixels})


DRAWINGS = Kind(
    name="drawings",
    candidate=Drawing,
    noun="drawing",
    describe=lambda one: {"caption": one.caption},
    load=lambda body, read: Drawing(body["caption"], read()["pixels"]),
    arrays=lambda one: {"pixels": one.pixels},
    fault=lambda one: "" if one.pixels.dtype == np.uint8 else "has pixels that are no bytes",
    length=lambda one: one.pixels.size,
    unit=lambda _: "pixels",
    shows="clip",
    shown=lambda body: Shown(prompt=body["caption"], steps=1),
    question="Which drawing is better?",
    lease_seconds=77.0,
    behaviour="drawing",
)


@dataclass(frozen=True)
class Gallery:
    """A task whose behaviours are drawings."""

    name: str = "gallery"
    kind: str = "drawings"
    fps: float = 1.0

    def frames(self, candidate: Drawing) -> np.ndarray:
        return np.repeat(candidate.pixels[None, :, :, None], 3, axis=3)


class GallerySettings(Settings):
    kind: str = "gallery"

    def build(self) -> Gallery:
        return Gallery()


@dataclass
class Brightness:
    """A reward model of drawings with one weight a member: how much the mean of the pixels counts."""

    weights: torch.nn.Parameter = field(default_factory=lambda: torch.nn.Parameter(torch.tensor([[0.0], [0.1]])))
    fitted: bool = False
    members: int = 2

    def stack(self, candidates: Sequence[Drawing]) -> Mapping[str, torch.Tensor]:
        return {"mean": torch.tensor([one.pixels.mean() / 255 for one in candidates], dtype=torch.float32)}

    def scores(self, stacked: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return self.weights * stacked["mean"]

    def to(self, device: torch.device) -> None:
        assert device.type == "cpu"

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return [self.weights]

    def settle(self, stacked: Mapping[str, torch.Tensor], loss: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        self.fitted = True
        return self.scores(stacked).detach()

    def calibrate(self, temperature: float) -> None:
        self.weights.data /= temperature

    def raw_member_scores(self, candidates: Sequence[Drawing]) -> Floats:
        return self.scores(self.stack(candidates)).detach().numpy()

    def member_scores(self, candidates: Sequence[Drawing]) -> Floats:
        return self.raw_member_scores(candidates)

    def score(self, candidates: Sequence[Drawing]) -> Floats:
        found: Floats = self.raw_member_scores(candidates).mean(0)
        return found

    def features(self, candidates: Sequence[Drawing]) -> Floats:
        return np.array([[one.pixels.mean(), one.pixels.std()] for one in candidates])

    def state(self) -> State:
        return {"weights": self.weights.detach()}

    def load(self, state: State) -> None:
        self.weights.data = state["weights"]


@pytest.fixture(autouse=True)
def _installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package brings a fourth kind, as far as anybody can tell."""
    points = [EntryPoint("drawings", "test_kinds:DRAWINGS", "prefrl.kinds")]
    monkeypatch.setattr(kinds, "entry_points", lambda group: points if group == "prefrl.kinds" else [])
    kinds.plugins.cache_clear()
    yield
    kinds.plugins.cache_clear()


def drawn(count: int, caption: str = "a square") -> list[Drawing]:
    """Drawings whose gold is how bright they are."""
    rng = np.random.default_rng(0)
    found = [rng.integers(0, int(rng.integers(20, 256)), (SIZE, SIZE), np.uint8) for _ in range(count)]
    return [Drawing(caption, pixels, np.array([pixels.mean() / 255])) for pixels in found]


def pairs(count: int) -> list[Query[Drawing]]:
    some = drawn(2 * count)
    return [Query((a, b)) for a, b in zip(some[::2], some[1::2], strict=True)]


# --- the table ------------------------------------------------------------------------------------------------------


def test_a_kind_is_found_by_its_name_its_noun_and_its_class() -> None:
    steps = np.zeros((2, 3), np.float32)
    assert named("control") is logged("segment") is kind_of(Segment(steps, steps, "e", 0)) is SEGMENTS
    assert named("text") is logged("response") is kind_of(Response("p", "t")) is RESPONSES
    assert named("pictures") is kind_of(Picture("a three", np.zeros((2, 2), np.uint8))) is PICTURES
    assert named("drawings") is logged("drawing") is kind_of(drawn(1)[0]) is DRAWINGS
    assert find("sound") is None
    with pytest.raises(ValueError, match="unknown kind of candidate 'contrl'; did you mean 'control'"):
        named("contrl")
    with pytest.raises(ValueError, match="unknown type of candidate 'sound'"):
        logged("sound")


def test_candidates_of_another_class_are_refused_as_their_reader_says() -> None:
    texts = [Response("p", "t")]
    assert only(Response, texts, ValueError()) == texts
    with pytest.raises(KeyError, match="no drawings"):
        only(Response, [*texts, *drawn(1)], KeyError("no drawings"))


def test_candidates_of_every_kind_are_what_they_were_after_a_way_through_json() -> None:
    steps = np.ones((4, 3), np.float32)
    texts, pixels = Response("p", "t", (1,), (2, 3)), np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    for one in (Segment(steps, steps, "e", 7, states=steps), texts, Picture("a three", pixels), drawn(1)[0]):
        kind = kind_of(one)
        loaded = kind.load(json.loads(json.dumps(kind.describe(one))), partial(kind.arrays, one))
        assert loaded.id == one.id
        assert kind.fault(loaded) == ""
        assert describe(one)["type"] == kind.noun


@pytest.mark.parametrize(
    ("pixels", "fault"),
    [
        (np.zeros((2, 2)), "of type float64; expected bytes"),
        (np.zeros((2, 2, 4), np.uint8), r"of shape \(2, 2, 4\); expected"),
        (np.zeros((0, 2), np.uint8), r"of shape \(0, 2\); expected"),
        (np.zeros(4, np.uint8), r"of shape \(4,\); expected"),
    ],
)
def test_pixels_that_are_no_picture_are_told(pixels: np.ndarray, fault: str) -> None:
    assert re.search(fault, PICTURES.fault(Picture("a three", pixels)))


# --- a fourth kind ----------------------------------------------------------------------------------------------------


def test_drawings_are_asked_about_answered_and_read_again(tmp_path: Path) -> None:
    queries = pairs(3)
    with Store[Drawing](tmp_path) as store:
        store.ask(queries)
        store.answer([Comparison(queries[0].id, 1.0, "ann")])
        with pytest.raises(StoreError, match="holds drawings, and cannot hold Responses"):
            Store[Any].ask(store, [Query((Response("p", "a"), Response("p", "b")))])
    with Store[Drawing](tmp_path, write=False) as store:
        (judged,) = store.judged()
        assert [c.id for c in judged.query.candidates] == [c.id for c in queries[0].candidates]
        assert np.array_equal(judged.query.candidates[0].pixels, queries[0].candidates[0].pixels)
        assert judged.query.candidates[0].gold is None
        expected = queries[1].candidates[1].gold
        assert expected is not None
        assert np.array_equal(store.gold(queries[1].candidates)[1], expected)
        assert [q.id for q in store.open_queries()] == [q.id for q in queries[1:]]


def test_a_bundle_carries_drawings_and_a_false_one_is_refused(tmp_path: Path) -> None:
    queries = pairs(2)
    with Store[Drawing](tmp_path / "from") as store, Store[Drawing](tmp_path / "to") as other:
        store.ask(queries)
        store.answer([Comparison(query.id, 0.0, "ann") for query in queries])
        export_bundle(store, tmp_path / "bundle")
        import_bundle(tmp_path / "bundle", other)
        assert [one.judgement for one in other.judged()] == [one.judgement for one in store.judged()]
        assert [one.query.id for one in other.judged()] == [query.id for query in queries]
        false = Drawing("a square", np.zeros((2, 2)))
        other._file_one(false)
        with pytest.raises(StoreError, match="has pixels that are no bytes"):
            load_foreign(false.id, describe(false), other.folder / "blobs")


def test_a_reward_model_of_drawings_is_fitted_on_what_an_oracle_says(tmp_path: Path) -> None:
    reward = Brightness()
    with Store[Drawing](tmp_path) as store:
        store.ask(pairs(20))
        OracleSettings().build(Gallery()).answer(store, np.random.default_rng(0))
        check_candidates(store.judged(), Gallery())
        found = fit(reward, store, FittingSettings(epochs=30, learning_rate=0.1), np.random.default_rng(0))
    assert reward.fitted
    assert found.metrics["accuracy"] == 1.0
    assert float(reward.weights.detach().min()) > 0.5


def test_queries_about_drawings_are_selected() -> None:
    pool, reward, rng = [*drawn(12), *drawn(12, "a circle")], Brightness(), np.random.default_rng(0)
    for settings in (UnscoredSettings(), UnscoredSettings(kind="coverage"), ScoredSettings(kind="disagreement")):
        reward.fitted = True
        selector: Selector[Drawing] = settings.build()
        chosen = selector.select(pool, reward, 4, rng)
        assert len(chosen) == 4
        assert all(len({c.caption for c in query.candidates}) == 1 for query in chosen)


def test_drawings_are_measured_and_shown_in_a_report(tmp_path: Path) -> None:
    one = drawn(1)[0]
    assert (length(one), context(one)) == (SIZE * SIZE, "a square")
    (shown,) = json.loads(save_examples(Gallery(), [one], None, tmp_path, "after").read_text())
    assert (tmp_path / "examples" / shown["strip"]).is_file()


@dataclass
class Addresses:
    """A `ClipSource` that draws nothing."""

    wanted: list[str] = field(default_factory=list)

    def names(self, candidate: str) -> list[str]:
        return [f"/clips/{candidate}.webp"]

    def want(self, candidate: str, soon: bool = False) -> None:
        self.wanted.append(candidate)

    async def get(self, name: str, wait: float) -> Path:
        raise NotImplementedError

    def counts(self) -> dict[str, int]:
        return {}


def test_people_judge_drawings_on_the_page(tmp_path: Path) -> None:
    queries, clips = pairs(2), Addresses()
    terms = terms_of(WebSettings(check_share=0, repeat_share=0), Gallery(), fixed=True)
    assert (terms.page.question, terms.policy.lease_seconds) == ("Which drawing is better?", 77.0)
    with Store[Drawing](tmp_path) as store:
        store.ask(queries)
        service = Service(store, terms, clips=clips)
        service.open()
        try:
            ann = log_in(service, "ann")
            (card,) = ask_for(ann)
            (query,) = (q for q in queries if q.id == card["query_id"])
            assert (card["kind"], card["prompt"]) == ("drawings", "a square")
            assert {item["media"][0] for item in card["items"]} == {f"/clips/{c.id}.webp" for c in query.candidates}
            assert all(item["steps"] == 1 and item["text"] is None for item in card["items"])
            assert set(clips.wanted) == {c.id for c in query.candidates}
            sent = ann.post("/api/answers", json=answering(card["assignment_id"], "tie"))
            assert sent.status_code == 200, sent.text
            assert log_in(service, "eve", "admin").get("/api/admin/overview").json()["exports"] == ["bundle"]
        finally:
            service.close()
        (judged,) = store.judged()
    assert judged.query.id == query.id
    assert judged.judgement.labeler == "ann"


def test_the_clip_of_a_drawing_is_drawn_by_its_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (query,) = pairs(1)
    with Store[Drawing](tmp_path) as store:
        store.ask([query])
    (tmp_path / "config.yaml").write_text("task: {kind: gallery}\n")
    monkeypatch.setattr(worker, "settings_class", lambda role, kind: GallerySettings)
    name = f"{'a' * 64}.webp"
    (tmp_path / "clips" / "aa").mkdir(parents=True)
    size = worker.Artist(tmp_path).draw(query.candidates[0].id, name)
    assert (tmp_path / "clips" / "aa" / name).stat().st_size == size > 0
