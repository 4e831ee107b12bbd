"""What the columns of a ledger come to, person by person and between people.

Pure functions, but for `attention`, which reads the log.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np
import numpy.typing as npt
import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.judgements import best_of
from prefrl.page.api import AgreementRow, AnnotatorRow
from prefrl.page.ledger import CHECK, JUDGED, LABEL, LEFT, RIGHT, SKIPPED, TIE, Ledger
from prefrl.stats.estimates import Estimate
from prefrl.stats.intervals import position_test, share
from prefrl.stats.raters import (
    Ratings,
    agreement_with_others,
    cohen_kappa,
    fleiss_kappa,
    krippendorff_alpha,
    raw_agreement,
)
from prefrl.stats.triads import circular_triads
from prefrl.storage.events import read_answer
from prefrl.storage.tables import assignment, event
from prefrl.storage.tables import query as query_table
from prefrl.types import Floats

Rows = dict[str, Floats]
"""Columns of equal length; see `ledger`."""
Mask = npt.NDArray[np.bool_]
RESAMPLES = 199
"""Of each bootstrap: a dashboard is looked at while people label."""
PAUSE = 600.0
"""Seconds between two answers after which somebody was away."""
MINUTES, HOURS = 120, 48
"""How far back throughput is told, by the minute and by the hour."""
LEVELS = 20
"""Steps of a soft preference that ordinal agreement tells apart."""


@dataclass(frozen=True)
class Person:
    """What one person's own answers say."""

    answers: int
    skips: int
    median_seconds: float | None
    per_hour: float | None
    left: Estimate
    ties: Estimate
    checks: Estimate
    too_fast: int


def person(rows: Rows, stands: Mask, alive: Mask) -> Person:
    """One person's rows (n,). `stands` (n,): not taken back; `alive` (n,): those, and answers to repeats."""
    answered = alive & (rows["word"] != SKIPPED)
    seconds = rows["seconds"][answered]
    timed = seconds[np.isfinite(seconds)]
    left, right, tie = (int((alive & (rows["first"] == place)).sum()) for place in (LEFT, RIGHT, TIE))
    checks = rows["hit"][stands & (rows["purpose"] == CHECK) & (rows["word"] != SKIPPED)]
    return Person(
        answers=int((stands & (rows["word"] != SKIPPED)).sum()),
        skips=int((stands & (rows["word"] == SKIPPED)).sum()),
        median_seconds=float(np.median(timed)) if len(timed) else None,
        per_hour=per_hour(rows["at"][alive]),
        left=share(left, left + right, "no pair was decided"),
        ties=share(tie, left + right + tie, "no pair was judged"),
        checks=share(int((checks == 1).sum()), len(checks), "no check question was answered"),
        too_fast=int((seconds < rows["clip"][answered] / 2).sum()),
    )


def per_hour(at: Floats) -> float | None:
    """Answers per hour at work: times (n,) in seconds, longer pauses left out; None without two in a row."""
    gaps = np.diff(np.sort(at))
    worked = gaps[gaps <= PAUSE]
    return len(worked) * 3600 / float(worked.sum()) if worked.sum() > 0 else None


def stands(ledger: Ledger) -> Mask:
    """(n,) which of the ledger's rows were not taken back or replaced; repeats are not among them."""
    found = np.zeros(len(ledger.signatures), np.bool_)
    found[list(ledger.standing.values())] = True
    return found


def repeated(ledger: Ledger) -> dict[int, tuple[int, int]]:
    """Person -> (repeats that agree with what stands, repeats), strength aside; skips are left out."""
    found: dict[int, tuple[int, int]] = {}
    for row, query, who in ledger.repeats:
        before = ledger.standing.get((query, who))
        if before is None or None in (pair := (ledger.signatures[row], ledger.signatures[before])):
            continue
        same, count = found.get(who, (0, 0))
        found[who] = same + (pair[0] == pair[1]), count + 1
    return found


def agreement(
    rows: Rows, pairs: Rows, keep: Mask, rng: np.random.Generator
) -> tuple[AgreementRow, dict[int, Estimate]]:
    """Agreement over everybody, and of each person with the others, on the rows (n,) to keep.

    Checks are too easy to count, and skips and "cannot be compared" say nothing of a pair. Krippendorff's alpha is
    ordinal where answers have strengths, else nominal; all others see first, tie or second. Rankings count as their
    pairs, which are resampled together.
    """
    used = keep & (rows["purpose"] == LABEL) & (rows["word"] == JUDGED)
    row = pairs["row"].astype(np.int64)
    chosen = used[row]
    row, preference = row[chosen], pairs["preference"][chosen]
    who, query = (rows[name][row].astype(np.int64) for name in ("person", "query"))
    item = pairs["item"][chosen].astype(np.int64)
    sides = Ratings(item, who, np.sign(preference - 0.5).astype(np.int64), query)
    soft = bool(np.isin(preference, (0.0, 0.5, 1.0), invert=True).any())
    graded = Ratings(item, who, np.round(preference * LEVELS).astype(np.int64), query) if soft else sides
    edges = np.stack([pairs["one"][chosen], pairs["other"][chosen]], axis=1).astype(np.int64)
    two = edges[:, 0] >= 0
    found = AgreementRow(
        raw=raw_agreement(sides, rng, RESAMPLES),
        cohen=cohen_kappa(sides, rng, RESAMPLES),
        fleiss=fleiss_kappa(sides, rng, RESAMPLES),
        krippendorff=krippendorff_alpha(graded, rng, "ordinal" if soft else "nominal", RESAMPLES),
        intransitive=circular_triads(edges[two], preference[two], rng, RESAMPLES),
    )
    each = agreement_with_others(sides, rng, RESAMPLES)
    return found, dict(zip(np.unique(who).tolist(), each, strict=True))


def throughput(at: Floats, now: float) -> tuple[Literal["minute", "hour"], list[tuple[str, int]]]:
    """Answers, given at times (n,), in each minute of the last two hours; by the hour where they began before that."""
    recent = at[at <= now]
    young = not len(recent) or now - recent.min() <= MINUTES * 60
    seconds, most = (60, MINUTES) if young else (3600, HOURS)
    last = int(now // seconds)
    slots = (recent // seconds).astype(np.int64)
    first = max(int(slots.min(initial=last)), last - most + 1)
    counts = np.bincount(slots[slots >= first] - first, minlength=last - first + 1)
    starts = (datetime.fromtimestamp((first + i) * seconds, UTC).isoformat() for i in range(len(counts)))
    return ("minute" if young else "hour"), list(zip(starts, counts.tolist(), strict=True))


def concerns(row: AnnotatorRow, check_warn: float = 0.8) -> list[str]:
    """What an admin should look at in one person's numbers, in words; empty where nothing is striking.

    `check_warn` is the share of check questions that anybody who looks answers as expected.
    """
    found = []
    if row.left.value is not None:
        p = position_test(round(row.left.value * row.left.count), row.left.count)
        if p is not None and p < 0.01:
            side = "left" if row.left.value > 0.5 else "right"
            found.append(f"prefers the {side} side: {row.left.value:.0%} left of {row.left.count}, p = {p:.2g}")
    for name, low in (("checks", check_warn), ("repeats", 0.6)):
        found += filter(None, [shortfall(name, getattr(row, name), low)])
    if row.answers >= 5 and row.too_fast > 0.2 * row.answers:
        found.append(f"faster than half a clip in {row.too_fast} of {row.answers} answers")
    return found


def shortfall(name: str, rate: Estimate, low: float) -> str:
    """In words, that what should be answered as expected surely is less often than that; "" where it may not be."""
    if rate.value is None or rate.high is None or rate.high >= low:
        return ""
    return f"{name} answered as expected: {rate.value:.0%} of {rate.count}, less than {low:.0%}"


def failing(connection: Connection, name: str, least: float) -> str:
    """Why a person is to be paused: they surely answer a smaller share of checks as expected; "" where they may not."""
    return shortfall("checks", attention(connection, name), least)


def attention(connection: Connection, name: str) -> Estimate:
    """The share of check questions that a person answered as expected since they were last let in; skips apart."""
    states = sql.select(sql.func.max(event.c.seq)).where(event.c.kind == "state", event.c.actor == name)
    since = connection.scalar(states) or 0
    mine = (assignment.c.annotator == name) & (assignment.c.purpose == "check") & (assignment.c.answered > since)
    columns = *(event.c[column] for column in ("kind", "subject", "actor", "body")), query_table.c.expected
    answered = sql.join(assignment, event, event.c.seq == assignment.c.answered)
    joined = answered.join(query_table, query_table.c.id == assignment.c.query)
    answers = [
        (read_answer(row.kind, row.subject, row.actor, row.body), row.expected)
        for row in connection.execute(sql.select(*columns).select_from(joined).where(mine))
    ]
    hits = [best_of(answer) == expected for answer, expected in answers if answer.reason != "skip"]
    return share(sum(hits), len(hits), "no check question was answered")
