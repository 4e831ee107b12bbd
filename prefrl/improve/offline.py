"""What the learners from recorded segments share: the steps of segments, cloning, and a learner around both.

Nothing is acted out to learn from. Where the task's simulator is there it serves evaluation, and where no file is
given, sampling. The policy starts as a clone of all segments (behaviour cloning by maximum likelihood), and its
observation normaliser is that of the segments it was cloned from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeAlias, cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import TypeVar

from prefrl.components import ConfigError, Settings
from prefrl.exchange.recordings import check_imitable, recorded, recording
from prefrl.fit.pairs import Batch, batch
from prefrl.fit.split import split
from prefrl.improve.gradient import adam, descend_by_logp
from prefrl.improve.pairs import measured, shuffled
from prefrl.improve.player import NO_ZIP, Player
from prefrl.improve.shown import Passes, Shown, clone, steps_of
from prefrl.kinds import kind_of
from prefrl.policies.acting import Acting, Actor, Clonable, Decisions, Memory
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.policies.rollout import Act
from prefrl.protocols import ControlTask, Recorded, RewardModel, Store
from prefrl.sample.segments import piece
from prefrl.seeding import Device, device_of
from prefrl.types import Evaluation, Floats, Integers, Metrics, Segment, State, Steps

AT_ONCE = 8
"""Environments that are stepped side by side, where there are any."""


class OfflineSettings(Settings):
    """The settings that all these learners have; each one's class adds its kind and what is particular to it."""

    kind: str
    imitates: ClassVar[bool] = False
    """Whether it learns from what is shown alone, in every round, and needs no judgement."""
    data: Path | None = None
    """Behaviour to learn from beside what was judged or shown: an .npz file of segments, a Minari data set, or a folder
    of demonstrations. What is asked about is cut from it as well, but by `clone`, which asks about its own. A task of
    kind `segments` has a file already."""
    learning_rate: float = Field(1e-3, gt=0)
    """Adam's."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    cloning_epochs: int = Field(20, ge=0)
    """Passes over all segments before anything else is learned, in the first round."""
    cloning_minibatch: int = Field(256, ge=1)
    """Steps in a gradient step of cloning."""
    held_out: float = Field(0.1, ge=0, lt=1)
    """The share of judgements that is not learned from, and that the policy is then measured on."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    std: float = Field(0.7, gt=0)
    """Of the actions' noise, in units of half the action bounds. It is not learned."""
    evaluation_episodes: int = Field(20, ge=1)
    """Episodes of an evaluation, with the policy's mode, where the simulator is there."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute: more make small networks slower; null leaves it to them."""

    def shrunk(self) -> Self:
        return self.model_copy(update={"cloning_epochs": min(self.cloning_epochs, 1), "evaluation_episodes": 1})

    def with_evaluation_of(self, other: Self) -> Self:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})


@dataclass(frozen=True, eq=False)
class Recordings:
    """S steps of N segments, one after another."""

    decisions: Decisions
    starts: Integers
    """(N,) the row of each segment's first step."""
    lengths: Integers
    """(N,)."""

    @classmethod
    def of(cls, segments: Sequence[Segment], policy: MLPPolicy) -> Recordings:
        lengths = np.array([len(one) for one in segments])
        return cls(policy.examples(segments), np.cumsum(lengths) - lengths, lengths)

    def steps(self, at: Integers) -> tuple[Integers, Integers, Integers]:
        """Of some segments: the rows of their steps, whose each is among those, and how many came before it."""
        lengths = self.lengths[at]
        whose = np.repeat(np.arange(len(at)), lengths)
        before = np.arange(len(whose)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        return self.starts[at][whose] + before, whose, before


class Material(NamedTuple):
    """What a round learns from, nothing held out among it."""

    pairs: Batch[Segment]
    segments: tuple[Segment, ...]
    """Judged ones and those of the file."""


P = TypeVar("P", bound=Clonable[Any], default=MLPPolicy)
Improve: TypeAlias = Callable[["Offline[Any]", Material, RewardModel[Segment], np.random.Generator], Metrics]
"""One round's worth of learning, after cloning."""


class Offline(Generic[P]):
    """A `prefrl.protocols.Learner` of segments that takes no step to learn; methods differ in how they improve alone.

    `discount` and `alpha` make a score of a segment's log-probabilities, which held-out judgements are compared with;
    without an alpha only its sign counts.
    """

    def __init__(
        self,
        settings: OfflineSettings,
        task: ControlTask,
        improve: Improve,
        policy: P,
        discount: float = 1.0,
        alpha: float | None = None,
    ) -> None:
        self._settings, self._task, self._improve = settings, task, improve
        self._discount, self.alpha = discount, alpha
        self.policy = policy
        self.policy.to(device_of(settings.device))
        self.optimizer = adam(self.policy.parameters(), settings.learning_rate)
        self._player, self._measured = Player(task, AT_ONCE), Metrics()
        self._data = _data(settings.data, task, settings.imitates)
        self._seen = 0

    def imitates(self, store: Store[Segment]) -> bool:
        return self._settings.imitates and bool(self._data or store.demonstrations())

    def check_shown(self, shows: bool, judged: bool) -> None:
        if not (self._data or shows or (judged and not self._settings.imitates)):
            raise ConfigError(_nothing(self._settings))

    @property
    def steps(self) -> Steps:
        return self._player.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Pieces of the file, as many as it has; without one, or to be shown what to do, of what the policy does (query
        steps)."""
        if not self._data or (self._settings.imitates and not isinstance(self._task, Recorded)):
            return self._player.sample(count, self._act(rng), rng)
        length = self._task.segment_steps
        places = [(i, t) for i, one in enumerate(self._data) for t in range(len(one) - length + 1)]
        chosen = rng.choice(len(places), min(count, len(places)), replace=False)
        return [piece(self._data[i], t, length) for i, t in (places[c] for c in sorted(chosen))]

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """Clone in the first round, and learn by the method. Metrics: the method's, and cloning_loss where it cloned
        (mean over the last pass of the squared distance to a recorded action over twice its variance; of -log pi where
        actions are discrete or the std is learned; of the flow-matching loss where the policy is a flow).

        Raises ValueError where there is nothing to learn from.
        """
        judged = store.judged() if store is not None else []
        out = split(judged, self._settings.held_out) if judged else np.zeros(0, bool)
        held = batch([one for one, left in zip(judged, out, strict=True) if left])
        kept = batch([one for one, left in zip(judged, out, strict=True) if not left])
        apart = {one.id for one in held.candidates}
        demonstrations = store.demonstrations() if store is not None else []
        shown = [one.like for one in demonstrations]
        # What came first stands first: the normaliser sees what is new at the end.
        known = (*self._data, *shown) if self._settings.imitates else (*kept.candidates, *shown, *self._data)
        every = {one.id: one for one in known if one.id not in apart}
        if not every:
            raise ValueError(_nothing(self._settings))
        material = Material(kept, tuple(every.values()))
        weights = {one.like.id: one.demonstration.weight for one in demonstrations}
        metrics = self._clone(material.segments, weights, rng) | self._improve(self, material, reward, rng)
        self._player.rounds += 1
        # Scores are of single steps, and a flow's are no log-probabilities: of others than an mlp nothing is said.
        plain = isinstance(self.policy, MLPPolicy) and len(held)
        self._measured = _agreement(cast(Offline[MLPPolicy], self), held) if plain else {}
        return metrics

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in fresh environments, where there are any, and what was measured on held-out judgements:
        agreement, and judgement_loss where scores have a scale."""
        if isinstance(self._task, Recorded):
            return Evaluation({"gold": float("nan")} | self._measured)
        found = self._player.evaluate(self._settings.evaluation_episodes, self._act(None), reward, rng)
        return replace(found, metrics=found.metrics | self._measured)

    def scores(self: Offline[MLPPolicy], logp: Tensor, whose: Integers, before: Integers) -> Tensor:
        """(S, 1) log-probabilities of segments' steps -> (N,) their discounted sums, each step's against the mode's.

        A density has no scale of its own; against the mode's it is a distance, as in the paper's code.
        """
        weights = torch.from_numpy((self._discount**before).astype(np.float32)).to(logp)
        owners = torch.from_numpy(whose).to(logp.device)
        return logp.new_zeros(int(whose[-1]) + 1).index_add(0, owners, weights * (logp[:, 0] - self.policy.peak))

    def actor(self) -> Actor:
        decide = self.policy.decide()

        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            _, actions, memory = decide(observations, rng, None, memory)
            return actions, memory

        return act

    def save(self, path: Path) -> None:
        """As a zip of stable-baselines3's PPO, which acts as this policy does. Raises ConfigError for others than an
        mlp, of which it has none."""
        if not isinstance(self.policy, MLPPolicy):
            raise ConfigError(NO_ZIP.format(self.policy.settings.kind))
        from prefrl.improve.to_sb3 import save_ppo  # stable-baselines3 takes a second to load

        save_ppo(self.policy, self._task, path)

    def state(self) -> State:
        learned = {"policy": self.policy.state(), "optimizer": self.optimizer.state_dict()}
        return learned | {"measured": self._measured, "seen": self._seen} | self._player.state()

    def load(self, state: State) -> None:
        self.policy.load(state["policy"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._measured, self._seen = state["measured"], state.get("seen", 0)  # runs from before it was counted
        self._player.load(state)

    def _clone(self, segments: Sequence[Segment], weights: dict[str, float], rng: np.random.Generator) -> Metrics:
        """Fit the policy on all that there is; without `imitates` in the first round alone."""
        if self.policy.normaliser.count and not self._settings.imitates:
            return {}
        if new := segments[self._seen :]:
            for one in new if self._settings.imitates else ():
                check_imitable(one, self._task)
            self.policy.observe(np.concatenate([one.observations for one in new]))
        self._seen = len(segments)
        settings = self._settings
        if not settings.cloning_epochs:
            return {}
        passes = Passes(settings.cloning_epochs, settings.cloning_minibatch, settings.max_grad_norm)
        steps = steps_of(Shown(segments, weights), self.policy)
        return {"cloning_loss": clone(self.policy, self.optimizer, steps, passes, rng)}

    def descend(
        self, steps: Decisions, rows: Integers, loss_of: Callable[[Tensor], tuple[Tensor, dict[str, Tensor]]]
    ) -> Metrics:
        """One gradient step of the policy on a loss of the log-probabilities (b, 1) of some steps."""
        some = steps.rows(torch.from_numpy(rows).to(self.policy.device))
        return descend_by_logp(self.policy, self.optimizer, some, loss_of, self._settings.max_grad_norm)

    def _act(self, rng: np.random.Generator | None) -> Act:
        return Acting(self.policy.decide(), rng)


def gaussian(
    settings: OfflineSettings, task: ControlTask, rng: np.random.Generator, learns_std: bool = False
) -> MLPPolicy:
    """The perceptron that these learners learn, with its std as it is set, or learned from there."""
    network = MLPPolicySettings(hidden=settings.hidden, initial_std=settings.std)
    return MLPPolicy(network, task, rng, learns_std)


@torch.no_grad()
def _agreement(learner: Offline, held: Batch[Segment]) -> Metrics:
    """How held-out judgements agree with the policy's scores."""
    recordings = Recordings.of(held.candidates, learner.policy)
    _, whose, before = recordings.steps(np.arange(len(held.candidates)))  # in order: the rows are all of them
    scores = learner.scores(learner.policy.log_prob(recordings.decisions)[0], whose, before)
    edges, preference, weight = (
        torch.from_numpy(x).to(scores.device) for x in (held.edges, held.preference, held.weight)
    )
    share, gaps = weight / weight.sum(), scores[edges[:, 0]] - scores[edges[:, 1]]
    found = {"agreement": float(measured(gaps, preference, share)["accuracy"])}
    if learner.alpha is None:
        return found
    losses = torch.nn.functional.binary_cross_entropy_with_logits(learner.alpha * gaps, preference, reduction="none")
    return found | {"judgement_loss": float((share * losses).sum())}


def _nothing(settings: OfflineSettings) -> str:
    if settings.imitates:
        return f"{settings.kind} learns from demonstrations: set labeler.kind=expert or learner.data, or import some"
    return f"{settings.kind} learns from segments: set learner.data, or import judged ones"


def minibatches(count: int, epochs: int, size: int, rng: np.random.Generator) -> Iterator[Integers]:
    """Rows, each once an epoch."""
    for _ in range(epochs):
        yield from shuffled(count, size, rng)


def _data(path: Path | None, task: ControlTask, imitates: bool) -> tuple[Segment, ...]:
    """The segments of the file, or of the task. Raises `ValueError` where they do not fit the task."""
    if path is None:
        return tuple(task.segments) if isinstance(task, Recorded) else ()
    if imitates:  # any length will do
        return recorded(path, task)
    found = recording(path).segments
    if misfit := kind_of(found[0]).misfit(found[0], task):
        raise ValueError(f"learner.data: a segment of {path} {misfit}: choose another file or task")
    if all(len(one) < task.segment_steps for one in found):
        raise ValueError(f"learner.data: {path} has no segment of task.segment_steps={task.segment_steps} steps")
    return found


__all__: Sequence[str] = ("Improve", "Material", "Offline", "OfflineSettings", "Recordings", "gaussian", "minibatches")
