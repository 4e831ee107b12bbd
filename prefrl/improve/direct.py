"""What the direct methods for text share: gradient steps on pairs of responses, and a learner around them.

A direct method fits the policy on which of two responses is better. What it reads of a response is its gain: how much
more probable it has become than it was under the starting policy, which is the reference throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, Self, TypeAlias

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.fit.pairs import Batch
from prefrl.improve.gradient import Parts, descend, in_parts
from prefrl.improve.objectives import dpo_loss, ipo_loss
from prefrl.improve.pairs import measured, shuffled
from prefrl.improve.writer import Schedule, Writer
from prefrl.policies.language import LanguagePolicy, LanguageSettings
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, TextTask
from prefrl.seeding import Device
from prefrl.types import Evaluation, Floats, Integers, Metrics, Response, State, Steps

PairLoss: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""(m, 2) gains of both responses, (m,) preferences for the first -> (m,) losses."""
Improve: TypeAlias = Callable[[Writer, RewardModel[Response], Store[Response], np.random.Generator], Metrics]
"""One round's worth of learning."""


class DirectSettings(Settings):
    """The settings that all these learners have; each one's class adds its kind and what is particular to it."""

    kind: str
    learning_rate: float = Field(1e-4, gt=0)
    """Adam's."""
    schedule: Schedule = "constant"
    """Of the learning rate: it stays, or it falls towards 0 along a line over the batches of a round (over the gradient
    steps, where a round has no batches), and begins anew in the next."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    asked_responses: int = Field(4, ge=2)
    """Responses to each prompt that is sampled for being asked about."""
    evaluation_prompts: int = Field(128, ge=1)
    """Each gets one response at temperature 1."""
    policy: LanguageSettings = LanguageSettings()
    """What of the model is trained, and how much of it at once."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""
    discount: ClassVar[float] = 1.0  # a response is judged as a whole
    imitates: ClassVar[bool] = False
    """Whether it learns from demonstrations, with or without judgements."""

    def with_evaluation_of(self, other: Self) -> Self:
        return self.model_copy(update={"evaluation_prompts": other.evaluation_prompts})


class HeldSettings(DirectSettings):
    """The settings of the methods that read gains."""

    beta: float = Field(0.1, gt=0)
    """How near: the reward that is implied is beta x the log-ratio to the starting policy."""


class PairLossSettings(HeldSettings):
    """The settings of the methods whose loss is one of a pair."""

    loss: Literal["sigmoid", "ipo"] = "sigmoid"
    """On a pair: `sigmoid` (DPO, Rafailov et al. 2023) widens the gap without end where all answers agree, `ipo` (Azar
    et al. 2024) to 1 / (2 beta) nats and no further."""
    length_normalised: bool = False
    """Divide a response's log-ratio by its tokens, so that beta is in units of nats a token: 10 or more times as large
    as otherwise for the same pull."""
    label_smoothing: float = Field(0.0, ge=0, lt=0.5)
    """The share of judgements that are taken to be wrong."""

    def pair_loss(self, gains: Tensor, preference: Tensor) -> Tensor:
        """A `PairLoss`."""
        gaps = gains[:, 0] - gains[:, 1]
        if self.loss == "ipo":
            return ipo_loss(gaps, preference, self.label_smoothing, self.beta)
        return dpo_loss(self.beta * gaps, preference, self.label_smoothing)


def pair_formula(settings: PairLossSettings) -> str:
    """The loss of a pair in plain letters, with the settings' numbers."""
    wrong, tokens = settings.label_smoothing, " / tokens({0})" if settings.length_normalised else ""
    better, worse = (f"[log pi({y}) - log ref({y})]{tokens.format(y)}" for y in ("better", "worse"))
    if settings.loss == "ipo":
        target = 1 / (2 * settings.beta)
        also = f" + {wrong:g} (d + {target:g})^2" if wrong else ""
        return f"minimise  mean[ {1 - wrong:g} (d - {target:g})^2{also} ]\nd = {better} - {worse}"
    also = f" + {wrong:g} log s(-h)" if wrong else ""
    return (
        f"maximise  mean[ {1 - wrong:g} log s(h){also} ],  s(h) = 1 / (1 + exp(-h))\n"
        f"h = {settings.beta:g} ({better} - {worse})"
    )


@dataclass(frozen=True, eq=False)
class Pairs:
    """M pairs among N responses."""

    rows: Responses
    """The N responses."""
    start: Tensor
    """(N,) their log-probabilities under the starting policy, summed over tokens."""
    edges: Integers
    """(M, 2) which two of them."""
    preference: Floats
    """(M,) float32 in [0, 1]: the probability that the first is better."""
    weight: Floats
    """(M,) float32: what each counts."""
    length_normalised: bool = False
    """Whether gains are means over tokens."""

    def __len__(self) -> int:
        return len(self.edges)

    @classmethod
    def of(cls, data: Batch[Response], policy: LanguagePolicy, length_normalised: bool = False) -> Pairs:
        """The pairs that judgements imply."""
        rows = Responses.of(data.candidates, policy.task, policy.device)
        # Padding is 0, so the sums are over the responses' own tokens.
        start = policy.start_logp(rows).sum(1)
        return cls(rows, start, data.edges, data.preference, data.weight, length_normalised)

    def minibatches(self, epochs: int, size: int, rng: np.random.Generator) -> list[Integers]:
        """Indices of pairs: each pair once an epoch, about equally many at a time."""
        return [at for _ in range(epochs) for at in shuffled(len(self), size, rng)]

    def gains(self, policy: LanguagePolicy, flat: Tensor) -> Tensor:
        """(b,) log-ratios of some responses to the starting policy, sums or means over tokens; differentiable."""
        rows = self.rows.rows(flat)
        gains = policy.log_prob(rows)[0].sum(1) - self.start[flat]
        return gains / rows.mask.sum(1) if self.length_normalised else gains


def step(writer: Writer, settings: HeldSettings, pairs: Pairs, at: Integers, loss: PairLoss) -> Metrics:
    """One gradient step on some pairs.

    Metrics, weighted means over pairs: loss, accuracy (share whose better one gained more; a tie is half), margin (beta
    x nats by which it did); and grad_norm.
    """
    policy = writer.policy
    policy.check_share(len(at))
    parts = _parts(policy, settings, pairs, at, loss)
    return descend(policy.parameters(), writer.optimizer, parts, settings.max_grad_norm)


def _parts(policy: LanguagePolicy, settings: HeldSettings, pairs: Pairs, at: Integers, loss: PairLoss) -> Parts:
    """Both responses of a pair go through the network in one pass, so that their rounding is alike."""
    for some in in_parts(at, settings.policy.chunk // 2):
        # Shares of the whole minibatch: the parts add up to its mean. The two of a pair stand side by side: (2 m,).
        arrays = (pairs.weight[some] / pairs.weight[at].sum(), pairs.edges[some].flatten(), pairs.preference[some])
        share, flat, preference = (torch.from_numpy(x).to(policy.device) for x in arrays)
        gains = pairs.gains(policy, flat).view(-1, 2)
        margins = settings.beta * (gains[:, 0] - gains[:, 1]).detach()
        yield (loss(gains, preference) * share).sum(), measured(margins, preference, share)


def nothing_shown(kind: str) -> str:
    """Of a learner that imitates."""
    return (
        f"{kind} learns what was shown and the better responses; there is no demonstration, and no judgement names a "
        "better one: import demonstrations, or raise loop.labels"
    )


class Direct:
    """A `prefrl.protocols.Learner` of responses: direct methods, RAFT and supervised fine-tuning differ in how they
    improve alone."""

    def __init__(self, settings: DirectSettings, task: TextTask, improve: Improve, rng: np.random.Generator) -> None:
        self._settings, self._writer, self._improve = settings, Writer(task, settings, rng), improve
        self.policy = self._writer.policy

    @property
    def steps(self) -> Steps:
        return self._writer.steps

    def imitates(self, store: Store[Response]) -> bool:
        return self._settings.imitates and bool(store.demonstrations())

    def check_shown(self, shows: bool, judged: bool) -> None:
        if self._settings.imitates and not (shows or judged):
            raise ConfigError(nothing_shown(self._settings.kind))

    def sample(self, count: int, rng: np.random.Generator) -> list[Response]:
        return self._writer.ask(count, self._settings.asked_responses, rng)

    def improve(self, reward: RewardModel[Response], store: Store[Response], rng: np.random.Generator) -> Metrics:
        return self._improve(self._writer, reward, store, rng)

    def evaluate(self, reward: RewardModel[Response], rng: np.random.Generator) -> Evaluation[Response]:
        return self._writer.evaluate(self._settings.evaluation_prompts, reward, rng)

    def state(self) -> State:
        return self._writer.state()

    def load(self, state: State) -> None:
        self._writer.load(state)
