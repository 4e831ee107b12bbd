"""An expert: whole episodes once, then the right actions in the learner's states; noise is executed, not shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from corridor import corridor

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.control import ControlSettings
from prefrl.envs.experts import EXPERTS
from prefrl.envs.toys import ForkSettings
from prefrl.improve.clone import CloneSettings
from prefrl.judgements import Comparison, Demonstration
from prefrl.label.demonstrator import DemonstratorSettings
from prefrl.label.expert import Expert, ExpertSettings, _disturbed, play
from prefrl.policies.acting import forgetful
from prefrl.protocols import ControlTask
from prefrl.rundir import Run
from prefrl.store import Store
from prefrl.types import Query, Segment

_, swing_up = EXPERTS["Pendulum-v1"]
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
        assert store.counts() == {"asked": 3, "answered": 3, "skipped": 0, "demonstrations": 3}


def test_an_expert_who_goes_one_way_or_another_keeps_to_it_for_an_episode(tmp_path: Path) -> None:
    with Store[Segment](tmp_path) as store:
        expert(ForkSettings().build(), episodes=12).answer(store, np.random.default_rng(0))
        shown = [one.like for one in store.demonstrations()]
        assert [float(gold.sum()) for gold in store.gold(shown)] == [1.0] * 12
    sides = [np.sign(one.observations[10:25, 0]) for one in shown]
    assert all((side == side[0]).all() for side in sides)
    assert 3 <= sum(side[0] > 0 for side in sides) <= 9


def test_the_learners_states_are_answered_with_the_experts_actions(pendulum: ControlTask, tmp_path: Path) -> None:
    own = some()
    with Store[Segment](tmp_path) as store:
        store.ask([Query((own,))])
        expert(pendulum, episodes=0).answer(store, np.random.default_rng(0))
        (one,) = store.demonstrations()
        assert store.open_queries() == []
    np.testing.assert_array_equal(one.like.observations, own.observations)
    np.testing.assert_array_equal(one.like.actions, swing_up(own.observations))
    assert (one.like.episode, one.like.start) == (own.episode, own.start)


def test_noise_is_executed_and_the_clean_actions_are_shown(pendulum: ControlTask) -> None:
    noisy = play(pendulum, forgetful(swing_up), 2, np.random.default_rng(0), ExpertSettings(noise=0.5))
    clean = play(pendulum, forgetful(swing_up), 2, np.random.default_rng(0), ExpertSettings())
    for one, other in zip(noisy, clean, strict=True):
        # To the rounding of observations that went through a batch of another shape.
        np.testing.assert_allclose(one.actions, swing_up(one.observations), atol=1e-6)
        assert not np.allclose(one.observations[-1], other.observations[-1], atol=0.01)
        np.testing.assert_array_equal(one.observations[0], other.observations[0])


def test_a_round_that_was_killed_while_showing_shows_the_same_again(pendulum: ControlTask, tmp_path: Path) -> None:
    who = expert(pendulum, episodes=2)
    with Store[Segment](tmp_path) as store:
        played = play(pendulum, who.actor, 2, np.random.default_rng(7), who.settings)
        store.ask([Query((one,)) for one in played])
        who.answer(store, np.random.default_rng(7))
        assert len(store.demonstrations()) == 2
        assert store.counts()["asked"] == 2


def test_episodes_that_others_have_shown_are_topped_up_with_its_own(pendulum: ControlTask, tmp_path: Path) -> None:
    with Store[Segment](recorded(tmp_path)) as store:  # two of another origin
        expert(pendulum, episodes=1).answer(store, np.random.default_rng(0))
        expert(pendulum, episodes=3).answer(store, np.random.default_rng(1))
        own = [one.like for one in store.demonstrations() if one.like.episode.startswith("expert/")]
        assert len(own) == 3


def test_a_correction_carries_no_gold_and_is_no_episode(pendulum: ControlTask, tmp_path: Path) -> None:
    own = some()
    right = replace(own, actions=swing_up(own.observations))  # the learner did what the expert would have done
    with Store[Segment](tmp_path) as store:
        store.ask([Query((right,))])
        expert(pendulum, episodes=0).answer(store, np.random.default_rng(0))
        expert(pendulum, episodes=1).answer(store, np.random.default_rng(0))
        corrected, shown = store.demonstrations()
        assert not (tmp_path / "gold" / corrected.like.id).exists()
    assert expert(pendulum)._corrected(Query((own,))).gold is None
    assert (corrected.like.id, len(shown.like)) == (right.id, 20)


@pytest.mark.parametrize("discrete", [False, True])
def test_noise_is_as_wide_as_was_said(discrete: bool) -> None:
    name = "CartPole-v1" if discrete else "Pendulum-v1"
    task = cast("ControlTask", ControlSettings.model_validate({"env": name}).build())
    clean = np.tile(np.eye(2, dtype=np.float32)[:1], (40_000, 1)) if discrete else np.zeros((40_000, 1), np.float32)
    noisy = _disturbed(clean, task, 0.25, np.random.default_rng(0), None)
    if discrete:  # of a quarter that is drawn anew, half comes out as it was
        assert (noisy != clean).any(1).mean() == pytest.approx(0.125, abs=0.01)
    else:
        assert noisy.std() == pytest.approx(0.25 * 2.0, rel=0.02)


def test_noise_keeps_to_what_is_legal() -> None:
    legal = np.array([[True, False, True], [False, True, False]]).repeat(2_000, 0)
    clean = np.eye(3, dtype=np.float32)[legal.argmax(1)]
    noisy = _disturbed(clean, corridor(), 1.0, np.random.default_rng(0), legal)
    assert not noisy[~legal].any()
    assert noisy.sum(1).tolist() == [1.0] * 4_000
    assert noisy[:2_000].mean(0) == pytest.approx([0.5, 0.0, 0.5], abs=0.05)


def test_noise_of_discrete_actions_is_a_share() -> None:
    task = ControlSettings.model_validate({"env": "CartPole-v1"}).build()
    with pytest.raises(ConfigError, match=r"labeler\.noise: of discrete actions it is a share"):
        expert(cast("ControlTask", task), noise=2.0)


def test_the_known_expert_wants_the_whole_observation() -> None:
    task = ControlSettings.model_validate(SHORT | {"hide": [2]}).build()
    with pytest.raises(ConfigError, match=r"sees all 3 numbers of an observation, and here there are 2"):
        expert(cast("ControlTask", task))


def test_an_experts_zip_acts_as_it_does_and_a_run_of_another_task_is_refused(
    pendulum: ControlTask, finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    learner = CloneSettings(hidden=(8,), std=0.3).build(cast(Any, pendulum), np.random.default_rng(0))
    learner.policy.observe(np.random.default_rng(0).normal(0.5, 2.0, (50, 3)))
    learner.save(tmp_path / "expert.zip")
    seen = some().observations
    advice = expert(pendulum, policy=tmp_path / "expert.zip").advice
    np.testing.assert_allclose(advice(seen), learner.actor()(seen, None, None)[0], atol=1e-5)
    with pytest.raises(ConfigError, match=r"labeler\.policy: expected an expert for Pendulum-v1, and .* is a run of"):
        expert(pendulum, policy=finished_tiny["control/toy"])


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
    with pytest.raises(ConfigError, match="no expert is known for CartPole-v1, only for Pendulum-v1, fork: name a run"):
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


def recorded(folder: Path, count: int = 2, steps: int = 8) -> Path:
    """A folder in which whole episodes were shown."""
    with Store[Segment](folder) as store:
        for i in range(count):
            seen = np.full((steps, 3), float(i), np.float32) + np.arange(steps, dtype=np.float32)[:, None] / 100
            one = Segment(seen, np.full((steps, 1), float(i), np.float32), f"shown {i}", 0)
            query = Query((one,))
            store.ask([query])
            store.answer([Demonstration(query.id, one.id, "expert")])
    return folder


def test_a_demonstrator_answers_with_pieces_of_what_was_shown(pendulum: ControlTask, tmp_path: Path) -> None:
    settings = DemonstratorSettings(data=recorded(tmp_path / "shown"))
    with Store[Segment](tmp_path / "own") as store:
        store.ask([Query((some(i),)) for i in range(40)])
        settings.build(pendulum).answer(store, np.random.default_rng(0))
        found = store.demonstrations()
        assert store.open_queries() == []
    assert all(len(one.like) == 5 for one in found)
    # Of two episodes of 8 steps there are 4 pieces each of 5 steps, and all of them turn up.
    assert {(one.like.episode, one.like.start) for one in found} == {
        (f"shown {i}", t) for i in range(2) for t in range(4)
    }
    for one in found:
        np.testing.assert_allclose(one.like.observations[0, 0], float(one.like.episode[-1]) + one.like.start / 100)


def test_a_demonstrator_without_a_file_lets_an_expert_show_episodes_and_answers_with_their_pieces(
    pendulum: ControlTask, tmp_path: Path
) -> None:
    with Store[Segment](tmp_path) as store:
        labeler = DemonstratorSettings(expert=ExpertSettings(episodes=2)).build(pendulum)
        labeler.answer(store, np.random.default_rng(0))
        whole = [one.like for one in store.demonstrations()]
        store.ask([Query((some(),))])
        labeler.answer(store, np.random.default_rng(0))
        (answer,) = store.demonstrations()[2:]
    assert [len(one) for one in whole] == [20, 20]
    (origin,) = (one for one in whole if one.episode == answer.like.episode)
    place = slice(answer.like.start, answer.like.start + 5)
    np.testing.assert_array_equal(answer.like.actions, origin.actions[place])


def test_a_run_whose_reward_is_fitted_on_what_was_shown_alone_ends_and_can_be_taken_up(tmp_path: Path) -> None:
    """There is no judgement to score a refit by."""
    small = ["task.horizon=20", "learner.environments=2", "learner.steps_per_round=40", "learner.evaluation_episodes=1"]
    rounds = ["loop.rounds=2", "loop.labels=8", "loop.first_share=0.5", "learner.clone.epochs=1"]
    with Run(Config.load("control/pendulum-adversarial", small + rounds), tmp_path) as run:
        found = list(run)
    assert found[-1].metrics["fit/shown"] == 8
    assert "improve/shown_loss" in found[-1].metrics
    with Run.resume(tmp_path) as again:
        assert list(again) == []


def test_a_demonstrator_that_was_shown_nothing_says_so(pendulum: ControlTask, tmp_path: Path) -> None:
    with Store[Segment](tmp_path) as store:
        store.ask([Query((some(),))])
        labeler = DemonstratorSettings(expert=ExpertSettings(episodes=0)).build(pendulum)
        with pytest.raises(ValueError, match=r"5 steps of what was shown, and there are none: set labeler\.data"):
            labeler.answer(store, np.random.default_rng(0))


def test_demonstrations_that_are_too_short_or_of_other_sizes_are_refused(pendulum: ControlTask, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"labeler\.data: no demonstration of .* has task\.segment_steps=5 steps"):
        DemonstratorSettings(data=recorded(tmp_path / "short", steps=4)).build(pendulum)
    cartpole = cast("ControlTask", ControlSettings.model_validate({"env": "CartPole-v1"}).build())
    with pytest.raises(ConfigError, match=r"labeler\.data: the demonstration 'shown 0' .* but CartPole-v1 has"):
        DemonstratorSettings(data=recorded(tmp_path / "other")).build(cartpole)
    with pytest.raises(ConfigError, match=r"labeler\.data: the demonstration 'shown 3' .* outside of the bounds"):
        DemonstratorSettings(data=recorded(tmp_path / "far", count=4)).build(pendulum)
    with pytest.raises(ConfigError, match=r"labeler\.data: .*expected an \.npz"):
        DemonstratorSettings(data=tmp_path / "nothing").build(pendulum)
