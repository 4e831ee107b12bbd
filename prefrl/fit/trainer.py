"""Fit a reward model on the judgements of a store, by maximum likelihood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from prefrl.fit.descent import Problem, all_scores, ensemble_loss, optimise, trainable
from prefrl.fit.likelihood import Likelihood
from prefrl.fit.losses import preference_logits
from prefrl.fit.metrics import accuracy, brier, calibration_error, temperature
from prefrl.fit.pairs import Batch, compared
from prefrl.fit.settings import FittingSettings
from prefrl.fit.split import prefers, split
from prefrl.fit.terms import Terms, terms
from prefrl.judgements import Demonstrated, Judged
from prefrl.protocols import Judgements, RewardModel
from prefrl.seeding import keep_freed_memory, to_numpy
from prefrl.types import C, Fitted, Floats, Metrics


class NothingToFit(ValueError):
    """There is no judgement that prefers anything."""


def fit(
    reward: RewardModel[C],
    store: Judgements[C],
    fitting: FittingSettings,
    rng: np.random.Generator,
    unjudged: Sequence[C] = (),
) -> Fitted:
    """Fit `reward` on a snapshot of the store: all judgements up to its newest event, and what demonstrations imply.

    `unjudged` candidates are for pseudo-labels; open queries give some too. Raises `NothingToFit` where there is no
    judgement, or only ties.
    """
    # Taken first: what people answer from here on is left to the next fit, and this one can be repeated.
    snapshot = store.sequence
    if fitting.pseudo_labels:
        waiting: list[C] = [c for query in store.open_queries() for c in query.candidates]
        unjudged = list(unjudged) + waiting
    shown = _implied(store.demonstrations(snapshot), fitting) if fitting.demonstrations else []
    judged = store.judged(snapshot)[-(fitting.newest or 0) :]
    fitted = fit_judged(reward, [*judged, *shown], fitting, rng, unjudged, len(shown))
    fitted.metrics["snapshot"] = float(snapshot)
    return replace(fitted, metrics=fitted.metrics | {"shown": float(len(shown))}) if shown else fitted


def _implied(demonstrations: Sequence[Demonstrated[C]], fitting: FittingSettings) -> list[Judged[C]]:
    """What the newest demonstrations say, one after another; those that stand for themselves say nothing."""
    weight = fitting.demonstrations
    if fitting.shown_as == "piles":
        each = [one.told_apart(weight) for one in demonstrations]
    else:
        pairs = (one.implied(weight) for one in demonstrations)
        each = [[one] for one in pairs if one is not None]
    each = [one for one in each if one][-(fitting.newest or 0) :]
    return [one for some in each for one in some]


def fit_judged(
    reward: RewardModel[C],
    judged: Sequence[Judged[C]],
    fitting: FittingSettings,
    rng: np.random.Generator,
    unjudged: Sequence[C] = (),
    shown: int = 0,
) -> Fitted:
    """Fit `reward` on judgements at hand. Raises as `fit` does, and FloatingPointError where a score is not finite.

    The last `shown` of them are what demonstrations imply, and are measured apart where there are others.
    """
    if not judged:
        raise NothingToFit("there are no judgements to fit on; expected at least one that prefers a candidate")
    if not prefers(judged):
        raise NothingToFit(f"all {len(judged)} judgements are ties; expected at least one that prefers a candidate")
    keep_freed_memory()
    held_out = split(judged, fitting.held_out)
    data = compared(judged, held_out.tolist())
    problem = _problem(reward, judged, held_out, fitting, unjudged, rng)
    if not trainable(reward):
        _check_inputs(problem)
    try:
        epochs = optimise(problem, rng)
    except FloatingPointError:  # name the candidate, where one is to blame
        _check_finite(all_scores(reward, problem.stacked), problem.candidates)
        _check_inputs(problem)
        raise
    scores = reward.settle(problem.stacked, problem.total)
    _check_finite(scores, problem.candidates)
    fitted = _finish(problem, data, held_out[data.group], scores, epochs)
    if not 0 < shown < len(judged):
        return fitted
    implied = np.arange(len(judged)) >= len(judged) - shown
    apart = {"judged": ~implied, "shown": implied}
    return replace(fitted, metrics=fitted.metrics | _contributions(problem, data, held_out, scores, apart))


def _problem(
    reward: RewardModel[C],
    judged: Sequence[Judged[C]],
    held_out: np.ndarray,
    fitting: FittingSettings,
    unjudged: Sequence[C],
    rng: np.random.Generator,
) -> Problem[C]:
    """Everything that a fit needs, stacked once."""
    known: dict[str, C] = {c.id: c for one in judged for c in one.query.candidates}
    others: dict[str, C] = {c.id: c for c in unjudged if c.id not in known}
    # The judged ones first, in the order of `known`: the terms below count them so.
    candidates: list[C] = list(known.values()) + (list(others.values()) if fitting.pseudo_labels else [])
    every = terms(judged, list(known), fitting.ties, fitting.rankings)
    stacked = reward.stack(candidates)
    device = next(iter(stacked.values())).device  # where the reward model is, the whole fit is
    every, out = every.to(device), torch.as_tensor(held_out, device=device)
    train, descends = every.subset(~out), bool(trainable(reward))
    resampled = _member_weights(train, reward.members, fitting.bootstrap and descends, rng)
    return Problem(
        reward=reward,
        candidates=candidates,
        judged=len(known),
        stacked=stacked,
        every=every,
        train=train,
        test=every.subset(out),
        likelihood=Likelihood(reward.members, every, fitting),
        weight=resampled,
        fitting=fitting,
    )


def _finish(problem: Problem[C], data: Batch[C], out: np.ndarray, scores: Tensor, epochs: int) -> Fitted:
    """Measure a fit, and calibrate the model."""
    test, logits = data.subset(out), _logits(scores, data.subset(out))
    answering = problem.likelihood.answering(problem.every)
    # On what was held out: on the training judgements a network is always surer than it may be.
    heat = temperature(logits, test.preference, answering.of(test.group), test.weight)
    problem.reward.calibrate(heat)
    metrics = {
        "judgements": float(len(problem.every.labeler)),
        "comparisons": float(len(data)),
        "held_out": float(len(problem.test.labeler)),
        "epochs": float(epochs),
        "temperature": heat,
    }
    metrics |= problem.likelihood.metrics()
    metrics |= _measure(problem, problem.train, data.subset(~out), scores, "")
    if len(problem.test.labeler):
        metrics |= _measure(problem, problem.test, test, scores, "_held_out")
    return Fitted(metrics, answering.of(test.group).expected(logits), test.preference)


def _contributions(
    problem: Problem[C],
    data: Batch[C],
    out: np.ndarray,
    scores: Tensor,
    apart: Mapping[str, np.ndarray],
) -> Metrics:
    """What each kind of answer had in a fit: how many were trained on, their weight and their share of the loss, and
    how many were held out, with the accuracy on them. `out` and each of `apart` are (J,) masks of the answers."""
    found, totals = Metrics(), dict[str, float]()
    for name, kind in apart.items():
        part = problem.every.subset(torch.as_tensor(kind & ~out, device=problem.every.labeler.device))
        weight = float(torch.cat([part.choices.weight, part.ratings.weight]).sum())
        totals[name] = weight * ensemble_loss(problem, part, scores) if weight else 0.0
        test = data.subset((kind & out)[data.group])
        found |= {f"trained/{name}": float((kind & ~out).sum()), f"weight/{name}": weight}
        found[f"held_out/{name}"] = float((kind & out).sum())
        if len(test):
            found[f"accuracy_held_out/{name}"] = accuracy(expit(_logits(scores, test)).mean(0), test.preference)
    whole = sum(totals.values())
    return found | {f"loss_share/{name}": total / whole for name, total in totals.items() if whole}


def _member_weights(part: Terms, members: int, bootstrap: bool, rng: np.random.Generator) -> Tensor:
    """(E, J) how often each judgement counts: once, or as the bootstrap draws it for each member."""
    count = len(part.labeler)
    if not bootstrap or members == 1:
        return torch.ones(members, count, device=part.labeler.device)
    # Draws with replacement, as counts: every member sees the same minibatches, and weighs them in its own way.
    drawn = rng.multinomial(count, np.full(count, 1 / count), size=members)
    return torch.as_tensor(drawn, dtype=torch.float32, device=part.labeler.device)


def _logits(scores: Tensor, data: Batch[C]) -> Floats:
    """(E, M): how much better each member finds the first candidate of each comparison."""
    found: Floats = to_numpy(preference_logits(scores, data.edges).double())
    return found


def _measure(problem: Problem[C], part: Terms, data: Batch[C], scores: Tensor, suffix: str) -> Metrics:
    """The ensemble's loss on judgements, and accuracy and calibration of its mean prediction on what they imply."""
    logits = _logits(scores, data)
    judged = problem.likelihood.answering(problem.every).of(data.group).expected(logits)
    values = {
        "loss": ensemble_loss(problem, part, scores),
        "accuracy": accuracy(expit(logits).mean(0), data.preference),
        "brier": brier(judged, data.preference),
        "calibration_error": calibration_error(judged, data.preference),
    }
    return {name + suffix: value for name, value in values.items()}


def _check_finite(scores: Tensor, candidates: Sequence[C]) -> None:
    bad = (~scores.isfinite()).nonzero()
    if len(bad):
        member, at = (int(i) for i in bad[0])
        raise FloatingPointError(
            f"reward member {member} scored candidate {candidates[at].id[:12]} as {float(scores[member, at])}; "
            "expected finite scores: lower fitting.learning_rate, or look for NaN in that candidate"
        )


def _check_inputs(problem: Problem[C]) -> None:
    """A network can turn an infinite input into a finite score, and still have no gradient."""
    for x in problem.stacked.values():
        bad = (~x.isfinite()).view(len(x), -1).any(1).nonzero()
        if len(bad):
            raise FloatingPointError(
                f"candidate {problem.candidates[int(bad[0])].id[:12]} holds numbers that are not finite: look for NaN "
                "or inf in it"
            )
