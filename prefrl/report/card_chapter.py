"""The figures of a report card, each with how to read it."""

from __future__ import annotations

from dataclasses import dataclass

from markupsafe import Markup

from prefrl.evaluate.card import Bucket, ReportCard
from prefrl.report import card_words, plots
from prefrl.report.card_words import Row
from prefrl.report.plots import Bar, Card, Line
from prefrl.report.words import show_number, show_share
from prefrl.stats.estimates import Estimate


@dataclass(frozen=True)
class Grades:
    """A report card as a page shows it."""

    headline: str
    subject: str
    tiles: tuple[tuple[str, str, str], ...]
    """(name, value, note)."""
    cards: tuple[Card, ...]
    """Only figures that there is something to draw for."""
    groups: list[tuple[str, list[Row]]]


def grades(card: ReportCard) -> Grades:
    drawn = (*_agreement(card), *_scores(card), *_drift(card))
    return Grades(
        headline=card_words.headline(card),
        subject=card_words.subject(card.about),
        tiles=_tiles(card),
        cards=tuple(c for c in drawn if c.figure),
        groups=card_words.groups(card),
    )


def _tiles(card: ReportCard) -> tuple[tuple[str, str, str], ...]:
    found = [
        ("Accuracy", card.accuracy, True, "held out" if card.about.held_out else "all judgements"),
        ("Calibration error", card.calibration.error, True, "0 is calibrated"),
        ("Rank correlation with gold", card.gold.spearman, False, "Spearman"),
        ("EPIC distance to gold", card.distance.epic, False, "0 is the same task"),
        ("The longer one wins", card.lengths.baseline, True, "as a baseline"),
    ]
    tiles = [
        (n, _shown(e, percent), _between(e, percent) or note) for n, e, percent, note in found if e.value is not None
    ]
    return (*tiles, ("Self-test", "passed" if card.invariance.passed else "FAILED", "batch, order, padding, swap"))


def _shown(e: Estimate, percent: bool) -> str:
    return show_share(e.value) if percent else show_number(e.value)


def _between(e: Estimate, percent: bool) -> str:
    return card_words.interval(e, show_share if percent else show_number)


def _agreement(card: ReportCard) -> tuple[Card, ...]:
    return (
        Card(
            "Accuracy by margin",
            plots.bars("card-margin", _bars(card.by_margin), "margin of the model's logit"),
            "Quarters of the comparisons, from those the model is least sure of to those it is surest of, with 95 % "
            "intervals. The dashes are a coin; the numbers in the bars count comparisons.",
        ),
        Card(
            "Is it as sure as it may be?",
            plots.reliability("card-reliability", card.calibration.bins),
            "Of comparisons that the model is so sure about, the share in which it was right; below the dashes it is "
            "too sure. Bars and numbers count the comparisons.",
        ),
        Card(
            "Accuracy by difference of gold",
            plots.bars("card-gold", _bars(card.gold.buckets), "difference of gold"),
            "Near ties are hard for a model and for its labelers; what is far apart should be told apart.",
        ),
        Card(
            "Accuracy by difference of length",
            plots.bars("card-length", _bars(card.lengths.buckets), f"difference of {card.lengths.unit}"),
            "Diamonds: how often the longer one was preferred. A model that only counts length would sit on them.",
        ),
    )


def _bars(buckets: list[Bucket]) -> list[Bar]:
    return [
        Bar(
            card_words.span(b),
            b.accuracy.value,
            b.accuracy.low,
            b.accuracy.high,
            b.accuracy.count,
            b.longer.value if b.longer else None,
        )
        for b in buckets
    ]


def _scores(card: ReportCard) -> tuple[Card, ...]:
    points, unit = card.scatter, card.lengths.unit
    varies = card.lengths.spearman.value is not None
    return (
        Card(
            "Score against gold",
            plots.scatter("card-scatter-gold", points.gold, points.score, ("gold", "score"), "gold"),
            "One dot a candidate. Only differences of scores mean anything, and for text only those of one prompt.",
        ),
        Card(
            "Score against length",
            plots.scatter("card-scatter-length", points.length, points.score, (unit, "score"), "learned")
            if varies
            else Markup(""),
            "One dot a candidate. A slope that gold or people do not share is a bias that a policy will find.",
        ),
    )


def _drift(card: ReportCard) -> tuple[Card, ...]:
    at, values = [d.round for d in card.drift], [d.spearman.value for d in card.drift]
    return (
        Card(
            "Drift between rounds",
            plots.lines("card-drift", at, [Line(values, "learned")]),
            "Rank correlation of the scores of the same candidates with those of the round before; 1 is no change.",
        ),
    )
