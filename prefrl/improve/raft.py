"""RAFT, or expert iteration: of several responses to each prompt the best is learned as if a person had written it.

Variant: Dong et al. 2023, with the best of each prompt's own K. The newest policy writes, and is improved from where it
is; a KL to the start may be taken off the score, as in the paper. What differs: many small batches, one optimiser
throughout. Left out: a temperature of sampling, the best of a whole batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.evaluate.best_of_n import best
from prefrl.evaluate.policies import scored
from prefrl.improve.gradient import Parts, descend, in_parts
from prefrl.improve.objectives import kl_k1
from prefrl.improve.writer import Writer
from prefrl.policies.language import LanguageSettings
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, TextTask, text
from prefrl.seeding import Device, to_numpy
from prefrl.types import Evaluation, Integers, Metrics, Response, State, Steps


class RAFTSettings(Settings):
    """Supervised steps on the best of several responses to each prompt, by the learned reward."""

    kind: Literal["raft"] = "raft"
    updates: int = Field(8, ge=1)
    """Batches of a round."""
    prompts: int = Field(16, ge=1)
    """P: prompts of a batch."""
    responses: int = Field(8, ge=2)
    """K: responses to each prompt, of which the best one is learned."""
    epochs: int = Field(1, ge=1)
    """Passes over the best responses of a batch."""
    minibatch: int = Field(16, ge=1)
    """Responses in a gradient step."""
    beta: float = Field(0.0, ge=0)
    """Taken off a response's score for each nat of its log-ratio to the starting policy, before the best is chosen."""
    learning_rate: float = Field(5e-4, gt=0)
    """Adam's; it does not change."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    missing_end_penalty: float = Field(1.0, ge=0)
    """Taken off the score of a response that reached the task's most tokens without an end token."""
    asked_responses: int = Field(4, ge=2)
    """Responses to each prompt that is sampled for being asked about."""
    evaluation_prompts: int = Field(128, ge=1)
    """Each gets one response at temperature 1."""
    policy: LanguageSettings = LanguageSettings()
    """What of the model is trained, and how much of it at once."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""
    discount: ClassVar[float] = 1.0  # a response is judged as a whole

    def shrunk(self) -> RAFTSettings:
        return self.model_copy(update={"updates": 1, "prompts": min(self.prompts, 4), "evaluation_prompts": 8})

    def with_evaluation_of(self, other: RAFTSettings) -> RAFTSettings:
        return self.model_copy(update={"evaluation_prompts": other.evaluation_prompts})

    def work(self) -> float:
        return float(self.updates * self.prompts)

    def build(self, task: Task, rng: np.random.Generator) -> RAFT:
        return RAFT(self, text(task, f"learner kind {self.kind!r} writes text"), rng)

    def formula(self) -> str:
        kl = f" - {self.beta:g} [log pi(y) - log ref(y)]" if self.beta else ""
        by = f"score(y) - {self.missing_end_penalty:g} [no end token]{kl}"
        return f"maximise  mean_t[ log pi(y*_t) ]\ny* = the best of {self.responses} responses y to a prompt by {by}"


class RAFT:
    """A `prefrl.protocols.Learner` of responses that learns the best of its own by heart."""

    def __init__(self, settings: RAFTSettings, task: TextTask, rng: np.random.Generator) -> None:
        self._settings, self._writer = settings, Writer(task, settings, rng)
        self.policy = self._writer.policy

    @property
    def steps(self) -> Steps:
        return self._writer.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Response]:
        return self._writer.ask(count, self._settings.asked_responses, rng)

    def improve(self, reward: RewardModel[Response], store: Store[Response], rng: np.random.Generator) -> Metrics:
        """`updates` batches of fresh responses. Metrics, means over batches: reward (learned scores before penalties),
        reward_best (of those that were learned), kl (k1, nats per response), length (tokens), ended and unscored
        (shares); over gradient steps: loss (nats per token), grad_norm. NaN where it never was defined.
        """
        seen: dict[str, list[float]] = defaultdict(list)
        for _ in range(self._settings.updates):
            drawn = self._writer.write(self._settings.prompts, self._settings.responses, rng)
            kept, measured = self._choose(drawn, reward)
            for metrics in (measured, *(self._learn(drawn.rows(kept), rng) if len(kept) else ())):
                for name, value in metrics.items():
                    seen[name].append(value)
        return {name: float(torch.tensor(values, dtype=torch.float64).nanmean()) for name, values in seen.items()}

    def _choose(self, drawn: Responses, reward: RewardModel[Response]) -> tuple[Tensor, Metrics]:
        """The rows to learn, at most one a prompt, and what the batch is like."""
        settings, device = self._settings, self.policy.device
        raw = torch.from_numpy(scored(reward, drawn.candidates(self.policy.task.tokenizer))).to(device)  # (B,)
        if raw.isinf().any():
            raise FloatingPointError(
                "a reward is infinite; expected finite numbers: look at the reward model's last fit"
            )
        kl = kl_k1(drawn.logp, self.policy.start_logp(drawn)).sum(1)  # (B,): padding is 0 in both
        groups = (raw - settings.missing_end_penalty * ~drawn.ended - settings.beta * kl).view(-1, settings.responses)
        kept = torch.from_numpy(best(to_numpy(groups)) + np.arange(len(groups)) * settings.responses).to(device)
        kept = kept[~raw[kept].isnan()]  # what was not scored is never learned
        means = {"reward": raw, "reward_best": raw[kept], "kl": kl, "length": drawn.mask.sum(1), "ended": drawn.ended}
        found = {name: float(values.float().nanmean()) for name, values in means.items()}
        return kept, found | {"unscored": float(raw.isnan().float().mean())}

    def _learn(self, rows: Responses, rng: np.random.Generator) -> Iterator[Metrics]:
        for _ in range(self._settings.epochs):
            for at in np.array_split(rng.permutation(len(rows)), -(-len(rows) // self._settings.minibatch)):
                if len(at) < self.policy.least_rows:
                    continue  # too few for all ranks
                parts, longest = self._parts(rows, at), self._settings.max_grad_norm
                yield descend(self.policy.parameters(), self._writer.optimizer, parts, longest)

    def _parts(self, rows: Responses, at: Integers) -> Parts:
        device = self.policy.device
        tokens = rows.mask[torch.from_numpy(at).to(device)].sum()  # the whole minibatch's: its mean is in parts
        for some in in_parts(at, self._settings.policy.chunk):
            yield -self.policy.log_prob(rows.rows(torch.from_numpy(some).to(device)))[0].sum() / tokens, {}

    def evaluate(self, reward: RewardModel[Response], rng: np.random.Generator) -> Evaluation[Response]:
        return self._writer.evaluate(self._settings.evaluation_prompts, reward, rng)

    def state(self) -> State:
        return self._writer.state()

    def load(self, state: State) -> None:
        self._writer.load(state)
