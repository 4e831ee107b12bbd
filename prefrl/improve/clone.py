"""Behavioural cloning: the policy is fitted on what demonstrations show, by maximum likelihood.

Variant: all demonstrations so far, anew in each round from where the policy is, so that with an expert who answers
about the learner's own states it is DAgger (Ross et al. 2011). Cross-entropy for discrete actions; for others a
Gaussian whose std is fixed, which is the squared error, or learned; for a flow minus its flow-matching loss on new
draws in each pass. The normaliser sees each demonstration once, and the policy's first layers follow it, so that what
was learned stays.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from prefrl.improve.offline import Material, Offline, OfflineSettings, gaussian
from prefrl.policies.flow import FlowPolicySettings
from prefrl.protocols import RewardModel, Task, control
from prefrl.types import Metrics, Segment


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
    policy: FlowPolicySettings | None = None
    """A flow in place of the perceptron that `hidden`, `std` and `learn_std` are about: for demonstrations that go one
    way or another (`kind: flow`)."""
    discount: float = Field(1.0, gt=0, le=1)
    """Of the learned reward, where there is one to report; cloning does not look at it."""

    def work(self) -> float:
        return float(self.cloning_epochs)

    def build(self, task: Task, rng: np.random.Generator) -> Offline[Any]:
        found = control(task, f"learner kind {self.kind!r} clones behaviour of control")
        if self.policy is not None:
            return Offline(self, found, improve, self.policy.build(found, rng), self.discount)
        policy = gaussian(self, found, rng, learns_std=self.learn_std)
        return Offline(self, found, improve, policy, self.discount)

    def formula(self) -> str:
        steps = f"all steps of all demonstrations, {self.cloning_epochs} epochs in a round"
        if self.policy is not None:
            flow = "minimise  mean[ |v(s, (1 - t) e + t a, t) - (a - e)|^2 ],  e ~ N(0, 1), t ~ U(0, 1)"
            return f"{flow}\n(s, a): {steps}, a the next {self.policy.chunk} actions"
        return f"maximise  mean[ log pi(a|s) ]\n(s, a): {steps}"


def improve(
    learner: Offline[Any], material: Material, reward: RewardModel[Segment], rng: np.random.Generator
) -> Metrics:
    """Nothing more: `Offline` clones before it comes here. Metrics: demonstrations, how many."""
    return {"demonstrations": float(len(material.segments))}
