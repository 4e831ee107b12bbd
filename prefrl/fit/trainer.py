"""Fit a reward model on the judgements of a store, by maximum likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
import torch
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from prefrl.components import Settings
from prefrl.fit.losses import bradley_terry, log_preference, preference_logits, weighted_mean
from prefrl.fit.metrics import accuracy, brier, calibration_error
from prefrl.protocols import RewardModel, Store
from prefrl.seeding import draw_seed
from prefrl.types import Batch, C, Fitted, Floats, Judged, Metrics, batch


class NothingToFit(ValueError):
    """There is no judgement that prefers anything."""


class FittingSettings(Settings):
    """How a reward model is fitted. Each fit continues from the last one's weights, on all judgements so far."""

    epochs: int = Field(20, ge=1)
    """The most passes over the training comparisons."""
    patience: int = Field(0, ge=0)
    """Stop after so many epochs without a better held-out loss, and go back to the best; 0 runs all epochs."""
    batch_size: int = Field(64, ge=1)
    """Comparisons in a gradient step."""
    learning_rate: float = Field(1e-3, gt=0)
    """AdamW's; it starts anew with every fit."""
    weight_decay: float = Field(0.0, ge=0)
    """AdamW's decoupled weight decay."""
    error_rate: float = Field(0.0, ge=0, lt=1)
    """The assumed probability that an answer is a coin flip."""
    held_out: float = Field(0.15, ge=0, lt=1)
    """The share of comparisons that is never trained on, and measures accuracy and calibration."""
    bootstrap: bool = True
    """Give each member of an ensemble its own resampling of the training comparisons."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""


def fit(reward: RewardModel[C], store: Store[C], fitting: FittingSettings, rng: np.random.Generator) -> Fitted:
    """Fit `reward` on a snapshot of the store: all judgements up to its newest event.

    Raises `NothingToFit` where there is no judgement, or only ties.
    """
    snapshot = store.sequence
    fitted = fit_judged(reward, store.judged(snapshot), fitting, rng)
    fitted.metrics["snapshot"] = float(snapshot)
    return fitted


def fit_judged(
    reward: RewardModel[C], judged: list[Judged[C]], fitting: FittingSettings, rng: np.random.Generator
) -> Fitted:
    """Fit `reward` on judgements at hand."""
    data = batch(judged)
    if not len(data):
        raise NothingToFit("there are no judgements to fit on; expected at least one comparison or ranking")
    if (data.preference == 0.5).all():
        raise NothingToFit(f"all {len(data)} comparisons are ties; expected at least one that prefers a candidate")
    held_out = split(data, judged, fitting.held_out)
    train, test = data.subset(~held_out), data.subset(held_out)
    stacked = reward.stack(data.candidates)
    _check_finite(all_scores(reward, stacked), data)
    weight = _member_weights(train, reward.members, fitting.bootstrap, rng)
    epochs = _optimise(_Problem(reward, stacked, train, test, weight, fitting), rng)
    reward.settle(stacked)
    scores = all_scores(reward, stacked)
    _check_finite(scores, data)
    metrics = {"comparisons": float(len(data)), "held_out": float(len(test)), "epochs": float(epochs)}
    metrics |= _measure(scores, train, fitting.error_rate, "")
    metrics |= _measure(scores, test, fitting.error_rate, "_held_out") if len(test) else {}
    return Fitted(metrics, predict(scores, test), test.preference)


def split(data: Batch[C], judged: list[Judged[C]], share: float) -> np.ndarray:
    """(M,) bool: which comparisons are held out. Those that share a candidate, also by way of others, stay together.

    The choice hangs on the id of a component's oldest query alone: it stays the same when judgements are added, so
    what was held out once is not trained on later, unless a new judgement joins two components of which the older one
    is trained on. Nothing is held out where that would leave nothing to train on.
    """
    links = coo_array((np.ones(len(data)), (data.edges[:, 0], data.edges[:, 1])), shape=(len(data.candidates),) * 2)
    _, component = connected_components(links, directed=False)
    of_edge = component[data.edges[:, 0]]
    _, first = np.unique(of_edge, return_index=True)
    chosen = [of_edge[i] for i in first if int(judged[data.group[i]].query.id[:8], 16) < share * 2**32]
    held_out = np.isin(of_edge, chosen)
    enough = not held_out.all() and not (data.preference[~held_out] == 0.5).all()
    return held_out if enough else np.zeros(len(data), bool)


@dataclass(frozen=True, eq=False)
class _Problem(Generic[C]):
    """One fit: what is fitted, on what, and how."""

    reward: RewardModel[C]
    stacked: Mapping[str, Tensor]
    train: Batch[C]
    test: Batch[C]
    weight: Tensor
    """(E, M): how much each training comparison counts for each member."""
    fitting: FittingSettings

    def loss(self, rows: Tensor) -> Tensor:
        """The loss of some training comparisons; each candidate among them is scored once."""
        edges = torch.as_tensor(self.train.edges)[rows]
        needed, here = torch.unique(edges, return_inverse=True)
        scores = self.reward.scores({name: x[needed] for name, x in self.stacked.items()})
        preference = torch.as_tensor(self.train.preference)[rows]
        losses = bradley_terry(preference_logits(scores, here), preference, self.fitting.error_rate)
        return weighted_mean(losses, self.weight[:, rows])

    def held_out_loss(self) -> float:
        return _measure(all_scores(self.reward, self.stacked), self.test, self.fitting.error_rate, "")["loss"]


def _optimise(problem: _Problem[C], rng: np.random.Generator) -> int:
    """Gradient steps until the epochs are over or patience is; returns the epochs run."""
    fitting, patience = problem.fitting, problem.fitting.patience if len(problem.test) else 0
    parameters = [p for p in problem.reward.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(parameters, fitting.learning_rate, weight_decay=fitting.weight_decay, fused=True)
    order = torch.Generator().manual_seed(draw_seed(rng))
    best, kept, epoch, best_epoch = float("inf"), _copies(parameters), 0, 0
    while epoch < fitting.epochs and (not patience or epoch - best_epoch < patience):
        epoch += 1
        for rows in torch.randperm(len(problem.train), generator=order).split(fitting.batch_size):  # type: ignore[no-untyped-call]
            _step(problem.loss(rows), optimizer, parameters, fitting.max_grad_norm)
        if patience and (loss := problem.held_out_loss()) < best:
            best, kept, best_epoch = loss, _copies(parameters), epoch
    if patience:
        torch._foreach_copy_([p.data for p in parameters], kept)
    return epoch


def _step(loss: Tensor, optimizer: torch.optim.Optimizer, parameters: Sequence[Tensor], max_grad_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(parameters, max_grad_norm)
    if not norm.isfinite():
        raise FloatingPointError(
            f"the gradient of the reward model's loss is {float(norm)}, and the loss {float(loss)}: "
            "lower fitting.learning_rate"
        )
    optimizer.step()


def _copies(parameters: Sequence[Tensor]) -> list[Tensor]:
    return [p.detach().clone() for p in parameters]


def _member_weights(data: Batch[C], members: int, bootstrap: bool, rng: np.random.Generator) -> Tensor:
    """(E, M) weights; with the bootstrap a judgement's comparisons are drawn together, being one piece of evidence."""
    weight = torch.as_tensor(data.weight).expand(members, -1)
    if not bootstrap or members == 1:
        return weight
    groups, at = np.unique(data.group, return_inverse=True)
    counts = rng.multinomial(len(groups), np.full(len(groups), 1 / len(groups)), size=members)
    return weight * torch.as_tensor(counts[:, at], dtype=torch.float32)


@torch.no_grad()
def all_scores(reward: RewardModel[C], stacked: Mapping[str, Tensor], chunk: int = 256) -> Tensor:
    """(E, N) raw scores of everything stacked, a chunk at a time."""
    count = len(next(iter(stacked.values())))
    parts = [reward.scores({k: x[i : i + chunk] for k, x in stacked.items()}) for i in range(0, count, chunk)]
    return torch.cat(parts, 1)


def predict(scores: Tensor, data: Batch[C]) -> Floats:
    """(M,) the members' mean probability that the first candidate is better."""
    return preference_logits(scores, torch.as_tensor(data.edges)).sigmoid().mean(0).double().numpy()


def _measure(scores: Tensor, data: Batch[C], error_rate: float, suffix: str) -> Metrics:
    """Loss, accuracy and calibration of the ensemble's mean prediction."""
    logits, preference = preference_logits(scores, torch.as_tensor(data.edges)), torch.as_tensor(data.preference)
    first, second = (log_preference(sign * logits, error_rate).logsumexp(0) - math.log(len(logits)) for sign in (1, -1))
    loss = -(preference * first + (1 - preference) * second)
    predicted = predict(scores, data)
    values = {
        "loss": float((loss * torch.as_tensor(data.weight)).sum() / data.weight.sum()),
        "accuracy": accuracy(predicted, data.preference),
        "brier": brier(predicted, data.preference),
        "calibration_error": calibration_error(predicted, data.preference),
    }
    return {name + suffix: value for name, value in values.items()}


def _check_finite(scores: Tensor, data: Batch[C]) -> None:
    bad = (~scores.isfinite()).nonzero()
    if len(bad):
        member, at = (int(i) for i in bad[0])
        raise FloatingPointError(
            f"reward member {member} scored candidate {data.candidates[at].id[:12]} as {float(scores[member, at])}; "
            "expected finite scores: lower fitting.learning_rate, or look for NaN in that candidate"
        )
