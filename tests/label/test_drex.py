"""D-REX: a policy's own episodes with more and more blind actions, and the pairs that are judged by their number."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from prefrl import stages
from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.control import ControlSettings
from prefrl.envs.experts import EXPERTS
from prefrl.judgements import Comparison
from prefrl.label.drex import Drex, DrexSettings
from prefrl.policies.acting import forgetful
from prefrl.protocols import ControlTask
from prefrl.rundir import Run
from prefrl.store import Store
from prefrl.types import Query, Segment

_, swing_up = EXPERTS["Pendulum-v1"]
SMALL = {"levels": 3, "episodes": 2, "pairs": 20}


@pytest.fixture(scope="module")
def pendulum() -> ControlTask:
    settings: dict[str, Any] = {"env": "Pendulum-v1", "horizon": 20, "segment_steps": 5}
    return cast("ControlTask", ControlSettings.model_validate(settings).build())


def drex(task: ControlTask, **settings: object) -> Drex:
    return DrexSettings.model_validate(SMALL | settings).build(task)


def _share(one: Segment) -> float:
    return float(one.episode.split("/")[1])


def test_of_each_pair_the_piece_with_fewer_blind_actions_is_better(pendulum: ControlTask, tmp_path: Path) -> None:
    with Store[Segment](tmp_path) as store:
        drex(pendulum).answer(store, np.random.default_rng(0))
        judged = store.judged()
    assert len(judged) == 20
    for one in judged:
        first, second = (_share(candidate) for candidate in one.query.candidates)
        assert {len(candidate) for candidate in one.query.candidates} == {5}
        assert abs(first - second) >= 0.25
        assert one.judgement.preference == float(first < second)  # type: ignore[union-attr]


def test_a_share_of_the_actions_is_drawn_and_the_executed_ones_are_kept(pendulum: ControlTask) -> None:
    played = drex(pendulum, episodes=20).play(np.repeat([0.0, 0.5, 1.0], 20), np.random.default_rng(0))
    own = np.array([[np.isclose(one.actions, swing_up(one.observations), atol=1e-4).mean() for one in played]])
    assert np.allclose(own.reshape(3, 20).mean(1), [1.0, 0.5, 0.0], atol=0.1)
    assert len({one.id for one in played}) == 60


def test_a_gap_leaves_out_pairs_that_are_nearly_alike(pendulum: ControlTask) -> None:
    queries = drex(pendulum, gap=1.0).drawn(np.random.default_rng(0))
    assert {tuple(sorted(map(_share, query.candidates))) for query in queries} == {(0.0, 1.0)}


def test_it_judges_once_and_a_round_that_was_killed_in_between_goes_on(pendulum: ControlTask, tmp_path: Path) -> None:
    who = drex(pendulum)
    with Store[Segment](tmp_path) as store:
        store.ask(who.drawn(np.random.default_rng(7)))
        for seed in (7, 8):
            who.answer(store, np.random.default_rng(seed))
        assert store.counts() == {"asked": 20, "answered": 20, "skipped": 0}


def test_what_others_ask_and_answer_stays_theirs(pendulum: ControlTask, tmp_path: Path) -> None:
    who = drex(pendulum, name="a/b")
    with Store[Segment](tmp_path) as store:
        pairs = [query.candidates for query in who.drawn(np.random.default_rng(0))[:2]]
        theirs = [Query(tuple(replace(one, episode="round 1/0/0") for one in pair)) for pair in pairs]
        store.ask(theirs)
        store.answer([Comparison(theirs[0].id, 1.0, "ann")])
        who.answer(store, np.random.default_rng(0))
        assert [query.id for query in store.open_queries()] == [theirs[1].id]
        assert [one.judgement.labeler for one in store.judged()] == ["ann", *["a/b"] * 20]


def test_of_several_tasks_each_is_played_with_every_share() -> None:
    task = cast("ControlTask", Config.load("control/pendulum-several").build_task())
    who = Drex(DrexSettings.model_validate(SMALL), task, forgetful(lambda seen: swing_up(seen[:, :3])))
    queries = who.drawn(np.random.default_rng(0))
    assert len({one.context for query in queries for one in query.candidates}) == 3


def test_an_improvement_by_a_given_reward_asks_nothing(tmp_path: Path) -> None:
    small = [
        "task.horizon=20",
        "task.segment_seconds=0.25",
        "labeler.pairs=20",
        "labeler.episodes=2",
        "fitting.epochs=1",
    ]
    config = Config.load("control/pendulum-drex", [*small, "loop.rounds=1", "learner.steps_per_round=160"])
    stages.label(config, tmp_path / "ranked")
    stages.fit_reward(config, tmp_path / "ranked", tmp_path / "reward")
    with Run(stages.with_reward(config, tmp_path / "reward"), tmp_path / "policy", tmp_path / "reward") as run:
        rounds = list(run)
    assert [round.fitted for round in rounds] == [None, None]
    assert rounds[-1].metrics["label/asked"] == 0


def test_what_cannot_be_done_is_refused_before_anything_is_played(pendulum: ControlTask, tmp_path: Path) -> None:
    config, refusal = Config.load("control/pendulum-drex", ["loop.labels=5"]), r"\(drex\) answers no question about the"
    with Store[Segment](tmp_path) as store, pytest.raises(ConfigError, match=refusal):
        config.build(store)
    unbounded = replace(pendulum, action_bounds=(np.full(1, -np.inf), np.full(1, np.inf)))  # type: ignore[type-var]
    with pytest.raises(ConfigError, match="draws actions within their bounds, and Pendulum-v1 has none"):
        drex(unbounded)
