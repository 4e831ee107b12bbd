"""Behavioural cloning: the policy is fitted on what demonstrations show, by maximum likelihood.

Variant: all demonstrations so far, anew in each round from where the policy is, so that with an expert who answers
about the learner's own states it is DAgger (Ross et al. 2011). Cross-entropy for discrete actions; for others a
Gaussian whose std is fixed, which is the squared error, or learned; for a flow minus its flow-matching loss on new
draws in each pass. A policy with a memory (temporal imitation) reads each demonstration from its first step on, in
pieces that begin with what the network remembered there at the start of the pass. The normaliser sees each
demonstration once, and the policy's first layers follow it, so that what was learned stays.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from prefrl.improve.offline import Material, Offline, OfflineSettings, gaussian
from prefrl.policies.acting import Clonable
from prefrl.policies.flow import FlowPolicySettings
from prefrl.policies.gru import GRUPolicySettings
from prefrl.policies.heads import HeadSettings
from prefrl.policies.transformer import TransformerPolicySettings
from prefrl.protocols import ControlTask, RewardModel, Task, control
from prefrl.types import Metrics, Segment

Network: TypeAlias = Annotated[
    FlowPolicySettings | GRUPolicySettings | TransformerPolicySettings, Field(discriminator="kind")
]


class CloneSettings(OfflineSettings):
    """Do what was shown: the likelihood of all demonstrations so far is raised in each round."""

    kind: Literal["clone"] = "clone"
    imitates: ClassVar[bool] = True
    cloning_epochs: int = Field(200, ge=1)
    """Passes over all demonstrations in a round."""
    cloning_minibatch: int = Field(64, ge=1)
    """Steps in a gradient step."""
    learn_std: bool = False
    """Learn the std of continuous actions as well; without it the loss is the squared error."""
    policy: Network | None = None
    """In place of the perceptron that `hidden` is about: a flow, for demonstrations that go one way or another (`kind:
    flow`), or networks with a memory, where what to do hangs on what came before (`gru`, `transformer`)."""
    discount: float = Field(1.0, gt=0, le=1)
    """Of the learned reward, where there is one to report; cloning does not look at it."""

    @model_validator(mode="after")
    def _one_std(self) -> CloneSettings:
        if isinstance(self.policy, HeadSettings) and (self.policy.sde or self.policy.initial_std != 1):
            raise ValueError("std and learn_std say how noisy a clone is: leave policy.initial_std and policy.sde out")
        return self

    def work(self) -> float:
        return float(self.cloning_epochs)

    def build(self, task: Task, rng: np.random.Generator) -> Offline[Any]:
        found = control(task, f"learner kind {self.kind!r} clones behaviour of control")
        return Offline(self, found, improve, self._network(found, rng), self.discount)

    def _network(self, task: ControlTask, rng: np.random.Generator) -> Clonable[Any]:
        if self.policy is None:
            return gaussian(self, task, rng, learns_std=self.learn_std)
        if isinstance(self.policy, FlowPolicySettings):
            return self.policy.build(task, rng)
        policy = self.policy.model_copy(update={"initial_std": self.std}).build(task, rng)
        return policy if self.learn_std else policy.with_std_kept()

    def formula(self) -> str:
        steps = f"all steps of all demonstrations, {self.cloning_epochs} epochs in a round"
        if isinstance(self.policy, FlowPolicySettings):
            flow = "minimise  mean[ |v(s, (1 - t) e + t a, t) - (a - e)|^2 ],  e ~ N(0, 1), t ~ U(0, 1)"
            return f"{flow}\n(s, a): {steps}, a the next {self.policy.chunk} actions"
        given = "s" if self.policy is None else "s, and what came before"
        return f"maximise  mean[ log pi(a|{given}) ]\n(s, a): {steps}"


def improve(
    learner: Offline[Any], material: Material, reward: RewardModel[Segment], rng: np.random.Generator
) -> Metrics:
    """Nothing more: `Offline` clones before it comes here. Metrics: demonstrations, how many."""
    return {"demonstrations": float(len(material.segments))}
