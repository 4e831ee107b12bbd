"""Descend a likelihood: gradient steps in minibatches, or a closed form, with what is learned beside the reward."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic

import numpy as np
import torch
from torch import Tensor

from prefrl.distributed import world
from prefrl.fit import semi
from prefrl.fit.adam import Adam
from prefrl.fit.likelihood import Likelihood, per_judgement, weights
from prefrl.fit.losses import weighted_mean
from prefrl.fit.noise import Discriminator, flipped
from prefrl.fit.settings import FittingSettings, check_solved
from prefrl.fit.terms import Terms
from prefrl.protocols import RewardModel
from prefrl.seeding import generator
from prefrl.types import C

RATE = 0.05
"""Learning rate of what is learned beside the reward: a handful of numbers."""
UNJUDGED = 4
"""Pairs nobody judged for each judgement in a gradient step, as in SURF."""
OVERFIT = (1.1, 1.5)
"""Where adaptive weight decay keeps the held-out over the training loss (Christiano et al. 2017, section 2.2.3)."""
DECAY, DECAY_MORE, DECAY_LESS, DECAY_BOUNDS = 1.0, 1.3, 1.1, (0.1, 100.0)
"""Where it begins, its factors from epoch to epoch (a loss follows slowly: what goes too far swings), and how far it
goes: below 0.1 it does next to nothing, and would only take longer to come back."""
ALTERNATIONS = 10
"""Turns between a reward that is solved for and what is learned beside it."""


@dataclass(frozen=True, eq=False)
class Problem(Generic[C]):
    """One fit: what is fitted, on what, and how."""

    reward: RewardModel[C]
    candidates: Sequence[C]
    """Those that were judged, and then those that nobody judged."""
    judged: int
    """How many were."""
    stacked: Mapping[str, Tensor]
    every: Terms
    """Of all judgements; those that are trained on and those that are held out follow."""
    train: Terms
    test: Terms
    likelihood: Likelihood
    weight: Tensor
    """(E, J): how much each training judgement counts for each member."""
    fitting: FittingSettings

    def loss(self, part: Terms, weight: Tensor, order: torch.Generator) -> Tensor:
        """The loss of some training judgements; each candidate among them is scored once."""
        fitting, extra = self.fitting, self._unjudged(part, order)
        mentioned = torch.cat([part.candidates(), extra.flatten()])
        needed, here = torch.unique(mentioned, return_inverse=True)  # (N',), and where each mention stands in it
        stacked: Mapping[str, Tensor] = {name: x.index_select(0, needed) for name, x in self.stacked.items()}
        if fitting.crop:
            stacked = semi.crop(stacked, fitting.crop, order)
        counts, here_terms = weights(part, weight), part.over(here)
        # Centring and pseudo-labels look at every member's score of every candidate.
        if not (fitting.centre or len(extra) or counts.all()):
            stacked = {**stacked, "used": _used(here_terms, counts, len(needed))}
        scores = shared_scores(self.reward, stacked)
        loss = weighted_mean(self.likelihood.losses(here_terms, scores), counts)
        if fitting.reliability == "learned":
            # The loss is a mean over judgements: over all their weights, the prior keeps its size beside it.
            loss = loss + (self.likelihood.prior() / weights(self.train, self.weight).sum(1)).sum()
        if fitting.centre:
            loss = loss + fitting.centre * scores.mean(1).square().sum()  # preferences say nothing of a member's offset
        if len(extra):
            edges = here[len(mentioned) - extra.numel() :].view(-1, 2)  # (U, 2): they were mentioned last
            loss = loss + fitting.pseudo_labels * semi.pseudo_loss(scores, edges, fitting.confidence)
        return loss

    def total(self, scores: Tensor) -> Tensor:
        """(E, N) scores -> (E,) the negative log-likelihood of all training judgements."""
        return (self.likelihood.losses(self.train, scores) * weights(self.train, self.weight)).sum(1)

    def _unjudged(self, part: Terms, order: torch.Generator) -> Tensor:
        if not self.fitting.pseudo_labels:
            return part.labeler.new_zeros(0, 2)
        judgements = torch.cat([part.choices.judgement, part.ratings.judgement])
        count = UNJUDGED * len(set(judgements.tolist()))
        return semi.pairs(self.candidates[self.judged :], self.judged, count, order).to(part.labeler.device)


def optimise(problem: Problem[C], rng: np.random.Generator) -> int:
    """Descend; returns the epochs run. A reward without parameters is solved for when it settles: 0 epochs."""
    if trainable(problem.reward):
        return _Descent(problem, rng).run()
    check_solved(problem.fitting)
    _alternate(problem)
    return 0


class _Descent(Generic[C]):
    """Gradient steps until the epochs are over or patience is."""

    def __init__(self, problem: Problem[C], rng: np.random.Generator) -> None:
        self.problem: Problem[C] = problem
        self.fitting = problem.fitting
        self.parameters = trainable(problem.reward)
        adaptive = self.fitting.weight_decay == "adaptive"
        groups: list[dict[str, Any]] = [
            {"params": self.parameters, "weight_decay": DECAY if adaptive else self.fitting.weight_decay},
            # No decay: it pulls to 0, which is an error rate of a half.
            {"params": problem.likelihood.parameters(), "lr": RATE, "weight_decay": 0.0},
        ]
        groups = [group for group in groups if group["params"]]
        self.optimizer = Adam(groups, self.fitting.learning_rate)
        self.order = generator(rng)
        self.discriminator = Discriminator()

    def run(self) -> int:
        """Returns the epochs run."""
        measured = bool(len(self.problem.test.labeler))
        patience = self.fitting.patience if measured else 0
        best = float("inf")
        epoch = best_epoch = 0
        kept = self._copies()  # also of what is learned beside the reward, which the scores belong to
        while epoch < self.fitting.epochs and (not patience or epoch - best_epoch < patience):
            epoch += 1
            self._epoch()
            if measured and self.fitting.weight_decay == "adaptive":
                self._adapt()
            if patience and (loss := ensemble_loss(self.problem, self.problem.test)) < best:
                best = loss
                best_epoch = epoch
                kept = self._copies()
        if patience:
            torch._foreach_copy_([p.data for p in self._all()], kept)
        return epoch

    def _epoch(self) -> None:
        train, weight = self._trusted()
        order = torch.randperm(len(train.labeler), generator=self.order).to(weight.device)
        for part in train.minibatches(order, self.fitting.batch_size):
            # One generator for the order, for crops and for pseudo-labels: one seed repeats the fit.
            self._step(self.problem.loss(part, weight, self.order))

    def _trusted(self) -> tuple[Terms, Tensor]:
        """The training judgements, and the weight of each, after improbable ones were filtered or turned round."""
        problem = self.problem
        if self.fitting.denoise == "off":
            return problem.train, problem.weight
        sums, counts = per_judgement(problem.train, _beside_ignorance(problem, problem.train)[None])
        pairs = _is_pair(problem.train, counts) & (self.fitting.denoise == "flip")
        verdict, self.discriminator = self.discriminator.judge(sums[0] / counts, pairs)
        return flipped(problem.train, verdict.flip), problem.weight * verdict.keep

    def _step(self, loss: Tensor) -> None:
        for parameter in self._all():
            parameter.grad = None
        if loss.requires_grad:  # a rank that scored nothing may have nothing to learn
            loss.backward()  # type: ignore[no-untyped-call]
        # What is learned beside the reward sees all scores on every rank: its gradient is whole already.
        world().sum_gradients(self.parameters)
        # The reward's alone: a tie or an error rate has few gradients, on another scale.
        norm = world().clip_gradients(self.parameters, self.fitting.max_grad_norm)
        if not math.isfinite(norm):  # before the step, which would spread it over all weights
            raise FloatingPointError(
                f"the gradient of the reward model's loss is {norm}, and the loss {float(loss.detach())}: "
                "lower fitting.learning_rate"
            )
        self.optimizer.step()

    def _adapt(self) -> None:
        """More weight decay where the held-out loss is far above the training loss, less where it is near."""
        test, train = (ensemble_loss(self.problem, part) for part in (self.problem.test, self.problem.train))
        factor = DECAY_MORE if test > OVERFIT[1] * train else 1 / DECAY_LESS if test < OVERFIT[0] * train else 1.0
        group, (least, most) = self.optimizer.param_groups[0], DECAY_BOUNDS
        group["weight_decay"] = min(max(group["weight_decay"] * factor, least), most)

    def _all(self) -> list[Tensor]:
        return [*self.parameters, *self.problem.likelihood.parameters()]

    def _copies(self) -> list[Tensor]:
        return [p.detach().clone() for p in self._all()]


def _alternate(problem: Problem[C]) -> None:
    """Turn by turn the reward solves for itself, and what is learned beside it descends. Leaves the reward alone."""
    own, before = problem.likelihood.parameters(), problem.reward.state()
    for _ in range(ALTERNATIONS if own else 0):
        scores = problem.reward.settle(problem.stacked, problem.total)
        _minimise(partial(_own_loss, problem, scores), own)
        problem.reward.load(before)  # to settle counts as a fit, and the one that counts comes later


def _used(part: Terms, counts: Tensor, candidates: int) -> Tensor:
    """(N, E) bool: which candidates stand in a term that counts (E, S + R) for that member."""
    count, width = part.choices.items.shape
    counted = counts.bool()
    # (E, S K + R), in the order of `candidates()`: a choice mentions K.
    mentions = torch.cat([counted[:, :count].repeat_interleave(width, 1), counted[:, count:]], 1)
    used = counts.new_zeros(candidates, len(counts))
    # Added up, not assigned: of several mentions of a candidate the last one would win.
    return used.index_add_(0, part.candidates(), mentions.T.float()).bool()


def _own_loss(problem: Problem[C], scores: Tensor) -> Tensor:
    return (problem.total(scores) + problem.likelihood.prior()).sum()


def trainable(reward: RewardModel[C]) -> list[torch.nn.Parameter]:
    """What gradient steps change; empty for a reward that is solved for."""
    return [p for p in reward.parameters() if p.requires_grad]


def _minimise(loss: Callable[[], Tensor], parameters: list[Tensor]) -> None:
    optimizer = torch.optim.LBFGS(parameters, max_iter=50, line_search_fn="strong_wolfe")

    def closure() -> float:
        optimizer.zero_grad()
        value = loss()
        value.backward()  # type: ignore[no-untyped-call]
        return float(value.detach())

    optimizer.step(closure)  # type: ignore[no-untyped-call]


@torch.no_grad()
def all_scores(reward: RewardModel[C], stacked: Mapping[str, Tensor], chunk: int = 256) -> Tensor:
    """(E, N) raw scores of everything stacked, a chunk at a time."""
    count = len(next(iter(stacked.values())))
    parts = [shared_scores(reward, {k: x[i : i + chunk] for k, x in stacked.items()}) for i in range(0, count, chunk)]
    return torch.cat(parts, 1)


def shared_scores(reward: RewardModel[C], stacked: Mapping[str, Tensor]) -> Tensor:
    """(E, N) `reward.scores`; ranks share the candidates, and each has gradients of its own ones."""
    mine, count = world().mine, len(next(iter(stacked.values())))
    if world().size == 1:
        return reward.scores(stacked)
    own = {name: x[mine] for name, x in stacked.items()}
    some = next(iter(own.values()))
    scores = reward.scores(own) if len(some) else torch.zeros(reward.members, 0, device=some.device)
    found = world().whole(scores.detach().T.contiguous(), count).T
    # Every rank works out the same loss of all scores; what it says of a candidate goes back where that was scored.
    found[:, mine] = scores
    return found


@torch.no_grad()
def ensemble_losses(problem: Problem[C], part: Terms, scores: Tensor | None = None) -> Tensor:
    """(S + R,) -log of the members' mean likelihood of each term; only candidates that it mentions are scored."""
    if scores is None:
        needed, here = torch.unique(part.candidates(), return_inverse=True)
        stacked = {name: x.index_select(0, needed) for name, x in problem.stacked.items()}
        part, scores = part.over(here), all_scores(problem.reward, stacked)
    losses = problem.likelihood.losses(part, scores)
    return math.log(len(losses)) - (-losses).logsumexp(0)  # -log of the mean over members of exp(-loss)


def ensemble_loss(problem: Problem[C], part: Terms, scores: Tensor | None = None) -> float:
    """The weighted mean of `ensemble_losses`."""
    weight = torch.cat([part.choices.weight, part.ratings.weight])
    return float((ensemble_losses(problem, part, scores) * weight).sum() / weight.sum())


def _beside_ignorance(problem: Problem[C], part: Terms) -> Tensor:
    """(S + R,) `ensemble_losses` in units in which a model that finds all candidates alike has log 2.

    So the best of eight is no more suspect than the better of two, before anything is known.
    """
    blank = ensemble_losses(problem, part, problem.weight.new_zeros(problem.reward.members, len(problem.candidates)))
    # The clamp: where ties are expected anyway, a term can be all but certain before anything is known.
    return ensemble_losses(problem, part) * (math.log(2) / blank.clamp(min=1e-3))


def _is_pair(part: Terms, terms: Tensor) -> Tensor:
    """(J,) whether a judgement is a single comparison of two that prefers one."""
    two = terms.new_zeros(len(terms), dtype=torch.bool)
    two[part.choices.judgement[(part.choices.present.sum(1) == 2) & ~part.choices.tied]] = True
    return two & (terms == 1)
