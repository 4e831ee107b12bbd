"""Grade a reward model: score what was judged, and fill in its report card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from prefrl.evaluate.agreement import Pairs, against_gold, buckets, labeler_part, member_part
from prefrl.evaluate.calibration import reliability
from prefrl.evaluate.card import About, Calibration, Gold, ReportCard, Scatter
from prefrl.evaluate.distances import distance_part
from prefrl.evaluate.drift import drift, read_probes
from prefrl.evaluate.invariance import self_test
from prefrl.evaluate.lengths import context, length, length_part, sample
from prefrl.evaluate.summary import read_metrics
from prefrl.fit.metrics import Answering, brier, calibration_error, log_losses, temperature
from prefrl.fit.pairs import compared
from prefrl.fit.settings import FittingSettings, Ties
from prefrl.fit.split import split
from prefrl.judgements import Judged, person
from prefrl.kinds import kind_of
from prefrl.protocols import Judgements, RewardModel
from prefrl.stats.estimates import Estimate, undefined
from prefrl.stats.intervals import clusters, correlation
from prefrl.storage.files import DamagedError
from prefrl.types import Candidate, Fields, Floats, Integers, Json, Query, gold_score

DRAWN = 300
"""Candidates in a scatter plot."""
HALF = 10
"""Comparisons that a temperature is fitted on, at least."""


@dataclass(frozen=True)
class Habits:
    """How labelers answer, as the fit of a model assumed and found."""

    fitting: FittingSettings = field(default_factory=FittingSettings)
    tie: float | None = None
    """The tie parameter in the members' mean, where ties were modelled."""
    error_rates: Mapping[str, float] = field(default_factory=dict)
    """By labeler, where the fit estimated them."""

    def answering(self, labelers: Sequence[str]) -> Answering:
        """Of the labeler of each comparison (M,)."""
        ties: Ties = "half" if self.tie is None else self.fitting.ties
        share = 1 / 2 if ties == "half" else 2 / 3  # a blind answer among n is wrong n - 1 times in n
        assumed = self.fitting.error_rate * share
        error = [self.error_rates.get(name, assumed) for name in labelers]
        return Answering(ties, self.tie or 0.0, np.array(error))


@dataclass(frozen=True)
class Subject:
    """What is graded, and what is known of it."""

    reward: RewardModel
    judged: Sequence[Judged]
    """Candidates carry their gold, where there is one."""
    known: Sequence[Candidate] = ()
    """Other segments that carry gold, for the regression that stands in for it."""
    discount: float = 0.99
    """What a reward a step later counts for in learning: shaping by a potential is told apart by it."""
    model: str = ""
    data: str = ""
    held_out: bool = False
    round: int | None = None
    probes: Sequence[Json] = ()
    """Rows of `probes.jsonl`."""
    habits: Habits = field(default_factory=Habits)
    demonstrations: int = 0
    """That the fit counted; they are not graded on."""


def grade(subject: Subject, rng: np.random.Generator) -> ReportCard:
    """The report card of a fitted reward model on judgements.

    Raises `ValueError` where the judgements compare no two candidates, where the model has not been fitted,
    or where it scores a candidate as something else than a finite number.
    """
    data = compared(subject.judged)
    if not len(data):
        raise ValueError(
            "there is nothing to grade on: expected at least one judgement of two or more candidates, or two ratings "
            "that differ"
        )
    if not subject.reward.fitted:
        raise ValueError("the reward model has not been fitted: fit it first, with `prefrl fit`")
    begin = perf_counter()
    raw = _finite(subject.reward.raw_member_scores(data.candidates), data.candidates)
    spent = (perf_counter() - begin) * 1000 / len(data.candidates)
    pairs = _pairs(subject, data, raw)
    score, candidates = raw.mean(0), data.candidates
    return ReportCard(
        about=_about(subject, pairs, candidates),
        accuracy=pairs.accuracy(rng),
        by_margin=buckets(pairs, pairs.margin, rng),
        calibration=_calibration(pairs, subject.habits.answering(pairs.labeler.tolist()), rng),
        lengths=length_part(pairs, score, candidates, rng),
        gold=_gold(pairs, score, candidates, rng),
        distance=distance_part(subject.reward, candidates, subject.known, subject.discount, rng),
        labelers=[
            labeler_part(pairs, n, subject.habits.error_rates.get(n), rng) for n in np.unique(pairs.labeler).tolist()
        ],
        members=member_part(pairs.decided, rng),
        invariance=self_test(subject.reward.raw_member_scores, candidates, [(int(a), int(b)) for a, b in data.edges]),
        drift=drift(subject.probes),
        seconds=Estimate(value=spent, count=len(candidates)),
        scatter=_scatter(score, candidates, rng),
    )


def of_run(
    reward: RewardModel,
    store: Judgements,
    folder: Path,
    round: int,
    fitting: FittingSettings,
    discount: float,
) -> Subject | None:
    """A run's reward model on what its newest fit left out; None where there is nothing to grade, or to grade on."""
    rows = [row for row in read_metrics(folder) if row["round"] <= round]
    snapshot = next((row["fit/snapshot"] for row in reversed(rows) if row.get("fit/snapshot") is not None), 0)
    judged = judgements(store, fitting.held_out, int(snapshot))
    if not reward.fitted or not len(compared(judged)):
        return None
    return Subject(
        reward,
        judged,
        known=_candidates(judgements(store)),
        discount=discount,
        model=folder.resolve().name,
        data=folder.resolve().name,
        held_out=True,
        round=round,
        probes=[row for row in read_probes(folder) if row["round"] <= round],
        habits=habits(fitting, rows),
        demonstrations=_counted(rows),
    )


def _counted(rows: Sequence[Fields]) -> int:
    """Demonstrations in the newest fit."""
    newest: Fields = next((row for row in reversed(rows) if row.get("fit/loss") is not None), {})
    return int(newest.get("fit/shown") or 0)


def of_judgements(
    reward: RewardModel,
    store: Judgements,
    names: tuple[str, str],
    fitting: FittingSettings,
    rows: Sequence[Fields],
    discount: float,
    held_out: bool,
) -> Subject | None:
    """A reward model on judgements from anywhere, `held_out` on those alone that a fit on them leaves out.

    `names`: of the model and of the data. `rows`: the metrics of its fits. None where there is nothing to grade on.
    """
    judged = judgements(store, fitting.held_out if held_out else None)
    if not judged:
        return None
    return Subject(reward, judged, (), discount, *names, held_out, habits=habits(fitting, rows))


def judgements(store: Judgements, held_out: float | None = None, upto: int | None = None) -> list[Judged]:
    """What was judged in a store, with the gold that lies there; only what a fit left out, where a share is given."""
    judged = store.judged(upto)
    kept = split(judged, held_out) if held_out is not None and judged else np.ones(len(judged), bool)
    return [_with_gold(one, store) for one, keep in zip(judged, kept, strict=True) if keep]


def _with_gold(one: Judged, store: Judgements) -> Judged:
    known = [replace(c, gold=_gold_of(c, store)) for c in one.query.candidates]
    return Judged(Query(tuple(known)), one.judgement)


def _gold_of(candidate: Any, store: Judgements) -> Floats | None:
    """None where no gold was ever filed; a file that is torn is an error."""
    try:
        return store.gold([candidate])[0]
    except DamagedError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return None
        raise


def _candidates(judged: Sequence[Judged]) -> list[Candidate]:
    return list({c.id: c for one in judged for c in one.query.candidates}.values())


def habits(fitting: FittingSettings, rows: Sequence[Fields]) -> Habits:
    """As the newest fit in the rows of `metrics.jsonl` found them."""
    found: Fields = next((row for row in reversed(rows) if row.get("fit/loss") is not None), {})
    mark = "fit/error_rate/"
    rates = {k.removeprefix(mark): v for k, v in found.items() if k.startswith(mark) and v is not None}
    return Habits(fitting, found.get("fit/tie"), rates)


def _finite(raw: Floats, candidates: Sequence[Candidate]) -> Floats:
    bad = np.argwhere(~np.isfinite(raw))
    if len(bad):
        member, at = bad[0]
        raise ValueError(
            f"reward member {member} scored candidate {candidates[at].id[:12]} as {raw[member, at]}; expected a finite "
            "score: look for NaN in that candidate, or fit with a lower fitting.learning_rate"
        )
    return raw.astype(np.float64)


def _pairs(subject: Subject, data: Any, raw: Floats) -> Pairs:
    first, second = data.edges.T
    lengths = np.array([length(c) for c in data.candidates])
    gold = golds(data.candidates)
    cluster, sense = clusters(data.edges, data.group, len(data.candidates))
    return Pairs(
        logits=raw[:, first] - raw[:, second],
        preference=data.preference.astype(np.float64),
        gold=gold[first] - gold[second],
        length=lengths[first] - lengths[second],
        labeler=np.array([person(one.judgement.labeler) for one in subject.judged])[data.group],
        cluster=cluster,
        clusters=sense,
    )


def golds(candidates: Sequence[Candidate]) -> Floats:
    """(N,) whole candidates' golds, NaN where there is none."""
    return np.array([np.nan if c.gold is None else gold_score(c) for c in candidates])


def _about(subject: Subject, pairs: Pairs, candidates: Sequence[Candidate]) -> About:
    return About(
        model=subject.model,
        data=subject.data,
        held_out=subject.held_out,
        kind=kind_of(candidates[0]).name,
        round=subject.round,
        members=subject.reward.members,
        judgements=len(subject.judged),
        comparisons=len(pairs),
        ties=len(pairs) - len(pairs.decided),
        candidates=len(candidates),
        demonstrations=subject.demonstrations,
    )


def _calibration(pairs: Pairs, answering: Answering, rng: np.random.Generator) -> Calibration:
    """Of the answers, not of what is felt: ties and mistakes are in them."""
    p, y, half = answering.expected(pairs.logits), pairs.preference, _halves(pairs, rng)
    # Each half is cooled by the temperature of the other: fitted and measured on one, it would always help.
    others = [np.flatnonzero(half != own) for own in (0, 1)] if len(half) else []
    found = [temperature(pairs.logits[:, at], y[at], answering.of(at)) for at in others]
    cooled = pairs.logits / np.array(found)[half] if found else pairs.logits
    too_few = undefined(f"fewer than {2 * HALF} comparisons, or all of them hang together")
    return Calibration(
        log_loss=_measured(log_losses(pairs.logits, y, answering).mean(), y),
        brier=_measured(brier(p, y), y),
        error=_measured(calibration_error(p, y), y),
        bins=list(reliability(p, y)),
        temperatures=found,
        log_loss_after=_measured(log_losses(cooled, y, answering).mean(), y) if found else too_few,
        error_after=_measured(calibration_error(answering.expected(cooled), y), y) if found else too_few,
    )


def _halves(pairs: Pairs, rng: np.random.Generator) -> Integers:
    """(M,) 0 or 1: two halves, clusters kept whole; nothing where one would be too small to fit a temperature on."""
    names, at = np.unique(pairs.cluster, return_inverse=True)
    half = (rng.permutation(len(names)) % 2)[at]  # (M,): whole clusters, dealt out in turn
    return half if min(np.bincount(half, minlength=2)) >= HALF else half[:0]


def _measured(value: float, rows: Floats) -> Estimate:
    return Estimate(value=value, count=len(rows))


def _gold(pairs: Pairs, score: Floats, candidates: Sequence[Candidate], rng: np.random.Generator) -> Gold:
    gold = golds(candidates)
    known = np.flatnonzero(np.isfinite(gold))
    at = known[sample(len(known), rng)]
    contexts = [context(candidates[i]) for i in at]
    unknown = undefined("no gold is known")
    return Gold(
        accuracy=against_gold(pairs, pairs.predicted - 0.5, rng),
        spearman=correlation("spearman", score[at], gold[at], contexts, rng) if len(at) else unknown,
        kendall=correlation("kendall", score[at], gold[at], contexts, rng) if len(at) else unknown,
        buckets=buckets(pairs, np.abs(pairs.gold), rng),
    )


def _scatter(score: Floats, candidates: Sequence[Candidate], rng: np.random.Generator) -> Scatter:
    at, gold = sample(len(score), rng, DRAWN), golds(candidates)
    known = bool(np.isfinite(gold).all())
    sizes = [float(length(candidates[i])) for i in at]
    return Scatter(score=score[at].tolist(), length=sizes, gold=gold[at].tolist() if known else [])
