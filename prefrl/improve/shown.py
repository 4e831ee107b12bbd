"""Learning from what was shown: a clone, and the likelihood of demonstrations beside a policy gradient.

Variant: DAPG (Rajeswaran et al. 2018) in PPO's update instead of a natural gradient: cloned first, then the gradient
of the demonstrations' mean log-probability, times `keep` and `decay` to the power of the rounds, is added to that of
the surrogate. Their factor of the largest advantage is left out: advantages are whitened here. Each gradient step sees
a minibatch of what was shown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.exchange.recordings import check_imitable, recorded
from prefrl.improve.gradient import Batch, Beside, Optimizer, adam, update
from prefrl.improve.objectives import Objective
from prefrl.improve.pairs import shuffled
from prefrl.policies.acting import Clonable, Decisions
from prefrl.policies.mlp import MLPPolicy
from prefrl.protocols import ControlTask, I, Store
from prefrl.types import Metrics, Segment

LONGEST = 1.0
"""A gradient of cloning that is longer is shortened to this."""
NOTHING = (
    "learns from demonstrations, and there are none: set learner.clone.data, choose a labeler that shows what to do "
    "(labeler.kind=demonstrator), or leave learner.clone.epochs and learner.clone.keep at 0"
)


class Shown(NamedTuple):
    """Behaviour to imitate, and how much each segment counts, by its id; 1 where nothing is said."""

    segments: Sequence[Segment]
    weights: Mapping[str, float]


class Passes(NamedTuple):
    """How often, and how, a clone goes through what is shown."""

    epochs: int
    minibatch: int
    max_grad_norm: float


class ImitationSettings(Settings):
    """What a policy gradient takes from demonstrations: a clone to start as, and their likelihood beside its objective
    (DAPG, Rajeswaran et al. 2018). Beside those of the store there may be recorded ones."""

    data: Path | None = None
    """A folder of demonstrations, an .npz file of segments or a Minari data set, beside the store's demonstrations."""
    epochs: int = Field(0, ge=0)
    """Passes over all that is shown before anything else is learned; 0 for no clone. It is made before the policy acts
    where `data` is named, and else in the first round, in which the critic alone learns then."""
    minibatch: int = Field(64, ge=1)
    """Shown steps in a gradient step, of the clone and beside the objective."""
    learning_rate: float = Field(1e-3, gt=0)
    """Adam's, while it clones."""
    keep: float = Field(0.0, ge=0)
    """Weight of the mean log-probability of what is shown, beside the objective."""
    decay: float = Field(1.0, gt=0, le=1)
    """What that weight is multiplied by from round to round."""
    learn_std: bool = False
    """Learn the std of continuous actions from what is shown as well."""

    @model_validator(mode="after")
    def _used(self) -> ImitationSettings:
        if self.data is not None and not self.on:
            raise ValueError(f".data: {self.data} is of no use while epochs and keep are 0: set one of them")
        return self

    @property
    def on(self) -> bool:
        return bool(self.epochs or self.keep)

    def shrunk(self) -> ImitationSettings:
        return self.model_copy(update={"epochs": min(self.epochs, 1)})

    def formula(self) -> str:
        """What there is beside the objective, as text."""
        kept = "" if self.decay == 1 else f" {self.decay:g}^round"
        lines = [f"+ {self.keep:g}{kept} mean[ log pi(a|s) ]  over the demonstrations"] if self.keep else []
        return "\n".join([*lines, *([f"from their clone, of {self.epochs} epochs"] if self.epochs else [])])


class Imitation:
    """What a learner of control does with demonstrations, and whether its policy is a clone yet."""

    def __init__(self, settings: ImitationSettings, task: ControlTask, rng: np.random.Generator) -> None:
        """Raises `ConfigError` where the recorded demonstrations cannot be learned from."""
        self._settings, self._task = settings, task
        self.cloned = not settings.epochs
        try:
            self._data = () if settings.data is None else recorded(settings.data, task)
        except ValueError as error:
            raise ConfigError(f"learner.clone.data: {error}") from error
        # Its own: a policy that is cloned before it acts is in no stage yet. Without a clone nothing is drawn.
        self._rng = np.random.default_rng(rng.integers(2**63) if settings.epochs else 0)

    def check(self, shows: bool) -> None:
        """Raise `ConfigError` where there is nothing to learn from: `shows` says whether anybody shows anything."""
        if not (shows or self._data):
            raise ConfigError(f"learner.clone {NOTHING}")

    def begin(self, policy: MLPPolicy) -> None:
        """Clone what is recorded, where there is no clone yet."""
        if self._data and not self.cloned:
            self._clone(policy, Shown(self._data, {}))

    def shown(self, store: Store[Segment]) -> Shown:
        """All that there is to imitate. Raises ValueError where there is nothing, or what cannot be cloned."""
        demonstrations = store.demonstrations() if store is not None else []
        segments = once([*self._data, *(one.like for one in demonstrations)])
        if not segments:
            raise ValueError(f"learner.clone {NOTHING}")
        for one in segments:
            check_imitable(one, self._task)
        return Shown(segments, {one.like.id: one.demonstration.weight for one in demonstrations})

    def first(self, policy: MLPPolicy, shown: Shown) -> Metrics:
        """Clone what is shown, where there is no clone yet."""
        return {} if self.cloned else self._clone(policy, shown)

    def beside(self, policy: MLPPolicy, shown: Shown, round: int, rng: np.random.Generator) -> Beside[Decisions] | None:
        """What is learned beside the objective after so many rounds."""
        weight = self._settings.keep * self._settings.decay**round
        if not weight:
            return None
        steps = steps_of(shown, policy)
        return Beside(self._view(policy), steps, weight, again_and_again(steps, self._settings.minibatch, rng))

    def _clone(self, policy: MLPPolicy, shown: Shown) -> Metrics:
        settings, self.cloned = self._settings, True
        policy.observe(np.concatenate([one.observations for one in shown.segments]))
        # Few demonstrations show a part of the world: what lies elsewhere would change every scale at once.
        policy.freeze()
        view, optimizer = self._view(policy), adam(policy.parameters(), settings.learning_rate)
        passes = Passes(settings.epochs, settings.minibatch, LONGEST)
        loss = clone(view, optimizer, steps_of(shown, policy), passes, self._rng)
        return {"cloning_loss": loss, "demonstrations": float(len(shown.segments))}

    def _view(self, policy: MLPPolicy) -> MLPPolicy:
        return policy if self._settings.learn_std else policy.with_std_kept()


def clone(
    policy: Clonable[I], optimizer: Optimizer, steps: Batch[I], passes: Passes, rng: np.random.Generator
) -> float:
    """Raise the log-probability of every step, which is the policy gradient with an advantage of 1, or of the weight of
    its demonstration. Returns the mean loss of the last pass, and expects one at least."""
    objective = Objective(clip=None, value=0.0, entropy=0.0, max_grad_norm=passes.max_grad_norm)
    found: list[Metrics] = []
    for _ in range(passes.epochs):
        rows = one_pass(steps, passes.minibatch, rng)
        drawn = replace(steps, inputs=policy.redrawn(steps.inputs, rng))
        found = update(policy, optimizer, drawn, rows, objective)
    # Of a std that stays, a density says nothing: against the mode's it is a distance.
    each = steps.advantages.expand_as(steps.inputs.mask)[steps.inputs.mask]
    return float(np.mean([one["loss"] for one in found])) + policy.ceiling * float(each.double().mean())


def one_pass(steps: Batch[Any], size: int, rng: np.random.Generator) -> Iterator[Tensor]:
    """All rows once, of about `size` steps at a time."""
    rows = max(1, size // steps.inputs.mask.shape[1])
    return (torch.from_numpy(at).to(steps.logp.device) for at in shuffled(len(steps), rows, rng))


def again_and_again(steps: Batch[Any], size: int, rng: np.random.Generator) -> Iterator[Tensor]:
    while True:
        yield from one_pass(steps, size, rng)


def steps_of(shown: Shown, policy: Clonable[I]) -> Batch[I]:
    """Every step of the segments, one after another, as the policy sees it now; advantages are weights."""
    weights = [shown.weights.get(one.id, 1.0) for one in shown.segments]
    each = np.repeat(weights, [-(-len(one) // policy.chunk) for one in shown.segments])
    advantages = torch.from_numpy(each.astype(np.float32)[:, None]).to(policy.device)
    inputs = policy.examples(shown.segments)
    return Batch(inputs, torch.zeros_like(inputs.mask, dtype=torch.float32), advantages)


def once(segments: Sequence[Segment]) -> list[Segment]:
    """The same, in their order, without those that only repeat steps of others: an episode that is shown as a whole is
    often there in pieces as well."""
    known, kept = dict[tuple[str, int], bytes](), set[int]()
    for number in sorted(range(len(segments)), key=lambda i: -len(segments[i])):
        one = segments[number]
        steps = {
            (one.episode, one.start + t): one.observations[t].tobytes() + one.actions[t].tobytes()
            for t in range(len(one))
        }
        if not steps or any(known.get(at) != step for at, step in steps.items()):
            kept.add(number)
            known |= steps
    return [one for number, one in enumerate(segments) if number in kept]
