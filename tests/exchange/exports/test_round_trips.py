"""Store -> form -> store: each form gives back what it can hold."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from prefrl.exchange.ports import export, import_judgements
from prefrl.exchange.transcripts import prompt_text
from prefrl.judgements import Answer, Choice, Comparison, Ranking, Rating, Skip, implied_pairs
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

TEXT = st.text(st.characters(blacklist_categories=["Cs"]), max_size=8) | st.sampled_from(
    ["=1+1", "@x", "'quoted", "", " ", "a,b", 'say "x"', "line\nbreak", "\r", "\x00", "\u2028", "[1]", "NA", "Human: x"]
)
PREFERENCE = st.sampled_from([0.0, 0.5, 1.0, 0.73, 0.12, 0.9500000001])
LABELERS = ("ann", "bob", "=cmd", "zoë")
SOME = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def asked(draw: st.DrawFn, least: int = 1, most: int = 4, prompts: st.SearchStrategy[str] = TEXT) -> Query[Response]:
    prompt = draw(prompts)
    texts = draw(st.lists(TEXT, min_size=least, max_size=most, unique=True))
    return Query(tuple(Response(prompt, text) for text in texts))


@st.composite
def answered(draw: st.DrawFn, query: Query[Response], labeler: str, kinds: str) -> Answer:
    """An answer of one of the kinds (c, r, b, l, s: comparison, ranking, best, levels, skip) that fits the query."""
    size = len(query.candidates)
    kind = draw(st.sampled_from([k for k in kinds if k in "ls" or (k == "c") == (size == 2) or size == 2] or ["s"]))
    if size == 1:
        kind = "l" if "l" in kinds else "s"
    shown = draw(st.sampled_from([(), tuple(reversed(range(size)))]))
    weight = draw(st.sampled_from([1.0, 0.5]))
    match kind:
        case "c":
            return Comparison(query.id, draw(PREFERENCE), labeler, shown, weight)
        case "r":
            ranks = draw(st.lists(st.integers(0, 2), min_size=size, max_size=size))
            return Ranking(query.id, tuple(ranks), labeler, shown, weight)
        case "b":
            return Choice(query.id, draw(st.integers(0, size - 1)), labeler, shown, weight)
        case "l":
            levels = draw(st.lists(st.integers(0, 1), min_size=size, max_size=size))
            return Rating(query.id, tuple(levels), 2, labeler, shown, weight)
    return Skip(query.id, draw(st.sampled_from(["skip", "incomparable"])), labeler, shown)


@st.composite
def stored(draw: st.DrawFn, /, kinds: str = "crbls", **limits: Any) -> tuple[list[Query[Response]], list[Answer]]:
    queries = draw(st.lists(asked(**limits), min_size=1, max_size=4, unique_by=lambda q: q.id))
    answers = []
    for query in queries:
        for labeler in draw(st.lists(st.sampled_from(LABELERS), min_size=1, max_size=2, unique=True)):
            answers.append(draw(answered(query, labeler, kinds)))
    return queries, answers


@contextmanager
def copied(content: tuple[list[Query[Any]], list[Answer]], form: str) -> Iterator[tuple[Store[Any], Store[Any]]]:
    """A store with the content, and another that read what the first wrote."""
    names = {"dataset": "set", "bundle": "bundle", "minari": "episodes", "csv": "x.csv", "argilla": "x.json"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / {"label-studio": "x.json", **names}.get(form, "x.jsonl")
        with Store[Any](Path(folder) / "one") as one, Store[Any](Path(folder) / "two") as two:
            one.ask(content[0])
            one.answer(content[1])
            if export(one, path, form).written:
                import_judgements(path, two)
            yield one, two


def told(store: Store[Any], *left_out: str) -> Counter[Any]:
    """Every answer of a store, less some of its fields."""
    return Counter(tuple((k, v) for k, v in vars(a).items() if k not in left_out) for a in store.answers())


def pairs(store: Store[Any]) -> Counter[tuple[str, str, str, float]]:
    """(prompt, better, worse, preference) of each pair that the judgements imply."""
    found: Counter[tuple[str, str, str, float]] = Counter()
    for judged in store.judged():
        texts = judged.query.candidates
        for i, j, preference in implied_pairs(judged.judgement, len(texts)):
            first, second, value = texts[i].text, texts[j].text, preference
            if value < 0.5 or (value == 0.5 and first > second):
                first, second, value = second, first, 1.0 - value
            found[texts[0].prompt, first, second, round(value, 9)] += 1
    return found


def sides(store: Store[Any]) -> set[tuple[str, str, str, bool]]:
    """(prompt, better, worse, whether they are tied): what a form holds that knows no strength."""
    return {(*found[:3], found[3] == 0.5) for found in pairs(store)}


def decided(found: Counter[tuple[str, str, str, float]]) -> Counter[tuple[str, str, str, float]]:
    return Counter({key: count for key, count in found.items() if key[3] != 0.5})


@SOME
@given(stored())
@pytest.mark.parametrize("form", ["judgements", "dataset", "bundle"])
def test_forms_that_hold_everything_give_every_answer_back(form: str, content: Any) -> None:
    with copied(content, form) as (one, two):
        assert told(two) == told(one)


@SOME
@given(stored(kinds="cs", least=2, most=2))
def test_argilla_gives_back_who_preferred_what(content: Any) -> None:
    with copied(content, "argilla") as (one, two):
        sure = Counter[Any]()
        for answer, count in told(one, "shown", "weight").items():
            fields = dict(answer)
            if "preference" in fields:
                fields["preference"] = float(np.sign(fields["preference"] - 0.5) / 2 + 0.5)
            sure[tuple(fields.items())] += count
        assert told(two, "shown", "weight") == sure


@SOME
@given(stored(kinds="rbs", least=3))
def test_argilla_gives_back_rankings_and_choices(content: Any) -> None:
    with copied(content, "argilla") as (one, two):
        dense = Counter[Any]()
        for answer, count in told(one, "shown", "weight").items():
            fields = dict(answer)
            if "ranks" in fields:
                levels = sorted(set(fields["ranks"]))
                fields["ranks"] = tuple(levels.index(rank) for rank in fields["ranks"])
            dense[tuple(fields.items())] += count
        assert told(two, "shown", "weight") == dense


@SOME
@given(stored(kinds="cs", least=2, most=2))
def test_label_studio_gives_back_sides_ties_and_skips(content: Any) -> None:
    with copied(content, "label-studio") as (one, two):
        assert sum(pairs(two).values()) == sum(pairs(one).values())
        assert sides(two) == sides(one)
        skips = [[(a.query, a.reason, a.labeler) for a in s.answers() if isinstance(a, Skip)] for s in (one, two)]
        assert sorted(skips[0]) == sorted(skips[1])


PROMPTS = st.lists(st.text("ab \n", max_size=4), min_size=1, max_size=2).map(
    lambda words: prompt_text([{"role": "user", "content": word} for word in words])
)


@SOME
@given(stored(kinds="crb", least=2, prompts=PROMPTS))
@pytest.mark.parametrize("form", ["preferences", "conversational"])
def test_columns_of_chosen_and_rejected_give_back_every_decided_pair(form: str, content: Any) -> None:
    with copied(content, form) as (one, two):
        assert pairs(two) == decided(pairs(one))


@SOME
@given(stored(kinds="crbs", least=2))
def test_a_table_gives_back_every_pair_with_its_ties_strength_and_labeler(content: Any) -> None:
    with copied(content, "csv") as (one, two):
        assert pairs(two) == pairs(one)
        by = [Counter(j.judgement.labeler.partition("#")[0] for j in s.judged()) for s in (one, two)]
        assert set(by[1]) <= set(by[0])


@SOME
@given(stored(kinds="l", most=1, prompts=PROMPTS))
@pytest.mark.parametrize("form", ["unpaired", "unpaired-conversational"])
def test_unpaired_rows_give_back_whether_each_response_is_good(form: str, content: Any) -> None:
    with copied(content, form) as (one, two):
        levels = [[(a.query, a.levels, a.scale) for a in s.answers() if isinstance(a, Rating)] for s in (one, two)]
        assert sorted(levels[0]) == sorted(levels[1])


@SOME
@given(stored(kinds="crs", least=2, most=2, prompts=PROMPTS))
def test_the_arena_gives_back_winners_ties_and_what_is_incomparable(content: Any) -> None:
    with copied(content, "arena") as (one, two):
        assert sides(two) == sides(one)
        bad = [{a.query for a in s.answers() if isinstance(a, Skip) and a.reason == "incomparable"} for s in (one, two)]
        assert bad[0] == bad[1]


def test_minari_gives_back_segments_and_every_answer(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a path that is not absolute is a case of its own
    queries = [make_query(0.0, 1.0), make_query(0.0, 1.0, 2.0), make_query(1.0, 0.0)]
    store.ask(queries)
    store.answer([Comparison(queries[0].id, 0.3, "a", (1, 0)), Ranking(queries[1].id, (0, 2, 1), "b", (), 0.5)])
    store.answer([Skip(queries[2].id, "incomparable", "a")])
    assert export(store, Path("some/episodes"), "minari").written == 3
    with Store[Segment](tmp_path / "copy") as copy:
        import_judgements(Path("some/episodes"), copy)
        assert copy.answers() == store.answers()
        assert [copy.query(query.id).id for query in queries] == [query.id for query in queries]
