"""A reward that is linear in features of a step, with the posterior of its weights in closed form.

Variant: the Bayesian linear reward of Sadigh et al. 2017 with a Gaussian prior and Laplace's approximation (MacKay
2003, chapter 27), where the paper has a prior on the unit ball and Metropolis samples. The members are draws whose
noise is fixed when the model is built. Left out: a prior that is learned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field
from scipy.optimize import minimize
from torch import Tensor

from prefrl.components import Settings
from prefrl.protocols import Task, control
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.steps import CACHED, OWN_FEATURES, StepReward, described, input_width
from prefrl.seeding import to_numpy
from prefrl.types import Floats

STEPS = 200
"""Newton steps before giving up; a convex loss takes about ten."""
Loss = Callable[[Tensor], Tensor]
OWN = (*OWN_FEATURES, "quadratic")
"""Features that need no other package."""


class LinearSettings(Settings):
    """A linear reward with a Gaussian prior; the members are draws from the posterior of its weights."""

    kind: Literal["linear"] = "linear"
    members: int = Field(8, ge=1)
    """E: draws from the posterior, in pairs around its mode; where E is odd, one is the mode itself."""
    features: str = "inputs"
    """A step's observation and action, standardised (`inputs`); these, their squares less 1, and their products
    (`quadratic`); its observation alone (`observations`), where there are many actions and what they do is seen a step
    later; or hand-made features, by their name in the entry-point group `prefrl.features`."""
    prior_std: float = Field(10.0, gt=0)
    """The prior's spread of a weight: by how many logits one standard deviation of a feature, kept up over a segment
    of the usual length, makes it better."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> StepReward:
        """Raises `ConfigError` for features that no installed package has."""
        found = control(task, f"reward kind {self.kind!r} scores control segments")
        describe = described(self.features, OWN)
        network = Linear(self, input_width(found, describe), rng)
        return StepReward(network, found, 1.0, self.combine, solve=network.solve, describe=describe)


class Linear:
    """A `Network` without parameters to descend: E weight vectors, all from one maximum and its curvature.

    The posterior is Laplace's: N(w, H^-1), with w the maximum of likelihood times prior and H the Hessian of its
    negative logarithm there (MacKay 2003, chapter 27). The draws are w +- H^(-1/2) z with z fixed when the model is
    built: the members' mean is w, and the same judgements give the same members.
    """

    memory = 1

    def __init__(self, settings: LinearSettings, inputs: int, rng: np.random.Generator) -> None:
        self.members = settings.members
        self.most = CACHED // settings.members
        self._prior_std = settings.prior_std
        self._quadratic = settings.features == "quadratic"
        size = inputs + (inputs * (inputs + 1) // 2 if self._quadratic else 0)
        half = rng.standard_normal((settings.members // 2, size))
        # In pairs around the mode, so that the members' mean is the mode itself and not a draw.
        draws = np.concatenate([half, -half, np.zeros((settings.members % 2, size))])
        self._draws = torch.from_numpy(draws)
        self._weight = (self._draws * settings.prior_std).float()[:, :, None]
        self._bias = torch.zeros(settings.members, 1, 1)

    def named(self) -> Mapping[str, Tensor]:
        return {"draws": self._draws, "weight": self._weight, "bias": self._bias}

    @property
    def first(self) -> tuple[Tensor, Tensor] | None:
        return None if self._quadratic else (self._weight, self._bias)

    def outputs(self, inputs: Tensor) -> Tensor:
        x = self.features(inputs).flatten(-3, -2).expand(self.members, -1, -1)  # (E, B T, d)
        return torch.baddbmm(self._bias, x, self._weight).view(self.members, *inputs.shape[-3:-1])

    def features(self, inputs: Tensor) -> Tensor:
        """(..., I) -> (..., d)."""
        if not self._quadratic:
            return inputs
        # each product once, squares among them
        i, j = torch.triu_indices(inputs.shape[-1], inputs.shape[-1], device=inputs.device)
        return torch.cat([inputs, inputs[..., i] * inputs[..., j] - (i == j).float()], -1)

    def solve(self, inputs: Tensor, counts: Tensor, loss: Loss) -> None:
        """Find the posterior. Raises ValueError for a candidate that is not finite, and where no maximum is found."""
        # (N, d), candidate by candidate: the features of all steps at once would be T times as large. In float64, since
        # the Hessian is factorised.
        design = torch.stack([count @ self.features(x) for x, count in zip(inputs, counts, strict=True)]).double()
        if not design.isfinite().all():
            at = int((~design.isfinite()).any(1).nonzero()[0])
            raise ValueError(f"candidate {at} of the fit has features that are not finite: look for NaN or inf in it")
        # The loss takes E rows of scores; all are the same here, and their mean is one member's.
        w, hessian = maximum(design, lambda scores: loss(scores.expand(self.members, -1)).mean(), self._prior_std)
        # H = L L' gives H^-1 = L^-T L^-1, so that L^-T z has this covariance.
        spread = torch.linalg.solve_triangular(torch.linalg.cholesky(hessian).T, self._draws.T, upper=True).T
        self._weight.copy_((w + spread)[:, :, None])
        self._bias.zero_()


def maximum(design: Tensor, loss: Loss, prior_std: float) -> tuple[Tensor, Tensor]:
    """The weights (d,) of most posterior density, and the Hessian (d, d) of its negative logarithm there.

    design (N, d): what a weight adds to each candidate's score; `loss` maps scores (N,) to one negative log-likelihood.
    Newton's method in a trust region (Nocedal and Wright 2006, section 4.3) finds its way where that is not convex.
    """

    def objective(w: Tensor) -> Tensor:
        return loss(design @ w) + 0.5 * (w / prior_std).square().sum()

    def value_and_gradient(at: Floats) -> tuple[float, Floats]:
        w = torch.tensor(at, device=design.device, requires_grad=True)
        with torch.enable_grad():
            value = objective(w)
            (gradient,) = torch.autograd.grad(value, w)
        return float(value), to_numpy(gradient)

    def hessian(at: Floats) -> Floats:
        with torch.enable_grad():
            found: Tensor = torch.autograd.functional.hessian(objective, torch.tensor(at, device=design.device))  # type: ignore[no-untyped-call]
        return to_numpy(found)

    options: Any = {"gtol": 1e-6, "maxiter": STEPS}
    start = np.zeros(design.shape[1])
    found = minimize(value_and_gradient, start, jac=True, hess=hessian, method="trust-exact", options=options)
    # scipy also gives up where rounding hides the last progress: what counts is that the slope is gone
    flat = np.linalg.norm(found.jac) < 1e-4 * max(1.0, float(np.linalg.norm(found.hess, 2)))
    if not (flat and np.linalg.eigvalsh(found.hess).min() > 0):
        raise ValueError(
            f"the linear reward's most probable weights were not found in {STEPS} Newton steps ({found.message}); "
            "make reward.prior_std smaller"
        )
    w, curvature = (torch.tensor(x, device=design.device) for x in (found.x, found.hess))
    return w, curvature
