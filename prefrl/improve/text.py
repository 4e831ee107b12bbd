"""Policy gradients for text, on the learned reward: RLOO, GRPO, REINFORCE, PPO.

Variant: one advantage a response; the KL of a response (k1, summed over its tokens) is taken off the reward before the
baseline, or off the advantage after it was normalised, whole or token by token; the penalty for a missing end comes
before the baseline too. GRPO as published puts k3 of each token into the loss, whose gradient is that of the other
direction. PPO has one advantage a token, from a critic: see `prefrl.improve.ppo`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.components import Settings, filled_in
from prefrl.evaluate.policies import scored
from prefrl.improve.gradient import Batch, update
from prefrl.improve.groups import (
    ADVANTAGES,
    AVERAGES,
    Weighing,
    by_group,
    check_ratio,
    distances,
    equal_groups,
    finite,
    mean,
    minibatches,
    rewarded,
)
from prefrl.improve.objectives import (
    AdaptiveKL,
    Objective,
    Reduction,
    kl_k1,
    log_quantiles,
    masked_mean,
    masked_whiten,
    win_rates,
)
from prefrl.improve.ppo import CriticSettings, by_token, check_start, critic_formula, start_from_reward
from prefrl.improve.writer import Schedule, Writer
from prefrl.policies.language import LanguageSettings, enough_memory
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, TextTask, text
from prefrl.seeding import Device
from prefrl.types import Evaluation, Metrics, Response, State, Steps

ALGORITHMS: dict[str, dict[str, Any]] = {
    "rloo": {},
    "grpo": {"advantage": "group_normalised", "clip": 0.2, "kl_in": "advantage", "reduction": "sequence"},
    "reinforce": {"advantage": "batch_mean"},
    "ppo": {"advantage": "gae", "clip": 0.2, "reduction": "token", "prompts": 128, "responses": 1, "epochs": 4}
    | {"whiten": True},
}
"""Defaults that differ from the fields below."""
AT_START = 64, 8
"""Prompts, and responses to each, that tell how the starting policy's scores are spread."""
RATIO_TOLERANCE = {torch.float32: 0.01, torch.bfloat16: 1.0, torch.float16: 0.3}
"""In half precision a decoding step rounds otherwise than a pass over all tokens."""


class TextLearnerSettings(Settings):
    """Policy gradients on a learned reward, held near the starting policy by a KL penalty; RLOO by default."""

    kind: Literal["text"] = "text"
    algorithm: Literal["rloo", "grpo", "reinforce", "ppo"] = "rloo"
    """What fills in the defaults: rloo (Ahmadian et al. 2024), grpo (Shao et al. 2024, with another KL, see below),
    reinforce (Williams 1992) with the batch's mean as its baseline, or ppo (Ziegler et al. 2019) with a critic.
    Anything that is set beside it stands."""
    updates: int = Field(15, ge=1)
    """Batches of a round."""
    prompts: int = Field(16, ge=1)
    """P: prompts of a batch."""
    responses: int = Field(8, ge=1)
    """K: responses to each prompt; one for PPO's own 128 prompts."""
    epochs: int = Field(1, ge=1)
    """Passes over each batch."""
    minibatches: int = Field(1, ge=1)
    """Gradient steps of a pass."""
    advantage: Literal["leave_one_out", "group_normalised", "batch_scaled", "batch_mean", "gae"] = "leave_one_out"
    """What is taken off a response's return: the mean of its prompt's others (RLOO), its group's mean, over the group's
    std (GRPO) or the batch's, or the batch's mean (REINFORCE); or of a token, what a critic expected (`gae`, PPO)."""
    critic: CriticSettings = CriticSettings()
    """Of advantage `gae`."""
    clip: float | None = Field(None, gt=0)
    """How far the ratio of new to old probability counts (PPO, GRPO); null for the plain policy gradient."""
    beta: float = Field(0.3, ge=0)
    """Weight of the KL to the starting policy (or to `reference_every`'s), in units of reward a nat."""
    kl_in: Literal["reward", "advantage", "token"] = "reward"
    """Where the KL is taken off: the reward, before the baseline; the advantage, after it was normalised; or the
    advantage of each token, that of the tokens from it on, without a baseline (`token`, OpenRLHF's)."""
    whiten: bool = False
    """Scale the advantages to mean 0 and variance 1 over the tokens of a batch; PPO does unless told not to."""
    kl_target: float | None = Field(None, gt=0)
    """Steer beta to this KL in nats per response (Ziegler et al. 2019); null leaves it alone."""
    kl_stop: float | None = Field(None, gt=0)
    """End a round's updates once a batch is farther than this from the starting policy, in nats per response."""
    kl_horizon: float = Field(10_000.0, gt=0)
    """Responses over which beta is steered."""
    reference_every: int | None = Field(None, ge=1)
    """Move what the KL holds the policy near towards it, each time after so many updates (Gorbatovski et al. 2024);
    null for the starting policy throughout."""
    reference_mix: float = Field(0.6, gt=0, le=1)
    """How far: the share of the policy's parameters in what comes out."""
    reduction: Reduction = "constant"
    """How steps are averaged: `constant` (sums over a response), `token` or `sequence` (see docs)."""
    optimizer: Literal["adam", "sgd"] = "adam"
    """What takes the steps: Adam, or the gradient itself (`sgd`, without momentum), which moves each weight as much as
    its gradient says, and wants a learning rate some hundreds of times as large."""
    learning_rate: float = Field(5e-4, gt=0)
    """The optimiser's."""
    schedule: Schedule = "constant"
    """Of the learning rate: it stays, or it falls towards 0 along a line over a round's batches, and begins anew in the
    next."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    temperature: float = Field(1.0, gt=0)
    """Of sampling while learning and asking, and of every log-probability in the objective."""
    missing_end_penalty: float = Field(1.0, ge=0)
    """Taken off the score of a response that reached the task's most tokens without an end token."""
    drop_unended: bool = False
    """Leave responses without an end token out, as if nothing had scored them, in place of the penalty (DAPO, Yu et al.
    2025)."""
    length_cost: float = 0.0
    """Taken off the score for each token."""
    score: Literal["raw", "win_rate", "log_quantile"] = "raw"
    """What is learned from: the score itself; how often it is the higher one, s(its score - another's) in the mean over
    a prompt's responses (`win_rate`, 0 to 1); or the log of the share of the start's responses that it beats
    (`log_quantile`), whose optimum with beta = 1 / (n - 1) is the best of n. These are other objectives: see docs."""
    reward_clip: float | None = Field(None, gt=0)
    """A score is cut to this size, before anything is taken off it."""
    asked_responses: int = Field(4, ge=2)
    """Responses to each prompt that is sampled for being asked about."""
    evaluation_prompts: int = Field(128, ge=1)
    """Each gets one response at temperature 1."""
    policy: LanguageSettings = LanguageSettings()
    """What of the model is trained, and how much of it at once."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("algorithm") == "ppo" and "prompts" in given:
            # One response each is for PPO's own 128 prompts: 6 prompts need more.
            given = {"responses": cls.model_fields["responses"].default} | given
        return filled_in(given, ALGORITHMS)

    @model_validator(mode="after")
    def _advantage_fits(self) -> TextLearnerSettings:
        if self.advantage not in ("batch_mean", "gae") and self.responses < 2:
            raise ValueError(f"advantage {self.advantage} needs at least 2 responses, got {self.responses}")
        if self.score == "win_rate" and self.advantage != "leave_one_out":
            raise ValueError("score win_rate compares a prompt's responses: it wants advantage leave_one_out")
        if self.advantage == "gae" and self.policy.shard != "none":
            raise ValueError("a critic is kept whole: with policy.shard set choose an algorithm without one")
        if self.advantage != "gae" and self.critic != CriticSettings():
            raise ValueError(f"advantage {self.advantage} has no critic: set algorithm=ppo, or leave critic out")
        if self.advantage == "gae" and self.kl_in != "reward":
            raise ValueError("advantage gae takes the KL off token by token, as a reward: set kl_in=reward")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> TextLearnerSettings:
        if self.clip is None and self.epochs * self.minibatches > 1:
            raise ValueError("several gradient steps on a batch (epochs x minibatches > 1) need a clip: set clip=0.2")
        if self.minibatches > self.prompts * self.responses:
            raise ValueError(f"{self.prompts} x {self.responses} responses cannot be {self.minibatches} minibatches")
        if self.reference_every and self.reference_mix < 1 and self.policy.train == "lora":
            raise ValueError("parts of two adapters are no adapter between the two: with LoRA set reference_mix=1")
        if self.reference_every and self.policy.shard != "none":
            raise ValueError("a reference that moves is kept whole: with policy.shard set reference_every=null")
        if self.reference_every and (self.beta == 0 or self.kl_stop is not None):
            raise ValueError("a reference that moves is for beta above 0, and kl_stop is for one that does not")
        if self.kl_target is not None and self.beta == 0:
            raise ValueError("kl_target steers beta, so beta must start above 0")
        return self

    def shrunk(self) -> TextLearnerSettings:
        return self.model_copy(update={"updates": 1, "prompts": min(self.prompts, 4), "evaluation_prompts": 8})

    def with_evaluation_of(self, other: TextLearnerSettings) -> TextLearnerSettings:
        return self.model_copy(update={"evaluation_prompts": other.evaluation_prompts})

    def work(self) -> float:
        return float(self.updates * self.prompts)

    @property
    def discount(self) -> float:
        """A response is scored as a whole: no token counts for less because it comes later."""
        return 1.0

    def build(self, task: Task, rng: np.random.Generator) -> TextLearner:
        return TextLearner(self, text(task, f"learner kind {self.kind!r} writes text"), rng)

    def formula(self) -> str:
        """The objective, as text."""
        return text_formula(self)


class TextLearner:
    """A `prefrl.protocols.Learner` of responses. A response is an episode, its tokens are the actions.

    Log-probabilities are kept from sampling, so the old policy is never run again.
    """

    def __init__(self, settings: TextLearnerSettings, task: TextTask, rng: np.random.Generator) -> None:
        self._settings, self._task = settings, task
        network = settings.critic.network if settings.advantage == "gae" else None
        self._writer = Writer(task, settings, rng, settings.temperature, network, settings.optimizer)
        self.policy = self._writer.policy
        self._kl = AdaptiveKL(settings.beta, settings.kl_target or 1.0, settings.kl_horizon)
        self._updates = 0
        self._reference: State = self.policy.state() if settings.reference_every else {}
        """What the policy's parameters are held near, where that moves."""
        self._start_scores = torch.zeros(0)
        """(N,) of the starting policy's responses by the newest reward: anew in each round that needs them."""

    @property
    def steps(self) -> Steps:
        return self._writer.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Response]:
        """Groups of `asked_responses` responses to random prompts."""
        return self._writer.ask(count, self._settings.asked_responses, rng)

    def improve(self, reward: RewardModel[Response], store: Store[Response], rng: np.random.Generator) -> Metrics:
        """`updates` batches of fresh responses, or fewer where they end at `kl_stop`; the metrics are means over them.

        reward and reward_std (learned scores before penalties), kl (k1, nats per response), surprise (nats per token:
        minus the mean log-probability of what was sampled), length (tokens), ended (share), beta, and those of the last
        `gradient.step`; ratio_error is the largest before a batch's first step: 0 to rounding.
        """
        seen: dict[str, list[float]] = defaultdict(list)
        if self._settings.critic.network == "reward" and not self._updates:
            start_from_reward(self.policy, reward)
        if self._settings.score == "log_quantile":
            written = self._writer.write_at_start(*AT_START, rng)
            self._start_scores = self._shaped(self._scored(written, reward), written)
        for _ in self._writer.paced(range(self._settings.updates)):
            drawn = self._writer.write(self._settings.prompts, self._settings.responses, rng)
            measured = self._update(drawn, reward, rng)
            for name, value in measured.items():
                seen[name].append(value)
            self._updates += 1
            self._move_reference()
            if self._settings.kl_stop is not None and measured["kl"] > self._settings.kl_stop:
                break
        means = {name: mean(values) for name, values in seen.items()}
        return means | {"ratio_error": max(seen["ratio_error"]), "updates": float(len(seen["ratio_error"]))}

    def check_reward(self, reward: RewardModel[Response]) -> None:
        if self._settings.critic.network == "reward":
            check_start(self.policy, reward)

    def evaluate(self, reward: RewardModel[Response], rng: np.random.Generator) -> Evaluation[Response]:
        return self._writer.evaluate(self._settings.evaluation_prompts, reward, rng)

    def state(self) -> State:
        held = {"updates": self._updates, "beta": self._kl.beta}
        reference = {name: value.clone() for name, value in self._reference.items()}
        return self._writer.state() | held | ({"reference": reference} if reference else {})

    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        self._writer.load(state)
        self._updates, self._kl = int(state["updates"]), replace(self._kl, beta=float(state["beta"]))
        reference = state.get("reference", {})
        if set(reference) != set(self._reference):
            raise ValueError("policy: its reference is missing, or is one too many: it was made by other settings")
        for name, value in self._reference.items():
            value.copy_(reference[name])

    def _update(self, drawn: Responses, reward: RewardModel[Response], rng: np.random.Generator) -> Metrics:
        """Learn from one batch."""
        settings = self._settings
        raw = self._scored(drawn, reward)
        scores = finite("reward", self._shaped(raw, drawn), self._updates)  # NaN: what was not scored teaches nothing
        if settings.score == "win_rate":
            scores = win_rates(scores.view(-1, settings.responses)).flatten()
        elif settings.score == "log_quantile":
            scores = log_quantiles(scores, self._start_scores)
        reference = self._reference_logp(drawn)
        kl = torch.where(drawn.mask, kl_k1(drawn.logp, reference), 0.0)  # (B, L)
        batch, explained = self._batch(drawn, scores, kl)
        rows, objective = self._minibatches(len(batch), rng), self._objective()
        with enough_memory("learner.policy.chunk", settings.policy.chunk):
            steps = update(self.policy, self._writer.optimizer, batch, rows, objective, settings.policy.chunk)
        most = RATIO_TOLERANCE[self.policy.model.dtype]
        check_ratio(steps[0]["ratio_error"], most, self._updates, "set task.dtype=float32")
        # Per response, as the target is: a mean per token would be smaller by the length.
        sequence_kl = float(kl.sum(1).mean())
        if settings.kl_target is not None:
            self._kl = self._kl.update(sequence_kl, len(batch))
        return steps[-1] | {
            "ratio_error": steps[0]["ratio_error"],
            **rewarded(raw, scores),
            **(distances(kl, drawn.mask) if self._measures else {}),  # what was not measured is absent, not 0
            **explained,
            "surprise": -float(masked_mean(drawn.logp, drawn.mask)),
            "length": float(drawn.mask.sum(1).float().mean()),
            "ended": float(drawn.ended.float().mean()),
            "beta": self._kl.beta,
            **equal_groups(scores.view(-1, settings.responses)),
        }

    def _batch(self, drawn: Responses, scores: Tensor, kl: Tensor) -> tuple[Batch[Responses], Metrics]:
        """What a gradient step is made of, from scores (B,) and the KL of each token (B, L)."""
        settings = self._settings
        if settings.advantage == "gae":
            return by_token(self.policy, drawn, scores, kl, self._kl.beta, settings.critic.trace, settings.whiten)
        known = drawn.mask & ~scores.isnan()[:, None]
        # All responses to a prompt stand together.
        how = Weighing(settings.advantage, settings.kl_in, self._kl.beta)
        advantages = by_group(scores, kl, drawn.mask, settings.responses, how).view(-1, 1)
        if settings.kl_in == "token":
            following = kl.flip(1).cumsum(1).flip(1)  # (B, L): of each token and those after it
            advantages = torch.where(known, advantages - self._kl.beta * following, 0.0)
        if settings.whiten:
            advantages = masked_whiten(advantages.expand_as(known), known)
        return Batch(drawn, drawn.logp, advantages), {}

    def _objective(self) -> Objective:
        """What a gradient step minimises."""
        settings, critic = self._settings, self._settings.critic
        objective = Objective(clip=settings.clip, reduction=settings.reduction, max_grad_norm=settings.max_grad_norm)
        if settings.advantage != "gae":
            return objective
        return replace(objective, value=critic.weight, value_clip=critic.clip)

    def _reference_logp(self, drawn: Responses) -> Tensor:
        """(B, L) under the reference; where the KL does not count that is not run, and the policy stands in."""
        if not self._measures:
            return drawn.logp
        return self.policy.logp_at(self._reference, drawn) if self._reference else self.policy.start_logp(drawn)

    def _move_reference(self) -> None:
        every, mix = self._settings.reference_every, self._settings.reference_mix
        if every and self._updates % every == 0:
            for name, value in self.policy.state().items():
                self._reference[name].lerp_(value, mix)

    @property
    def _measures(self) -> bool:
        """Whether anything wants to know how far the policy is from where it started."""
        return self._settings.beta > 0 or self._settings.kl_stop is not None

    def _minibatches(self, size: int, rng: np.random.Generator) -> list[Tensor]:
        settings = self._settings
        found = minibatches(size, settings.epochs, settings.minibatches, rng, self.policy.device)
        self.policy.check_share(min(map(len, found)))
        return found

    def _scored(self, drawn: Responses, reward: RewardModel[Response]) -> Tensor:
        """(B,) scores as the reward gives them."""
        found = scored(reward, drawn.candidates(self._task.tokenizer))
        return torch.as_tensor(found, dtype=torch.float32, device=self.policy.device)

    def _shaped(self, raw: Tensor, drawn: Responses) -> Tensor:
        """(B,): the scores that are learned from, NaN where there is none."""
        settings = self._settings
        kept = raw if settings.reward_clip is None else raw.clamp(-settings.reward_clip, settings.reward_clip)
        if settings.drop_unended:
            kept = torch.where(drawn.ended, kept, math.nan)
        return kept - settings.missing_end_penalty * ~drawn.ended - settings.length_cost * drawn.mask.sum(1)


def text_formula(settings: TextLearnerSettings) -> str:
    """The objective in plain letters, with the settings' numbers."""
    index = "A_t" if settings.advantage == "gae" or settings.kl_in == "token" else "A_i"
    gain = f"log pi(y_t) {index}"
    if settings.clip is not None:
        gain = f"min(r {index}, clip(r, {1 - settings.clip:g}, {1 + settings.clip:g}) {index})"
    lines = [
        f"maximise  {AVERAGES[settings.reduction]} [ {gain} ]",
        *(["r = pi(y_t) / pi_old(y_t)"] if settings.clip is not None else []),
        *([_moves(settings)] if settings.reference_every and settings.beta else []),
        *(_with_critic(settings) if settings.advantage == "gae" else _without_critic(settings)),
        f"{settings.prompts} prompts x {settings.responses} responses a batch, "
        f"{settings.epochs * settings.minibatches} gradient step(s) on each; temperature {settings.temperature:g}",
    ]
    return "\n".join(lines)


def _with_critic(settings: TextLearnerSettings) -> list[str]:
    penalty = f" - {_beta(settings)} [log pi_old(y_t) - log ref(y_t)]" if settings.beta else ""
    return critic_formula(settings.critic, penalty, _score(settings), settings.whiten)


def _without_critic(settings: TextLearnerSettings) -> list[str]:
    apart = "sum_t [log pi_old(y_t) - log ref(y_t)]"
    others = "the batch's" if settings.advantage == "batch_mean" else "the prompt's other"
    after = {
        "reward": "",
        "advantage": f" - {_beta(settings)} (K_i - mean of {others} K_j),  K_i = {apart}",
        "token": f" - {_beta(settings)} K_t,  K_t = {apart.replace('sum_t', 'sum_(s >= t)').replace('y_t', 'y_s')}",
    }[settings.kl_in if settings.beta else "reward"]
    in_reward = f" - {_beta(settings)} {apart}" if settings.beta and not after else ""
    index = "A_t" if settings.kl_in == "token" else "A_i"
    advantage = f"{index} = {ADVANTAGES[settings.advantage]}{after}{';  whitened' if settings.whiten else ''}"
    if settings.score != "win_rate":
        return [advantage, f"R_i = {_score(settings)}{in_reward}"]
    won = f"mean of s(x_i - x_j) over all of the prompt's {settings.responses},  s(d) = 1 / (1 + exp(-d))"
    return [advantage, f"R_i = w_i{in_reward},  w_i = {won}", f"x_i = {_score(settings)}"]


def _beta(settings: TextLearnerSettings) -> str:
    return f"{settings.beta:g}" + (f" (steered to {settings.kl_target:g} nats)" if settings.kl_target else "")


def _moves(settings: TextLearnerSettings) -> str:
    mix = settings.reference_mix
    return f"ref <- {1 - mix:.2g} ref + {mix:g} pi after each {settings.reference_every} updates"


def _score(settings: TextLearnerSettings) -> str:
    """What is learned from of a response's score."""
    score = "score(y_i)" if settings.reward_clip is None else f"clip(score(y_i), +-{settings.reward_clip:g})"
    cost = f" - {settings.length_cost:g} tokens(y_i)" if settings.length_cost else ""
    penalised = settings.missing_end_penalty and not settings.drop_unended
    end = f" - {settings.missing_end_penalty:g} [no end token]" if penalised else ""
    whole = score + end + cost
    if settings.score == "log_quantile":
        whole = f"log of the share of the start's responses that {whole} beats"
    return whole + (", of responses with an end token alone" if settings.drop_unended else "")
