"""What learners with a learned world share: real episodes, which are asked about, and which the world learns from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from prefrl.components import ConfigError
from prefrl.envs.imagined import Branches, Dream
from prefrl.envs.learned import Transitions, World, WorldSettings
from prefrl.policies.divided import environments
from prefrl.policies.rollout import Act, Rollout, collect, learned_rewards, step_rewards, whole_episodes
from prefrl.protocols import ControlTask, Retells, RewardModel
from prefrl.sample.segments import cut, first_rollout, placed, windows
from prefrl.types import Floats, Metrics, Segment, State

PLAYS = 4
"""So many rounds' real episodes are kept to be asked about."""
AWAKE = (
    "the learned world cannot be trusted: its error in a held-out step ({error:.3g} standard deviations of an "
    "observation, {held_out:.0%} of the variance of the changes) leaves no step to imagine; the run has stopped "
    "dreaming, and its policy stays as it is until the world is better: raise learner.episodes, so that it sees more, "
    "or learner.world.tolerance"
)
REAL = (
    "{real} of {count} segments to ask about are real ones: the learned world cannot be followed for the {steps} steps "
    "of a segment, or not often enough; make task.segment_seconds (or segment_steps) smaller, raise learner.episodes, "
    "so that the world sees more, or learner.world.longest (now {longest})"
)
PASSES = 4
"""So often branches are imagined for segments to ask about, in place of those that were cut short."""
UNTESTED = (
    "the learned world cannot be trusted: no held-out step says how good it is, since too little has moved in the real "
    "episodes so far, or since its fit has diverged; the run has stopped dreaming, and its policy stays as it is until "
    "there is one: raise learner.episodes, so that the world sees more, or lower learner.world.learning_rate"
)


def all_legal(task: ControlTask) -> None:
    """Raises `ConfigError` where not all actions are always legal."""
    if task.action_bounds is not None:
        return
    envs = environments(task, 1)
    envs.reset(np.random.default_rng(0))
    if envs.legal() is not None:
        raise ConfigError(
            f"a learned world does not know which actions are legal, and in {task.name} not all of them always are: "
            "use learner.kind=control"
        )


class Grounded:
    """A world, and the real steps that it is learned from. `spent` counts them, and `dreamt` what it imagines here."""

    def __init__(
        self, settings: WorldSettings, task: ControlTask, device: torch.device, rng: np.random.Generator
    ) -> None:
        """Raises `ConfigError` where not all actions are always legal."""
        all_legal(task)
        self._task = task
        self.world = World(settings, (task.observation_size, task.action_size), device, rng)
        self.data: Transitions | None = None
        self.fresh = False
        """Whether the newest real episodes were not learned from yet."""
        self.spent, self.dreamt = 0, 0
        self._notes: dict[str, str] = {}
        self._plays: list[Rollout] = []
        """The newest real episodes, oldest first."""
        self._played = 0

    @property
    def begun(self) -> bool:
        """Whether anything was played."""
        return self._played > 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What people should know of the last fit, and of the last segments that were imagined."""
        return tuple(self._notes.values())

    def begin(self, count: int, act: Act, most: int, rng: np.random.Generator) -> None:
        """Play as many episodes, of at most `most` environments, as hold so many segments."""
        self._keep(first_rollout(self._task, act, count, most, rng), rng)

    def play(self, episodes: int, act: Act, rng: np.random.Generator) -> None:
        self._keep(whole_episodes(self._task, act, episodes, rng), rng)

    def segments(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the newest play, oldest first; where it holds fewer, the others are of the plays before.

        Raises ValueError where there are none of that either.
        """
        length, found = self._task.segment_steps, list[Segment]()
        if (there := self._held()) < count:
            raise ValueError(
                f"the last {len(self._plays)} plays hold {there} segments of {length} steps within one episode, but "
                f"{count} were asked for; lower loop.pool or the segment length, or raise learner.episodes"
            )
        for back, rollout in enumerate(reversed(self._plays)):
            held = len(windows(rollout, length)[0])
            name = f"play {self._played - back}"
            found = cut(rollout, length, min(held, count - len(found)), name, rng) + found
            if len(found) == count:
                break
        return placed(self._task, found)

    def learn(self, rng: np.random.Generator) -> Metrics:
        """Fit the world on all real steps; the metrics are `World.fit`'s. A note says where it cannot be trusted."""
        assert self.data is not None
        metrics, world = self.world.fit(self.data, rng), self.world
        note = AWAKE.format(error=world.error, held_out=world.held_out) if world.fitted else UNTESTED
        self.fresh = False
        self._note("world", "" if world.reach else note)
        return metrics

    def imagine(self, count: int, episodes: int, act: Act, rng: np.random.Generator) -> list[Segment]:
        """Segments of as many imagined branches from real states, as they would look and with their gold.

        So many episodes are played first where none ever were. Each segment is whole: its branch was not cut where
        members part. Where too few are, real ones (`segments`) stand in, and a note says so.
        """
        if not self.begun:
            self.play(episodes, act, rng)
        if self.fresh:
            self.learn(rng)
        assert self.data is not None
        assert isinstance(self._task, Retells)
        length, found = self._task.segment_steps, list[Segment]()
        for _ in range(PASSES if self.world.reach >= length else 0):
            branches = Branches(Dream(self.world, self.data.starts), count - len(found))
            rollout, _ = collect(branches, branches.reset(rng), length, act)
            self.dreamt += rollout.ends.size
            whole = len(windows(rollout, length)[0])
            found += cut(rollout, length, whole, f"imagined {self.dreamt}", rng)
            if len(found) == count:
                break
        real = count - len(found)
        numbers = {"count": count, "steps": length, "longest": self.world.settings.longest}
        self._note("asked", REAL.format(real=real, **numbers) if real else "")
        if real > self._held():
            self.begin(real, act, len(self._plays[-1].ends), rng)
        return [_retold(self._task, one) for one in found] + (self.segments(real, rng) if real else [])

    def imagined_returns(
        self, starts: Floats, act: Act, reward: RewardModel[Segment], rng: np.random.Generator
    ) -> Floats:
        """Learned returns (n,) of whole imagined episodes from these starts (n, O)."""
        branches = Branches(Dream(self.world, starts), len(starts), self._task.horizon)
        rollout, _ = collect(branches, branches.reset(rng), self._task.horizon, act)
        going = rollout.ends.cumsum(1) - rollout.ends == 0  # up to the first end, which counts
        worth: Floats = np.where(going, learned_rewards(step_rewards(reward), rollout), 0.0).sum(1)
        self.dreamt += rollout.ends.size
        return worth

    def state(self) -> State:
        data = None if self.data is None else self.data.state()
        counted = {"spent": self.spent, "dreamt": self.dreamt, "played": self._played}
        told = {"fresh": self.fresh, "notes": dict(self._notes)}
        return (
            counted | told | {"data": data, "plays": [one.state() for one in self._plays], "world": self.world.state()}
        )

    def load(self, state: State) -> None:
        self.data = None if state["data"] is None else Transitions(**state["data"])
        self.spent, self.dreamt, self._played = state["spent"], state["dreamt"], state["played"]
        self.fresh, self._notes = state["fresh"], dict(state["notes"])
        self._plays = [Rollout(**one) for one in state["plays"]]
        self.world.load(state["world"])

    def _held(self) -> int:
        """How many segments the last plays hold."""
        return sum(len(windows(rollout, self._task.segment_steps)[0]) for rollout in self._plays)

    def _note(self, of: str, text: str) -> None:
        self._notes = {name: told for name, told in self._notes.items() if name != of} | ({of: text} if text else {})

    def _keep(self, rollout: Rollout, rng: np.random.Generator) -> None:
        new = Transitions.of(rollout, self.world.settings.held_out, rng, self.data)
        self.data = new if self.data is None else self.data.joined(new)
        self.fresh, self.spent = True, self.spent + rollout.ends.size
        self._plays, self._played = [*self._plays, rollout][-PLAYS:], self._played + 1


def _retold(task: Retells, one: Segment) -> Segment:
    assert task.retell is not None
    return replace(one, **task.retell(one.observations, one.actions)._asdict())


__all__ = ["Grounded", "all_legal"]
