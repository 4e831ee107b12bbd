"""An expert: whole episodes once, then the right actions in the learner's states; noise is executed, not shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.control import ControlSettings
from prefrl.envs.experts import EXPERTS
from prefrl.judgements import Comparison
from prefrl.label.expert import Expert, ExpertSettings, play
from prefrl.protocols import ControlTask
from prefrl.store import Store
from prefrl.types import Query, Segment

SHORT: dict[str, Any] = {"env": "Pendulum-v1", "horizon": 20, "segment_steps": 5}


@pytest.fixture(scope="module")
def pendulum() -> ControlTask:
    return cast("ControlTask", ControlSettings.model_validate(SHORT).build())


def expert(task: ControlTask, **settings: object) -> Expert:
    return ExpertSettings.model_validate(settings).build(task)


def some(seed: int = 0) -> Segment:
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-3, 3, 5)
    seen = np.stack([np.cos(angles), np.sin(angles), rng.uniform(-1, 1, 5)], 1).astype(np.float32)
    return Segment(seen, np.zeros((5, 1), np.float32), f"own {seed}", 0, np.zeros((5, 2)), np.zeros(5))


def test_whole_episodes_are_shown_once_and_stand_for_themselves(pendulum: ControlTask, tmp_path: Path) -> None:
    with Store[Segment](tmp_path) as store:
        for _ in range(2):  # a second round shows nothing new
            expert(pendulum, episodes=3).answer(store, np.random.default_rng(0))
        shown = store.demonstrations()
        assert [len(one.like) for one in shown] == [20, 20, 20]
        assert all(one.like.id == one.query.candidates[0].id for one in shown)
        assert store.counts() == {"asked": 3, "answered": 3, "skipped": 0}


def test_the_learners_states_are_answered_with_the_experts_actions(pendulum: ControlTask, tmp_path: Path) -> None:
    own = some()
    with Store[Segment](tmp_path) as store:
        store.ask([Query((own,))])
        expert(pendulum, episodes=0).answer(store, np.random.default_rng(0))
        (one,) = store.demonstrations()
        assert store.open_queries() == []
    np.testing.assert_array_equal(one.like.observations, own.observations)
    np.testing.assert_array_equal(one.like.actions, EXPERTS["Pendulum-v1"](own.observations))
    assert (one.like.episode, one.like.start) == (own.episode, own.start)


def test_noise_is_executed_and_the_clean_actions_are_shown(pendulum: ControlTask) -> None:
    noisy = play(pendulum, EXPERTS["Pendulum-v1"], ExpertSettings(episodes=2, noise=0.5), np.random.default_rng(0))
    clean = play(pendulum, EXPERTS["Pendulum-v1"], ExpertSettings(episodes=2), np.random.default_rng(0))
    for one, other in zip(noisy, clean, strict=True):
        # To the rounding of observations that went through a batch of another shape.
        np.testing.assert_allclose(one.actions, EXPERTS["Pendulum-v1"](one.observations), atol=1e-6)
        assert not np.allclose(one.observations[-1], other.observations[-1], atol=0.01)
        np.testing.assert_array_equal(one.observations[0], other.observations[0])


def test_a_round_that_was_killed_while_showing_shows_the_same_again(pendulum: ControlTask, tmp_path: Path) -> None:
    who = expert(pendulum, episodes=2)
    with Store[Segment](tmp_path) as store:
        store.ask([Query((one,)) for one in play(pendulum, who.advice, who.settings, np.random.default_rng(7))])
        who.answer(store, np.random.default_rng(7))
        assert len(store.demonstrations()) == 2
        assert store.counts()["asked"] == 2


def test_what_compares_is_for_other_labelers(pendulum: ControlTask, tmp_path: Path) -> None:
    with Store[Segment](tmp_path) as store:
        store.ask([Query((some(0), some(1)))])
        with pytest.raises(ValueError, match=r"select\.candidates=1"):
            expert(pendulum, episodes=0).answer(store, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (
            ["select.candidates=2"],
            "select.candidates=2, but the labeler (expert) shows what to do in the states of one",
        ),
        (["labeler.kind=oracle"], "select.candidates=1, but the labeler (oracle) compares two or more"),
        (["learner.kind=control"], "learner.kind=control learns nothing from demonstrations"),
    ],
)
def test_how_many_are_asked_about_must_fit_the_labeler(tmp_path: Path, settings: list[str], says: str) -> None:
    config = Config.load("control/pendulum-dagger", settings)
    with Store[Segment](tmp_path) as store, pytest.raises(ConfigError) as error:
        config.build(store)
    assert says in str(error.value)


def test_a_task_without_an_expert_asks_for_a_policy() -> None:
    task = ControlSettings.model_validate({"env": "CartPole-v1"}).build()
    with pytest.raises(ConfigError, match="no expert is known for CartPole-v1, only for Pendulum-v1: name a run"):
        expert(cast("ControlTask", task))


def test_a_policy_that_is_not_there_is_said_by_the_settings_name(pendulum: ControlTask) -> None:
    with pytest.raises(ConfigError, match=r"labeler\.policy: there is no nowhere"):
        expert(pendulum, policy="nowhere")


def test_two_words_of_two_labelers_on_one_query_stand_side_by_side(pendulum: ControlTask, tmp_path: Path) -> None:
    first, second = some(0), some(1)
    with Store[Segment](tmp_path) as store:
        store.ask([Query((first, second)), Query((first,))])
        store.answer([Comparison(Query((first, second)).id, 1.0, "ann")])
        expert(pendulum, episodes=0).answer(store, np.random.default_rng(0))
        assert (len(store.judged()), len(store.demonstrations())) == (1, 1)
