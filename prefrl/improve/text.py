"""Policy gradients for text, on the learned reward: RLOO by default; REINFORCE, GRPO and PPO's clip are settings."""

from __future__ import annotations

import copy
from collections import defaultdict
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.components import Settings
from prefrl.improve.formula import text_formula
from prefrl.improve.generate import Sampling
from prefrl.improve.objectives import (
    AdaptiveKL,
    Reduction,
    clipped_surrogate,
    group_normalised,
    kl_k1,
    kl_k2,
    leave_one_out,
    log_ratio,
    policy_gradient,
    step_rewards,
    step_weights,
)
from prefrl.improve.responses import Responses, all_logp, check_head, respond, response_logp, text
from prefrl.protocols import RewardModel, Store, Task, TextTask
from prefrl.seeding import draw_seed
from prefrl.types import Evaluation, Metrics, Response, State, Steps

EXAMPLES = 4


class TextSettings(Settings):
    """Policy gradients on a learned reward, held near the starting policy by a KL penalty; RLOO by default."""

    kind: Literal["text"] = "text"
    updates: int = Field(15, ge=1)
    """Batches of a round."""
    prompts: int = Field(16, ge=1)
    """P: prompts of a batch."""
    responses: int = Field(8, ge=1)
    """K: responses to each prompt."""
    epochs: int = Field(1, ge=1)
    """Passes over each batch."""
    minibatches: int = Field(1, ge=1)
    """Gradient steps of a pass."""
    advantage: Literal["leave_one_out", "group_normalised", "batch_mean"] = "leave_one_out"
    """What is taken off a response's return: the mean of its prompt's others (RLOO), its group's mean, over the std
    (GRPO), or the batch's mean (REINFORCE)."""
    clip: float | None = Field(None, gt=0)
    """How far the ratio of new to old probability counts (PPO, GRPO); null for the plain policy gradient."""
    beta: float = Field(0.3, ge=0)
    """Weight of the KL to the starting policy, in units of reward a nat."""
    kl_in: Literal["reward", "loss"] = "reward"
    """Where the KL goes: into the reward (k1 of each token, before the baseline), or into the loss (k2)."""
    kl_target: float | None = Field(None, gt=0)
    """Steer beta to this KL in nats per response (Ziegler et al. 2019); null leaves it alone."""
    kl_horizon: float = Field(10_000.0, gt=0)
    """Responses over which beta is steered."""
    reduction: Reduction = "constant"
    """How steps are averaged: `constant` (sums over a response), `token` or `sequence` (see docs)."""
    learning_rate: float = Field(5e-4, gt=0)
    """Adam's; it does not change."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    temperature: float = Field(1.0, gt=0)
    """Of sampling while learning and asking, and of every log-probability in the objective."""
    missing_end_penalty: float = Field(1.0, ge=0)
    """Taken off the score of a response that reached the task's most tokens without an end token."""
    asked_responses: int = Field(4, ge=2)
    """Responses to each prompt that is sampled for being asked about."""
    evaluation_prompts: int = Field(128, ge=1)
    """Each gets one response at temperature 1."""
    chunk: int = Field(64, ge=1)
    """Rows in one pass of a network: changes memory and speed, and nothing else but rounding."""

    @model_validator(mode="after")
    def _consistent(self) -> TextSettings:
        if self.advantage != "batch_mean" and self.responses < 2:
            raise ValueError(f"advantage {self.advantage} needs at least 2 responses, got {self.responses}")
        if self.clip is None and self.epochs * self.minibatches > 1:
            raise ValueError("several gradient steps on a batch (epochs x minibatches > 1) need a clip: set clip=0.2")
        if self.minibatches > self.prompts * self.responses:
            raise ValueError(f"{self.prompts} x {self.responses} responses cannot be {self.minibatches} minibatches")
        if self.kl_target is not None and self.beta == 0:
            raise ValueError("kl_target steers beta, so beta must start above 0")
        return self

    def shrunk(self) -> TextSettings:
        return self.model_copy(update={"updates": 1, "prompts": min(self.prompts, 4), "evaluation_prompts": 8})

    def with_evaluation_of(self, other: TextSettings) -> TextSettings:
        return self.model_copy(update={"evaluation_prompts": other.evaluation_prompts})

    def work(self) -> float:
        return float(self.updates * self.prompts)

    @property
    def discount(self) -> float:
        """A response is scored as a whole: no token counts for less because it comes later."""
        return 1.0

    def build(self, task: Task, rng: np.random.Generator) -> TextLearner:
        return TextLearner(self, text(task, self.kind))

    def formula(self) -> str:
        """The objective, as text."""
        return text_formula(self)


class TextLearner:
    """A `prefrl.protocols.Learner` of responses. A response is an episode, its tokens are the actions.

    Log-probabilities are kept from sampling, so the old policy is never run again; networks stay in evaluation mode
    throughout, so the probability ratio is 1 (to rounding) before a batch's first gradient step.
    """

    def __init__(self, settings: TextSettings, task: TextTask) -> None:
        self._settings, self._task = settings, task
        self.model = task.model()
        self._reference = task.model().requires_grad_(False)
        check_head(self.model)
        self._optimizer = torch.optim.Adam(self.model.parameters(), settings.learning_rate, eps=1e-5, fused=True)
        self._kl = AdaptiveKL(settings.beta, settings.kl_target or 1.0, settings.kl_horizon)
        self._steps, self._updates = Steps(), 0

    @property
    def steps(self) -> Steps:
        return self._steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Response]:
        """Groups of `asked_responses` responses to random prompts."""
        groups = -(-count // self._settings.asked_responses)
        prompts = self._task.prompts(groups, rng)
        drawn = self._respond(prompts, self._settings.asked_responses, self._settings.temperature, rng)
        self._steps = self._steps.add(query=drawn.count)
        return self._with_gold(drawn.candidates(self._task.tokenizer))

    def improve(self, reward: RewardModel[Response], store: Store[Response], rng: np.random.Generator) -> Metrics:
        """`updates` batches of fresh responses; the metrics are means over them.

        reward and reward_std (learned scores before penalties), kl (k1, nats per response), surprise (nats per token:
        minus the mean log-probability of what was sampled), length (tokens), ended (share), beta, loss, grad_norm
        (before clipping), and ratio_error: the largest |pi / pi_old - 1| before a batch's first step, 0 to rounding.
        """
        seen: dict[str, list[float]] = defaultdict(list)
        for _ in range(self._settings.updates):
            prompts = self._task.prompts(self._settings.prompts, rng)
            batch = self._respond(prompts, self._settings.responses, self._settings.temperature, rng)
            self._steps = self._steps.add(learn=batch.count)
            for name, value in self._update(batch, reward, rng).items():
                seen[name].append(value)
            self._updates += 1
        means = {name: float(np.mean(values)) for name, values in seen.items()}
        return means | {"ratio_error": max(seen["ratio_error"])}

    def evaluate(self, reward: RewardModel[Response], rng: np.random.Generator) -> Evaluation[Response]:
        """One response at temperature 1 to each evaluation prompt.

        Metrics: gold, gold_std, learned, kl (nats per response: the mean log-ratio to the starting policy), length
        (tokens), ended (share), and fluency where the task can tell.
        """
        prompts = self._task.evaluation_prompts(self._settings.evaluation_prompts, rng)
        drawn = self._respond(prompts, 1, 1.0, rng)
        self._steps = self._steps.add(evaluate=drawn.count)
        found = self._with_gold(drawn.candidates(self._task.tokenizer))
        gold = np.array([r.gold for r in found], float)
        metrics = {
            "gold": float(gold.mean()),
            "gold_std": float(gold.std()),
            "learned": float(reward.score(found).mean()),
            "kl": float((drawn.logp - all_logp(self._reference, drawn, 1.0, self._settings.chunk)).sum(1).mean()),
            "length": float(drawn.mask.sum(1).float().mean()),
            "ended": float(drawn.ended.float().mean()),
        }
        fluent = self._task.fluency(found)
        metrics |= {} if fluent is None else {"fluency": float(fluent.mean())}
        return Evaluation(metrics, tuple(found[:EXAMPLES]))

    def state(self) -> State:
        model = {name: p.detach().clone() for name, p in self.model.named_parameters()}
        optimizer = copy.deepcopy(self._optimizer.state_dict())
        numbers = {"steps": list(self._steps), "updates": self._updates, "beta": self._kl.beta}
        return {"model": model, "optimizer": optimizer, **numbers}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        for name, parameter in self.model.named_parameters():
            found = state["model"].get(name)
            if found is None or found.shape != parameter.shape:
                raise ValueError(f"policy: {name} is missing or has another shape: it was made by other settings")
            parameter.copy_(found)
        self._optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self._steps, self._updates = Steps(*state["steps"]), int(state["updates"])
        self._kl = replace(self._kl, beta=float(state["beta"]))

    def _respond(self, prompts: list[str], samples: int, temperature: float, rng: np.random.Generator) -> Responses:
        ends = (int(self._task.tokenizer.eos_token_id),)
        sampling = Sampling(samples, self._task.response_tokens, ends, temperature)
        generator = torch.Generator().manual_seed(draw_seed(rng))
        return respond(self.model, self._task, prompts, sampling, generator)

    def _with_gold(self, found: list[Response]) -> list[Response]:
        gold = self._task.gold(found)
        return [replace(r, gold=gold[i : i + 1]) for i, r in enumerate(found)]

    def _update(self, batch: Responses, reward: RewardModel[Response], rng: np.random.Generator) -> Metrics:
        """Learn from one batch."""
        raw = torch.as_tensor(reward.score(batch.candidates(self._task.tokenizer)), dtype=torch.float32)
        scores = self._finite("reward", raw - self._settings.missing_end_penalty * ~batch.ended)
        reference = self._reference_logp(batch)
        kl = torch.where(batch.mask, kl_k1(batch.logp, reference), 0.0)
        in_reward = self._kl.beta if self._settings.kl_in == "reward" else 0.0
        returns = step_rewards(scores, kl, batch.mask, in_reward).sum(1)
        groups = returns.view(-1, self._settings.responses)
        advantages = advantages_of(groups, self._settings.advantage)
        learned = self._learn(batch, advantages.flatten(), reference, rng)
        sequence_kl = float(kl.sum(1).mean())
        if self._settings.kl_target is not None:
            self._kl = self._kl.update(sequence_kl, len(batch))
        lengths = batch.mask.sum(1).float()
        if self._settings.beta:  # what was not measured is absent, not 0
            learned["kl"] = sequence_kl
        return learned | {
            "reward": float(raw.mean()),
            "reward_std": float(raw.std(correction=0)),
            "surprise": -float(batch.logp.sum() / batch.count),
            "length": float(lengths.mean()),
            "ended": float(batch.ended.float().mean()),
            "beta": self._kl.beta,
            "equal_groups": float((groups == groups[:, :1]).all(1).float().mean()),
        }

    def _reference_logp(self, batch: Responses) -> Tensor:
        """(B, L) under the starting policy; where the KL does not count that is not run, and the policy stands in."""
        if self._settings.beta == 0:
            return batch.logp
        return all_logp(self._reference, batch, self._settings.temperature, self._settings.chunk)

    def _learn(
        self, batch: Responses, advantages: Tensor, reference: Tensor, rng: np.random.Generator
    ) -> dict[str, float]:
        """The gradient steps on one batch; the metrics of the last one, and the ratio error before the first."""
        order = torch.Generator().manual_seed(draw_seed(rng))
        size = -(-len(batch) // self._settings.minibatches)
        metrics: dict[str, float] = {}
        for _ in range(self._settings.epochs):
            for at in torch.randperm(len(batch), generator=order).split(size):  # type: ignore[no-untyped-call]
                metrics |= self._step(batch.rows(at), advantages[at], reference[at], first=not metrics)
        return metrics

    def _step(self, rows: Responses, advantages: Tensor, reference: Tensor, first: bool) -> dict[str, float]:
        """One gradient step; rows of like length go through the network together, and their gradients add up."""
        weights = step_weights(rows.mask, self._settings.reduction)
        self._optimizer.zero_grad()
        total, error = 0.0, 0.0
        for at, some in rows.chunks(self._settings.chunk):
            width = some.mask.shape[1]
            logp = response_logp(self.model, some, self._settings.temperature)
            losses = self._losses(logp, some, advantages[at], reference[at, :width])
            loss = self._finite("loss", (losses * weights[at, :width]).sum())
            loss.backward()  # type: ignore[no-untyped-call]
            total += float(loss.detach())
            error = max(error, float(log_ratio(logp.detach(), some.logp, some.mask).expm1().abs().max()))
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self._settings.max_grad_norm)
        self._finite("gradient", norm)
        self._optimizer.step()
        return {"loss": total, "grad_norm": float(norm)} | ({"ratio_error": error} if first else {})

    def _losses(self, logp: Tensor, rows: Responses, advantages: Tensor, reference: Tensor) -> Tensor:
        """(B, L): what each token adds to the loss, before averaging."""
        if self._settings.clip is None:
            losses = policy_gradient(logp, advantages[:, None])
        else:
            ratios = log_ratio(logp, rows.logp, rows.mask)
            losses = clipped_surrogate(ratios, advantages[:, None], self._settings.clip)
        if self._settings.kl_in == "loss":
            losses = losses + self._kl.beta * kl_k2(logp, reference)
        return losses

    def _finite(self, name: str, values: Tensor) -> Tensor:
        if not values.isfinite().all():
            raise FloatingPointError(
                f"the {name} of update {self._updates} is not finite: {values.detach().flatten()[:4].tolist()}; "
                "expected finite numbers: look at the reward model's scores, or lower learner.learning_rate"
            )
        return values


def advantages_of(returns: Tensor, how: str) -> Tensor:
    """(P, K) returns of K responses to each of P prompts -> (P, K) advantages."""
    if how == "leave_one_out":
        return leave_one_out(returns)
    return group_normalised(returns) if how == "group_normalised" else returns - returns.mean()
