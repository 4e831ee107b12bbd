"""Policy gradients for pictures, on the learned reward: DDPO, DPOK.

Variant: DDPO with importance sampling (Black et al. 2024, equation 6) and DPOK (Fan et al. 2023, equation 11), by the
update that text and control learn with: a denoising step is a token that is drawn from a Gaussian. One advantage a
picture, by its group's mean. What differs: log-probabilities are sums over pixels, not means, so that a clip is one of
true ratios; DDPO too is held by a KL, in the reward (k1) unless told otherwise. As DPOK's, a KL in the loss charges
each step for itself, not for the steps that it leads to. Left out: statistics of the reward over batches.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.components import Settings, filled_in
from prefrl.improve.gradient import Batch, update
from prefrl.improve.groups import (
    ADVANTAGES,
    AVERAGES,
    Weighing,
    by_group,
    check_ratio,
    equal_groups,
    finite,
    mean,
    minibatches,
    rewarded,
)
from prefrl.improve.objectives import AdaptiveKL, Objective, Reduction, kl_k1
from prefrl.improve.painter import Painter
from prefrl.policies.denoiser import Chains, DenoisingSettings
from prefrl.protocols import PictureTask, RewardModel, Store, Task, pictures
from prefrl.seeding import Device
from prefrl.types import Evaluation, Metrics, Picture, State, Steps

ALGORITHMS: dict[str, dict[str, Any]] = {
    "ddpo": {"clip": 0.2, "minibatches": 2},
    "dpok": {"kl_in": "loss"},
}
"""Defaults that differ from those of the fields below."""
RATIO_TOLERANCE = 1e-3
"""It is exactly 0 where a row's products do not depend on the others beside it."""


class PictureLearnerSettings(Settings):
    """Policy gradients on a learned reward of pictures, held near the starting denoiser; DDPO by default."""

    kind: Literal["pictures"] = "pictures"
    algorithm: Literal["ddpo", "dpok"] = "ddpo"
    """What fills in the defaults: ddpo (Black et al. 2024), with a clip, or dpok (Fan et al. 2023), with the exact KL
    in the loss. Anything that is set beside it stands."""
    updates: int = Field(8, ge=1)
    """Batches of a round."""
    groups: int = Field(1, ge=1)
    """P: groups of a batch, each of one caption; all of the task's come in turn."""
    pictures: int = Field(128, ge=2)
    """K: pictures of each group."""
    epochs: int = Field(1, ge=1)
    """Passes over each batch."""
    minibatches: int = Field(1, ge=1)
    """Gradient steps of a pass."""
    advantage: Literal["leave_one_out", "group_normalised", "batch_scaled", "batch_mean"] = "leave_one_out"
    """What is taken off a picture's return: the mean of its group's others, its group's mean, over the group's std
    or the batch's, or the batch's mean."""
    clip: float | None = Field(None, gt=0)
    """How far the ratio of new to old probability of a step counts; null for the plain policy gradient."""
    beta: float = Field(0.005, ge=0)
    """Weight of the KL to the starting policy, in units of reward a nat."""
    kl_in: Literal["reward", "advantage", "loss"] = "reward"
    """Where the KL is taken off: the reward, before the baseline; the advantage, after it was normalised; or as a term
    of the loss, exact at each step (`loss`, DPOK)."""
    kl_target: float | None = Field(None, gt=0)
    """Steer beta to this KL in nats per picture; null leaves it alone."""
    kl_stop: float | None = Field(None, gt=0)
    """End a round's updates once a batch is farther than this from the starting policy, in nats per picture."""
    kl_horizon: float = Field(2000.0, gt=0)
    """Pictures over which beta is steered."""
    diversity: float = Field(0.0, ge=0)
    """Added to a picture's score for each unit of its mean distance from the others of its group, as points whose
    coordinates are pixels from 0 to 1: a remedy for pictures that become all alike."""
    reduction: Reduction = "constant"
    """How steps are averaged: `constant` (sums over a chain), or `token` and `sequence`, which are one here."""
    learning_rate: float = Field(3e-4, gt=0)
    """Adam's."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    evaluation_pictures: int = Field(256, ge=2)
    """About how many are drawn to evaluate on, as many of each caption."""
    policy: DenoisingSettings = DenoisingSettings()
    """How much goes through the denoiser at once."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        return filled_in(given, ALGORITHMS)

    @model_validator(mode="after")
    def _consistent(self) -> PictureLearnerSettings:
        if self.clip is None and self.epochs * self.minibatches > 1:
            raise ValueError(
                "several gradient steps on a batch (epochs x minibatches > 1) need a clip: set clip=0.2, or epochs=1 "
                "and minibatches=1"
            )
        if self.minibatches > self.groups * self.pictures:
            raise ValueError(f"{self.groups} x {self.pictures} pictures cannot be {self.minibatches} minibatches")
        if self.kl_target is not None and self.beta == 0:
            raise ValueError("kl_target steers beta, so beta must start above 0")
        return self

    def shrunk(self) -> PictureLearnerSettings:
        return self.model_copy(update={"updates": 1, "pictures": 16, "evaluation_pictures": 8})

    def with_evaluation_of(self, other: PictureLearnerSettings) -> PictureLearnerSettings:
        return self.model_copy(update={"evaluation_pictures": other.evaluation_pictures})

    def work(self) -> float:
        return float(self.updates * self.groups * self.pictures)

    @property
    def discount(self) -> float:
        """A picture is scored as a whole: no step counts for less because it comes later."""
        return 1.0

    def build(self, task: Task, rng: np.random.Generator) -> PictureLearner:
        return PictureLearner(self, pictures(task, f"learner kind {self.kind!r} draws pictures"))

    def formula(self) -> str:
        """The objective, as text."""
        gain = "log pi(x_t) A_i"
        if self.clip is not None:
            gain = f"min(r A_i, clip(r, {1 - self.clip:g}, {1 + self.clip:g}) A_i)"
        apart = "sum_t [log pi_old(x_t) - log ref(x_t)]"
        held = {
            "reward": ("", f" - {self.beta:g} {apart}", ""),
            "advantage": ("", "", f" - {self.beta:g} (K_i - mean of the group's other K_j),  K_i = {apart}"),
            "loss": (f" - {self.beta:g} KL(pi(x_t) || ref(x_t))", "", ""),
        }[self.kl_in if self.beta else "reward"]
        in_loss, in_reward, after = held if self.beta else ("", "", "")
        varied = f" + {self.diversity:g} (mean distance from the group's others)" if self.diversity else ""
        advantage = ADVANTAGES[self.advantage].replace("the prompt's", "the group's")
        lines = [
            f"maximise  {AVERAGES[self.reduction]} [ {gain}{in_loss} ],  x_t: a denoising step",
            *(["r = pi(x_t) / pi_old(x_t)"] if self.clip is not None else []),
            f"A_i = {advantage}{after}",
            f"R_i = score(x_i){varied}{in_reward}",
            f"{self.groups} groups x {self.pictures} pictures a batch, "
            f"{self.epochs * self.minibatches} gradient step(s) on each",
        ]
        return "\n".join(lines)


class PictureLearner:
    """A `prefrl.protocols.Learner` of pictures. A picture is an episode, its denoising steps are the actions.

    Log-probabilities are kept from sampling, so the old policy is never run again.
    """

    def __init__(self, settings: PictureLearnerSettings, task: PictureTask) -> None:
        self._settings, self._task = settings, task
        self._painter = Painter(task, settings.policy, settings.learning_rate, settings.device)
        self.policy = self._painter.policy
        self._kl = AdaptiveKL(settings.beta, settings.kl_target or 1.0, settings.kl_horizon)
        self._updates = 0

    @property
    def steps(self) -> Steps:
        return self._painter.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Picture]:
        return self._painter.ask(count, rng)

    def improve(self, reward: RewardModel[Picture], store: Store[Picture], rng: np.random.Generator) -> Metrics:
        """`updates` batches of fresh pictures, or fewer where they end at `kl_stop`; the metrics are means over them.

        reward and reward_std (learned scores as they are), unscored (share), apart (mean distance within a group), kl
        (exact, nats per picture), beta, equal_groups, and those of the last `gradient.step`; ratio_error is the largest
        before a batch's first step: 0 to rounding.
        """
        seen: dict[str, list[float]] = defaultdict(list)
        for _ in range(self._settings.updates):
            drawn = self._painter.paint(self._settings.groups, self._settings.pictures, rng)
            measured = self._update(drawn, reward, rng)
            for name, value in measured.items():
                seen[name].append(value)
            self._updates += 1
            if self._settings.kl_stop is not None and measured["kl"] > self._settings.kl_stop:
                break
        means = {name: mean(values) for name, values in seen.items()}
        return means | {"ratio_error": max(seen["ratio_error"]), "updates": float(len(seen["ratio_error"]))}

    def evaluate(self, reward: RewardModel[Picture], rng: np.random.Generator) -> Evaluation[Picture]:
        return self._painter.evaluate(self._settings.evaluation_pictures, reward, rng)

    def state(self) -> State:
        return self._painter.state() | {"updates": self._updates, "beta": self._kl.beta}

    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        self._painter.load(state)
        self._updates, self._kl = int(state["updates"]), replace(self._kl, beta=float(state["beta"]))

    def _update(self, drawn: Chains, reward: RewardModel[Picture], rng: np.random.Generator) -> Metrics:
        """Learn from one batch."""
        settings, size, device = self._settings, self._settings.pictures, self.policy.device
        found = reward.score(drawn.candidates(self._task.captions))  # (B,)
        raw, varied = torch.as_tensor(found, dtype=torch.float32, device=device), apart(drawn.pixels, size)
        scores = finite("reward", raw + settings.diversity * varied, self._updates)
        how = Weighing(settings.advantage, settings.kl_in, self._kl.beta)
        start, kls = self.policy.start_logp_and_kl(drawn)  # (B, L) each
        kl = kls.sum(1)
        batch = Batch(drawn, drawn.logp, by_group(scores, kl_k1(drawn.logp, start), drawn.mask, size, how).view(-1, 1))
        rows = minibatches(len(batch), settings.epochs, settings.minibatches, rng, device)
        steps = update(self.policy, self._painter.optimizer, batch, rows, self._objective(), settings.policy.chunk)
        check_ratio(steps[0]["ratio_error"], RATIO_TOLERANCE, self._updates, "lower learner.policy.chunk")
        if settings.kl_target is not None:
            self._kl = self._kl.update(float(kl.mean()), len(batch))
        return steps[-1] | {
            "ratio_error": steps[0]["ratio_error"],
            **rewarded(raw, scores),
            "apart": float(varied.mean()),
            "kl": float(kl.mean()),
            "beta": self._kl.beta,
            **equal_groups(raw.view(-1, size)),
        }

    def _objective(self) -> Objective:
        """What a gradient step minimises."""
        settings = self._settings
        held = self._kl.beta if settings.kl_in == "loss" else 0.0
        return Objective(
            clip=settings.clip, reduction=settings.reduction, max_grad_norm=settings.max_grad_norm, kl=held
        )


def apart(pixels: Tensor, size: int) -> Tensor:
    """(B,): the mean distance of a picture from the others of its group, of pixels (B, ...) in bytes.

    Groups of `size` stand together.
    """
    points = pixels.view(-1, size, pixels[0].numel()).float() / 255  # (P, K, D)
    return torch.cdist(points, points).sum(2).flatten() / (size - 1)
