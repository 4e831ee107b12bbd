"""A round that loses clearly by the newest reward is undone, and its policy is not the one that a run ends with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, Point, Watched, point

from prefrl import Config
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.loop import Loop
from prefrl.policies.mlp import MLPPolicy
from prefrl.protocols import RewardModel
from prefrl.rundir import Run, RunError
from prefrl.stages import evaluate, shrink
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.store import Store
from prefrl.types import Evaluation, Segment

SMALL: dict[str, Any] = {
    "environments": 4,
    "steps_per_round": 1600,
    "policy": {"hidden": (16,)},
    "evaluation_episodes": 5,
}
NEAR = Known(lambda o, a: 1.0 - np.abs(o[..., 0]))
"""What the task is about: a step is worth more the nearer to the origin."""
FAR = Known(lambda o, a: np.abs(o[..., 0]))


def built(**settings: object) -> ControlLearner:
    return ControlLearnerSettings.model_validate({**SMALL, **settings}).build(point(), np.random.default_rng(2))


def turn(learner: ControlLearner, reward: RewardModel[Segment], rounds: int = 1) -> Evaluation[Segment] | None:
    """Evaluate the policy as it is, and settle; afterwards so many rounds of learning, each with the same."""
    for number in range(rounds + 1):
        if number:
            learner.improve(reward, None, np.random.default_rng(number))  # type: ignore[arg-type]
        learner.evaluate(reward, np.random.default_rng(9))
        undone = learner.settle(reward)
    return undone


def ruin(learner: ControlLearner) -> None:
    """Push as hard as can be, whatever is seen."""
    assert isinstance(learner.policy, MLPPolicy)
    with torch.no_grad():
        learner.policy.named()["actor_3"].fill_(5.0)
        learner.policy.named()["actor_2"].fill_(0.0)


def weights(learner: ControlLearner) -> bytes:
    return b"".join(p.detach().numpy().tobytes() for p in learner.policy.parameters())


def best_of(learner: ControlLearner) -> bytes:
    learner.go_back()
    return weights(learner)


def test_a_policy_that_lost_clearly_goes_back_to_the_best_one() -> None:
    learner = built()
    assert turn(learner, NEAR, rounds=4) is None
    good = best_of(learner)
    moments = learner.state()["optimizer"]["state"][0]["exp_avg"].clone()
    ruin(learner)
    undone = turn(learner, NEAR, rounds=0)
    assert undone is not None
    assert weights(learner) == good
    assert torch.equal(learner.state()["optimizer"]["state"][0]["exp_avg"], moments)
    # The episodes of the policy that stands, worth what the newest reward says of them.
    assert undone.metrics["learned"] > 15 > undone.metrics["undone_learned"]
    assert undone.metrics["gold"] > undone.metrics["undone_gold"]
    assert undone.notes[0].startswith("round 4 was undone: by the newest reward its episodes are worth ")
    assert learner.steps.learn == 4 * 1600  # what was spent stays spent
    rate = learner.state()["optimizer"]["param_groups"][0]["lr"]
    ruin(learner)
    turn(learner, NEAR, rounds=0)
    assert learner.state()["optimizer"]["param_groups"][0]["lr"] == pytest.approx(0.3 * rate)


def test_nothing_is_undone_by_chance_by_little_or_against_the_newest_reward() -> None:
    learner = built()
    turn(learner, NEAR, rounds=4)
    with torch.no_grad():
        next(iter(learner.policy.parameters())).add_(1e-3)
    assert turn(learner, NEAR, rounds=0) is None
    ruin(learner)
    assert turn(learner, FAR, rounds=0) is None  # what was good by the old reward is worth little by the new one
    assert turn(learner, NEAR, rounds=0) is None  # and the best one is that one now


def test_what_may_be_lost_is_a_share_of_what_was_gained() -> None:
    for share, gone in ((0.1, True), (10.0, False)):
        learner = built(rollback=share)
        turn(learner, NEAR, rounds=4)
        ruin(learner)
        assert (turn(learner, NEAR, rounds=0) is not None) is gone
    learner = built(rollback=None)
    turn(learner, NEAR, rounds=4)
    ruin(learner)
    assert turn(learner, NEAR, rounds=0) is None


def test_gold_has_no_say_in_it() -> None:
    learner = built()
    spent: list[int] = []
    task = point()
    object.__setattr__(task, "make", lambda n: Watched(Vectorised(Point(), n, 20), n, spent, hide=True))
    learner = ControlLearnerSettings.model_validate(SMALL).build(task, np.random.default_rng(2))
    turn(learner, NEAR, rounds=4)
    good = best_of(learner)
    ruin(learner)
    assert turn(learner, NEAR, rounds=0) is not None
    assert weights(learner) == good


def test_a_saved_learner_still_knows_its_best_policy(tmp_path: Path) -> None:
    learner = built()
    turn(learner, NEAR, rounds=4)
    good = best_of(learner)
    ruin(learner)
    save_state(tmp_path, "learner", learner.state())
    other = built()
    other.load(load_state(tmp_path, "learner"))
    assert weights(other) != good
    assert turn(other, NEAR, rounds=0) is not None
    assert weights(other) == good


def test_the_best_policy_of_a_run_can_be_evaluated_beside_the_last_one(tmp_path: Path) -> None:
    with Run(Config.load("control/toy", ["loop.rounds=2", "loop.labels=8"]), tmp_path / "run") as run:
        list(run)
    last, after = evaluate(tmp_path / "run")
    best, of = evaluate(tmp_path / "run", best=True)
    assert after == 2
    assert 0 <= of <= 2
    assert best.metrics["learned"] >= last.metrics["learned"]


def test_stable_baselines3_has_a_best_policy_too(tmp_path: Path) -> None:
    changes = ["learner.kind=sb3", "learner.steps_per_round=128", "learner.rollback=0.1"]
    config = shrink(Config.load("control/toy", changes))
    with Run(config, tmp_path / "run") as run:
        list(run)
    best, of = evaluate(tmp_path / "run", best=True)
    assert of in (0, 1)
    assert best.metrics["learned"] >= evaluate(tmp_path / "run")[0].metrics["learned"]


def test_a_learner_that_keeps_none_has_no_best_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Run(shrink(Config.load("control/toy")), tmp_path / "run") as run:
        list(run)
    monkeypatch.setattr("prefrl.policies.saved.Settles", bytes)  # which no learner is
    with pytest.raises(RunError, match=r"learner \(ControlLearner\) keeps no best policy"):
        evaluate(tmp_path / "run", best=True)


def test_where_nothing_is_rolled_back_no_best_policy_is_passed_off(tmp_path: Path) -> None:
    with Run(shrink(Config.load("control/toy", ["learner.rollback=null"])), tmp_path / "run") as run:
        list(run)
    with pytest.raises(RunError, match=r"no best policy is kept .*learner\.rollback is null"):
        evaluate(tmp_path / "run", best=True)


class Ruined(ControlLearner):
    """Goes wrong in the last round."""

    def improve(self, *args: Any) -> Any:
        found = super().improve(*args)
        if self._player.rounds == 4:
            ruin(self)
        return found


def test_a_run_says_what_was_undone_and_ends_with_the_policy_that_stands(tmp_path: Path) -> None:
    config = Config.load("control/toy", ["loop.rounds=4", "loop.labels=8"])
    with Store[Any](tmp_path) as store:
        loop: Loop[Any] = config.build(store)
        loop.reward = NEAR
        loop.learner.__class__ = Ruined
        loop._fit = lambda rng, pool: None  # type: ignore[method-assign]
        rounds = list(loop.run())
    assert [round.number for round in rounds if any("was undone" in note for note in round.notes)] == [4]
    before = [round.metrics["evaluate/gold"] for round in rounds[:4]]
    assert rounds[4].metrics["evaluate/gold"] in before
    assert rounds[4].metrics["evaluate/undone_gold"] < min(before)


@pytest.mark.parametrize(
    ("schedule", "first", "last"), [("constant", 1.0, 1.0), ("linear", 1.0, 0.05), ("late", 1.0, 0.1)]
)
def test_the_learning_rate_falls_over_the_run(
    schedule: str, first: float, last: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, seen = built(schedule=schedule, target_kl=None, rollout_steps=200, epochs=1, critic_epochs=0), []
    group, step = learner._optimizer.param_groups[0], learner._optimizer.step

    def watched() -> None:
        seen.append(group["lr"])
        step()

    monkeypatch.setattr(learner._optimizer, "step", watched)
    for number in range(10):
        learner.pace(number / 10, (number + 1) / 10)
        learner.improve(NEAR, None, np.random.default_rng(number))  # type: ignore[arg-type]
    # Two rollouts a round: the last one begins when a twentieth of the run is left.
    assert seen[0] / 1e-3 == pytest.approx(first)
    assert seen[-1] / 1e-3 == pytest.approx(last)
    assert seen == sorted(seen, reverse=True)
    assert group["lr"] == 1e-3  # what the KL steers is as it was


def test_a_kl_that_is_small_because_the_rate_falls_does_not_raise_it() -> None:
    learner = built(schedule="linear", target_kl=0.01)
    learner.pace(0.98, 0.99)
    for number in range(4):
        learner.improve(NEAR, None, np.random.default_rng(number))  # type: ignore[arg-type]
    assert learner._optimizer.param_groups[0]["lr"] < 5e-3
