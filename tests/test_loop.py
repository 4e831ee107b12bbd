"""The loop end to end on the toy presets: every claim holds for control, for text and for pictures."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from runs import tiny
from threadpoolctl import threadpool_info

from prefrl import Config
from prefrl.config import presets
from prefrl.judgements import Answer, Comparison, Ranking, Skip
from prefrl.loop import Loop, LoopSettings
from prefrl.protocols import Store
from prefrl.stages import shrink
from prefrl.store import Store as SQLStore
from prefrl.types import Query

TOYS = ["control/toy", "text/toy", "pictures/digits"]


def build(name: str, folder: Path, *overrides: str) -> Loop[Any]:
    store: SQLStore[Any] = SQLStore(folder)
    return tiny(name, *overrides).build(store)


def leaves(state: Any) -> Iterator[bytes]:
    """Every array of a nested state as bytes."""
    if isinstance(state, dict):
        for key in state:
            if key != "gold":  # carried along in recent rollouts, for the oracle
                yield from leaves(state[key])
    elif isinstance(state, list | tuple):
        for value in state:
            yield from leaves(value)
    elif isinstance(state, torch.Tensor):
        yield state.detach().numpy().tobytes()
    elif isinstance(state, np.ndarray):
        yield state.tobytes()
    else:
        yield repr(state).encode()


def learned(loop: Loop[Any]) -> list[bytes]:
    """All that was learned: the weights of the reward model and of the policy, the optimiser's state."""
    return [*leaves(loop.reward.state()), *leaves(loop.learner.state())]


@pytest.mark.parametrize("name", [name for name in presets() if Config.load(name).loop.labels])
def test_every_preset_runs_a_small_round(name: str, tmp_path: Path) -> None:
    with SQLStore[Any](tmp_path) as store:
        loop = shrink(Config.load(name)).build(store)
        rounds = list(loop.run())
    assert [r.number for r in rounds] == [0, 1]
    assert all(np.isfinite(r.metrics["evaluate/gold"]) for r in rounds)
    assert rounds[1].metrics["label/answered"] > 0


@pytest.mark.parametrize("name", TOYS)
def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(name: str, tmp_path: Path) -> None:
    runs = [build(name, tmp_path / str(i), f"seed={seed}") for i, seed in enumerate((0, 0, 1))]
    for loop in runs:
        list(loop.run())
    a, b, c = (learned(loop) for loop in runs)
    assert a == b
    assert a != c


class Replay:
    """Gives the answers that another run's labeler gave; sees no gold."""

    name = "replay"

    def __init__(self, answers: list[Answer]) -> None:
        self.answers = {a.query: a for a in answers}

    def answer(self, store: Store[Any], rng: np.random.Generator) -> None:
        store.answer([replace(self.answers[q.id], labeler=self.name) for q in store.open_queries(self.name)])


class Blind:
    """A learner whose every sampled candidate has NaN for gold."""

    def __init__(self, learner: Any) -> None:
        self._learner = learner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._learner, name)

    def sample(self, count: int, rng: np.random.Generator) -> list[Any]:
        return [replace(c, gold=np.full_like(c.gold, np.nan)) for c in self._learner.sample(count, rng)]


WAYS = (
    ("select.kind=uniform", "fitting.epochs=8"),
    ("select.kind=disagreement", "fitting.epochs=8"),
    ("select.kind=coverage", "fitting.epochs=8", "fitting.ties=davidson", "fitting.denoise=filter"),
    (
        "select.kind=information", "select.diversify=dpp",
        "fitting.epochs=8", "fitting.reliability=learned", "fitting.pseudo_labels=1",
    ),
)  # fmt: skip
"""Settings under which runs must not see the gold; the first one names them."""


@pytest.mark.parametrize("name", TOYS)
@pytest.mark.parametrize("ways", WAYS, ids=lambda ways: ways[0].partition("=")[2])
def test_nothing_that_learns_sees_the_gold(name: str, ways: tuple[str, ...], tmp_path: Path) -> None:
    """With every gold value replaced by NaN, the fitted weights and the improved policy are bit-identical."""
    with SQLStore[Any](tmp_path / "seeing") as store:
        seeing = tiny(name, *ways).build(store)
        list(seeing.run())
        answers = store.answers()
    blind = build(name, tmp_path / "blind", *ways)
    hide_gold(blind.task)
    blind.learner = Blind(blind.learner)
    blind.labeler = Replay(answers)
    rounds = list(blind.run())
    assert all(np.isnan(r.metrics.get("evaluate/gold", np.nan)) for r in rounds)  # pictures leave out what is no number
    assert learned(blind) == learned(seeing)


def test_a_discriminator_of_what_was_shown_does_not_see_the_gold(tmp_path: Path) -> None:
    short = [
        "task.horizon=20", "learner.environments=2", "learner.steps_per_round=40", "learner.evaluation_episodes=1",
        "loop.rounds=2", "loop.labels=8", "loop.first_share=0.5", "learner.clone.epochs=1", "fitting.shown_as=piles",
    ]  # fmt: skip
    config = Config.load("control/pendulum-adversarial", short)
    seeing, blind = (config.build(SQLStore[Any](tmp_path / name)) for name in ("seeing", "blind"))
    hide_gold(blind.task)
    blind.learner = Blind(blind.learner)
    list(seeing.run())
    assert all(np.isnan(r.metrics["evaluate/gold"]) for r in blind.run())
    assert learned(blind) == learned(seeing)


def hide_gold(task: Any) -> None:
    """Make the task itself give NaN: environments' rewards, or the scorer of texts or pictures."""
    if task.kind != "control":
        object.__setattr__(task, "gold", lambda candidates: np.full(len(candidates), np.nan))
        return
    make = task.environments

    def environments(count: int) -> Any:
        made = make(count)
        step = made.step
        made.step = lambda actions: (t := step(actions))._replace(rewards=np.full_like(t.rewards, np.nan))
        return made

    object.__setattr__(task, "environments", environments)


def test_every_environment_step_is_counted_once_and_by_purpose(tmp_path: Path) -> None:
    loop = build("control/toy", tmp_path)
    task: Any = loop.task
    make, counted = task.environments, [0]

    def environments(count: int) -> Any:
        made = make(count)
        step = made.step

        def counting(actions: np.ndarray) -> Any:
            counted[0] += len(actions)
            return step(actions)

        made.step = counting
        return made

    object.__setattr__(task, "environments", environments)
    *_, last = loop.run()
    spent = [last.metrics[f"steps/{name}"] for name in ("learn", "query", "evaluate")]
    assert sum(spent) == counted[0]
    assert all(n > 0 for n in spent)


def test_labels_are_asked_up_to_the_budget_and_skips_count(tmp_path: Path) -> None:
    class Skipper(Replay):
        def answer(self, store: Store[Any], rng: np.random.Generator) -> None:
            queries = store.open_queries(self.name)
            half = [Skip(q.id, "skip", self.name) for q in queries[::2]]
            store.answer([*half, *(Comparison(q.id, 1.0, self.name) for q in queries[1::2])])

    loop = build("control/toy", tmp_path, "loop.labels=20", "loop.rounds=3")
    loop.labeler = Skipper([])
    *_, last = loop.run()
    assert last.metrics["label/asked"] == 20
    assert last.metrics["label/answered"] + last.metrics["label/skipped"] == 20
    assert last.metrics["fit/comparisons"] == last.metrics["label/answered"]


def test_without_any_label_the_loop_goes_on_and_learns_nothing(tmp_path: Path) -> None:
    loop = build("control/toy", tmp_path)
    before = list(leaves(loop.reward.state()))
    loop.labeler = Silent()
    rounds = list(loop.run())
    assert rounds[-1].fitted is None
    assert "no judgements" in rounds[-1].notes[0]
    assert not any(name.startswith("improve/") for name in rounds[-1].metrics)
    assert list(leaves(loop.reward.state())) == before
    assert loop.learner.steps.learn == 0


class Silent:
    name = "nobody"

    def answer(self, store: Store[Any], rng: np.random.Generator) -> None:
        """People are at lunch."""


@pytest.mark.parametrize("size", [1, 8])
def test_a_pool_that_is_too_small_is_noted_and_none_at_all_says_what_to_change(size: int, tmp_path: Path) -> None:
    loop = build("control/toy", tmp_path)

    class Lazy(Blind):
        def sample(self, count: int, rng: np.random.Generator) -> list[Any]:
            return list(self._learner.sample(count, rng)[:size])

    loop.learner = Lazy(loop.learner)
    if size == 1:
        with pytest.raises(ValueError, match=r"raise loop\.pool"):
            list(loop.run())
        return
    _, first, *_ = loop.run()
    assert "8 sampled candidates gave" in first.notes[0]
    assert 0 < first.metrics["label/asked"] <= 4


def test_what_was_asked_before_is_not_asked_again_and_a_round_done_again_asks_the_same(tmp_path: Path) -> None:
    loop = build("control/toy", tmp_path, "loop.labels=8", "loop.rounds=4", "loop.first_share=0.25")
    pool = list(loop.learner.sample(200, np.random.default_rng(0)))[:13]

    class Stubborn(Blind):
        """Does the same each time."""

        def sample(self, count: int, rng: np.random.Generator) -> list[Any]:
            return pool

    class InOrder:
        def select(self, pool: Sequence[Any], reward: Any, count: int, rng: np.random.Generator) -> list[Query[Any]]:
            return [Query(pair) for pair in zip(pool[::2], pool[1::2], strict=False)][:count]

    loop.learner, loop.selector = Stubborn(loop.learner), InOrder()
    loop.start()
    asked, notes = [], []
    for _ in range(4):
        done, sequence = loop.round, loop.sequence
        first = loop.step().metrics["label/asked"]
        loop.round, loop.sequence = done, sequence  # as after a kill
        again = loop.step()
        asked.append(again.metrics["label/asked"])
        assert first == asked[-1]
        notes.append(again.notes)
    assert asked == [2, 4, 6, 6]
    assert "13 sampled candidates gave 0 of 2 new queries of 2" in notes[-1]


def test_labels_are_spread_as_the_settings_say() -> None:
    settings = LoopSettings(rounds=5, labels=100, first_share=0.2)
    assert [settings.asked_by(n) for n in range(6)] == [0, 20, 40, 60, 80, 100]
    assert [LoopSettings(rounds=1, labels=7).asked_by(n) for n in range(2)] == [0, 7]
    assert LoopSettings(rounds=3, labels=10, first_share=1.0).asked_by(1) == 10
    for spread, expected in {"hyperbolic": [10, 34, 46, 54, 60], "front": [10, 45, 54, 58, 60]}.items():
        early = LoopSettings.model_validate({"rounds": 5, "labels": 60, "first_share": 1 / 6, "spread": spread})
        assert [early.asked_by(n) for n in range(1, 6)] == expected


def test_rankings_of_several_candidates_go_through_the_loop(tmp_path: Path) -> None:
    loop = build("control/toy", tmp_path, "select.candidates=3")
    *_, last = loop.run()
    judgements = [j.judgement for j in loop.store.judged()]
    assert all(isinstance(j, Ranking) for j in judgements)
    assert last.metrics["fit/comparisons"] == 3 * len(judgements)


def test_a_reward_stays_as_it_is_while_nothing_new_is_said(tmp_path: Path) -> None:
    loop = build("control/toy", tmp_path, "loop.rounds=3", "loop.labels=8", "loop.first_share=1")
    rounds = list(loop.run())
    assert [round.fitted is not None for round in rounds] == [False, True, False, False]
    assert all("improve/steps" in round.metrics or "evaluate/learned" in round.metrics for round in rounds[1:])
    loop.store.ask(loop.store.open_queries())
    one = loop.store.judged()[0]
    loop.store.retract(one.query.id, loop.labeler.name)
    loop.settings = loop.settings.model_copy(update={"rounds": 4})
    assert [round.fitted is not None for round in loop.run()] == [True]


def test_a_warning_is_said_once(tmp_path: Path) -> None:
    class Constant:
        fitted, members = True, 1

        def score(self, candidates: Sequence[Any]) -> np.ndarray:
            return np.ones(len(candidates), np.float32)

    loop = build(
        "text/toy", tmp_path, "loop.labels=0", "loop.rounds=2", "learner.missing_end_penalty=0", "learner.beta=0"
    )
    loop.reward = Constant()  # type: ignore[assignment]  # as much of a reward model as a loop without labels reads
    loop._fit = lambda rng, pool: None  # type: ignore[method-assign]
    notes = [[note for note in round.notes if "is it constant?" in note] for round in loop.run()]
    assert [len(found) for found in notes] == [0, 1, 0]


@pytest.mark.parametrize(("setting", "expected"), [("1", 1), ("2", 2), ("null", None)])
def test_a_run_of_control_computes_with_the_threads_of_its_settings(
    setting: str, expected: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, seen = torch.get_num_threads(), []
    loop = build("control/toy", tmp_path, f"learner.threads={setting}", "loop.rounds=1")
    evaluate = loop.learner.evaluate

    def watched(*args: Any) -> Any:
        blas = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
        seen.append((torch.get_num_threads(), *blas))
        return evaluate(*args)

    monkeypatch.setattr(loop.learner, "evaluate", watched)
    list(loop.run())
    assert torch.get_num_threads() == before
    if expected is not None:
        assert len(seen) == 2
        assert {number for numbers in seen for number in numbers} == {expected}
