"""Direct preference optimisation for text: the policy is fitted on the judgements, without the reward model.

Variant: the sigmoid loss (Rafailov et al. 2023, equation 7) on all pairs that the judgements imply, the starting policy
as the reference. Soft preferences, ties and label smoothing are soft targets (cDPO, Mitchell 2023); the pairs of one
ranking share its weight. Left out: length normalisation, a supervised term, refreshing the reference.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.fit.pairs import Batch, batch
from prefrl.improve.gradient import Parts, descend, in_parts
from prefrl.improve.objectives import dpo_loss
from prefrl.improve.writer import Writer
from prefrl.policies.language import LanguageSettings
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, TextTask, text
from prefrl.seeding import Device
from prefrl.types import Evaluation, Integers, Metrics, Response, State, Steps


class DPOSettings(Settings):
    """Direct preference optimisation on all judgements so far, held near the starting policy."""

    kind: Literal["dpo"] = "dpo"
    beta: float = Field(0.1, gt=0)
    """How near: the reward that is implied is beta x the log-ratio to the starting policy."""
    label_smoothing: float = Field(0.0, ge=0, lt=0.5)
    """The share of judgements that are taken to be wrong."""
    epochs: int = Field(1, ge=1)
    """Passes over all pairs in a round."""
    minibatch: int = Field(16, ge=1)
    """Pairs in a gradient step."""
    learning_rate: float = Field(1e-4, gt=0)
    """Adam's; it does not change."""
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

    def shrunk(self) -> DPOSettings:
        return self.model_copy(update={"epochs": 1, "evaluation_prompts": 8})

    def with_evaluation_of(self, other: DPOSettings) -> DPOSettings:
        return self.model_copy(update={"evaluation_prompts": other.evaluation_prompts})

    def build(self, task: Task, rng: np.random.Generator) -> DPO:
        return DPO(self, text(task, f"learner kind {self.kind!r} writes text"), rng)

    def formula(self) -> str:
        wrong = f" + {self.label_smoothing:g} log s(-h)" if self.label_smoothing else ""
        return (
            f"maximise  mean[ {1 - self.label_smoothing:g} log s(h){wrong} ],  s(h) = 1 / (1 + exp(-h))\n"
            f"h = {self.beta:g} ([log pi(better) - log ref(better)] - [log pi(worse) - log ref(worse)])"
        )


class DPO:
    """A `prefrl.protocols.Learner` of responses that reads the judgements in the store, and not the reward."""

    def __init__(self, settings: DPOSettings, task: TextTask, rng: np.random.Generator) -> None:
        self._settings, self._writer = settings, Writer(task, settings, rng)
        self.policy = self._writer.policy

    @property
    def steps(self) -> Steps:
        return self._writer.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Response]:
        return self._writer.ask(count, self._settings.asked_responses, rng)

    def improve(self, reward: RewardModel[Response], store: Store[Response], rng: np.random.Generator) -> Metrics:
        """Passes over all judged pairs. Metrics, means over steps: loss, grad_norm, pairs, accuracy (share whose better
        one gained more on the reference; a tie is half), margin (beta x nats). Raises ValueError without a judged pair.
        """
        data, policy = batch(store.judged()), self.policy
        if not len(data):
            raise ValueError("dpo learns from judged pairs; the store holds none: raise loop.labels, or import some")
        rows = Responses.of(data.candidates, policy.task, policy.device)
        # (N,), once: the starting policy does not change. Padding is 0, so the sums are over the responses' own tokens.
        reference, seen = policy.start_logp(rows).sum(1), []
        for _ in range(self._settings.epochs):
            for at in np.array_split(rng.permutation(len(data)), -(-len(data) // self._settings.minibatch)):
                parts = self._parts(data, rows, reference, at)
                seen.append(descend(policy.parameters(), self._writer.optimizer, parts, self._settings.max_grad_norm))
        return {name: float(np.mean([s[name] for s in seen])) for name in seen[0]} | {"pairs": float(len(data))}

    def _parts(self, data: Batch[Response], rows: Responses, reference: Tensor, at: Integers) -> Parts:
        """Both responses of a pair go through the network in one pass, so that their rounding is alike."""
        self.policy.check_share(len(at))
        for some in in_parts(at, self._settings.policy.chunk // 2):
            # Shares of the whole minibatch: the parts add up to its mean. The two of a pair stand side by side: (2 m,).
            arrays = (data.weight[some] / data.weight[at].sum(), data.edges[some].flatten(), data.preference[some])
            share, pairs, preference = (torch.from_numpy(x).to(reference.device) for x in arrays)
            gains = (self.policy.log_prob(rows.rows(pairs))[0].sum(1) - reference[pairs]).view(-1, 2)
            margin = self._settings.beta * (gains[:, 0] - gains[:, 1])
            loss = (dpo_loss(margin, preference, self._settings.label_smoothing) * share).sum()
            signed = (margin * (2 * preference - 1).sign()).detach()  # 0 for a tie, which makes it half right below
            yield loss, {"accuracy": (share * (signed.sign() + 1) / 2).sum(), "margin": (share * signed).sum()}

    def evaluate(self, reward: RewardModel[Response], rng: np.random.Generator) -> Evaluation[Response]:
        return self._writer.evaluate(self._settings.evaluation_prompts, reward, rng)

    def state(self) -> State:
        return self._writer.state()

    def load(self, state: State) -> None:
        self._writer.load(state)
