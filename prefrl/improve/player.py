"""What the learners of control share: behaviour that is cut into segments, evaluated, counted and saved."""

from __future__ import annotations

import numpy as np

from prefrl.evaluate.policies import evaluation, returns
from prefrl.improve.best import Best
from prefrl.policies.rollout import Act, Rollout, whole_episodes
from prefrl.protocols import ControlTask, RewardModel
from prefrl.sample.segments import cut, first_rollout, placed
from prefrl.types import Evaluation, Segment, State, Steps

NO_ZIP = (
    "a zip of stable-baselines3's PPO can only hold a policy of kind mlp, and this one is of kind {}: act with it "
    "through prefrl.load_policy"
)


class Player:
    """The last round's rollout, and how many steps were taken for what. `most` environments are stepped at once."""

    def __init__(self, task: ControlTask, most: int) -> None:
        self._task, self._most = task, most
        self._recent: Rollout | None = None
        self._evaluated: Rollout | None = None
        self.best = Best()
        self.rounds = 0
        self.steps = Steps()

    def sample(self, count: int, act: Act, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round's rollout; before the first round, of the starting policy (query steps)."""
        rollout = self._recent
        if rollout is None:
            rollout = first_rollout(self._task, act, count, self._most, rng)
            self.steps = self.steps.add(query=rollout.ends.size)
        return placed(self._task, cut(rollout, self._task.segment_steps, count, f"round {self.rounds}", rng))

    @property
    def moved(self) -> bool:
        """Whether there is a rollout to cut segments from."""
        return self._recent is not None

    def explored(self, rollout: Rollout) -> None:
        """This was done before the first round; the first segments are cut from it."""
        self._recent = rollout
        self.steps = self.steps.add(learn=rollout.ends.size)

    def learned_from(self, rollout: Rollout) -> None:
        """A round is over, in which this was done."""
        self._recent, self.rounds = rollout, self.rounds + 1
        self.steps = self.steps.add(learn=rollout.ends.size)

    def evaluate(
        self, episodes: int, act: Act, reward: RewardModel[Segment], rng: np.random.Generator
    ) -> Evaluation[Segment]:
        """So many episodes, each in a fresh environment."""
        rollout = whole_episodes(self._task, act, episodes, rng)
        self.steps = self.steps.add(evaluate=rollout.ends.size)
        self._evaluated = rollout
        return evaluation(self._task, rollout, reward)

    def settle(self, weights: State, reward: RewardModel[Segment], most_lost: float) -> Evaluation[Segment] | None:
        """Keep the policy that was evaluated last where it is the best one; where it lost clearly, how that one does.

        `weights` are that policy's, and not to change.
        """
        assert self._evaluated is not None
        undone = self.best.settle(self._evaluated, weights, self.rounds, reward, most_lost)
        if undone is None or self.best.rollout is None:
            return None
        found = evaluation(self._task, self.best.rollout, reward)
        note = (
            f"round {self.rounds} was undone: by the newest reward its episodes are worth {undone.after:.4g}, "
            f"and those of round {undone.round} {undone.before:.4g}; the policy of that round stands again"
        )
        gold = float(returns(self._evaluated, reward).gold.mean())
        metrics = found.metrics | {"undone_learned": undone.after, "undone_gold": gold}
        return Evaluation(metrics, found.examples, (note,), found.candidates)

    def state(self) -> State:
        recent = None if self._recent is None else self._recent.state()
        counted = {"steps": list(self.steps), "rounds": self.rounds}
        return {"recent": recent, "best": self.best.state()} | counted

    def load(self, state: State) -> None:
        self._recent = None if state["recent"] is None else Rollout(**state["recent"])
        self.steps, self.rounds = Steps(*state["steps"]), state["rounds"]
        self.best = Best.of(state["best"])
