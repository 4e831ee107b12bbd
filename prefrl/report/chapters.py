"""The figures of a report, by the question that they answer, each with how to read it."""

from __future__ import annotations

from dataclasses import dataclass

from markupsafe import Markup

from prefrl.evaluate.summary import STAGES
from prefrl.report import plots
from prefrl.report.facts import Facts
from prefrl.report.plots import Line
from prefrl.report.records import Record, whole


@dataclass(frozen=True)
class Card:
    """A figure with how to read it."""

    title: str
    figure: Markup
    """Empty while there is nothing to draw."""
    reading: str


@dataclass(frozen=True)
class Chapter:
    """Figures that answer one question."""

    question: str
    cards: tuple[Card, ...]


def chapters(record: Record, facts: Facts) -> tuple[Chapter, ...]:
    """All figures. Those of a text's drift are there only where the run measures it."""
    drift = _drift(record) if facts.words.drifts or facts.kl is not None else ()
    return (
        Chapter("Did it help?", _learning(record) + drift),
        Chapter("Was the reward model right?", _fitting(record)),
        Chapter("What did it cost?", _cost(record, facts)),
    )


def _numbers(record: Record) -> list[int]:
    return [whole(line["round"]) or 0 for line in record.rounds]


def _learning(record: Record) -> tuple[Card, ...]:
    at = _numbers(record)
    gold, learned = record.series("evaluate/gold"), _learned(record)
    spread = record.series("evaluate/gold_std")
    band = spread if any(value is not None for value in spread) else ()
    undone = record.series("evaluate/undone_gold")
    rounds = [str(number) for number, value in zip(at, undone, strict=True) if value is not None]
    curves = [Line(gold, "gold", "of the policy that stands" if rounds else "", spread=band)]
    said = f" Undone, since the newest reward saw a clear loss: round {', '.join(rounds)}." if rounds else ""
    return (
        Card(
            "Gold, hidden from the learner",
            plots.lines("gold", at, [*curves, *([Line(undone, "muted", "undone")] if rounds else [])]),
            "The task's own value of fresh behaviour, which nothing that learns may read: up is better. "
            f"The band is one standard deviation between episodes or responses.{said}",
        ),
        Card(
            "Learned reward",
            plots.lines("learned", at, [Line(learned, "learned", dash="--")]),
            "What the policy was trained on. It has no absolute scale and is fitted anew each round: "
            "it may fall while the policy gets better. Do not compare its values with gold, or between rounds.",
        ),
        Card(
            "Do the two agree?",
            plots.path("agreement", learned, gold, ("learned reward", "gold")),
            "One dot a round, joined in order. Up is progress. Right and down is the mark of a policy "
            "that exploits errors of the reward model; left is a new fit that moved the scale.",
        ),
    )


def _learned(record: Record) -> list[float | None]:
    """The learned reward; what a model said before its first fit is noise, and left out."""
    fits = [loss is not None for loss in record.series("fit/loss")]
    first = fits.index(True) if True in fits else 0
    return [value if i >= first else None for i, value in enumerate(record.series("evaluate/learned"))]


def _drift(record: Record) -> tuple[Card, ...]:
    at = _numbers(record)
    kl, fluency, gold = (record.series(f"evaluate/{key}") for key in ("kl", "fluency", "gold"))
    return (
        Card(
            "Distance from the start (KL)",
            plots.lines("kl", at, [Line(kl, "ink")], zero=True),
            "Nats per response between the policy and the starting one: how far it has moved to get here.",
        ),
        Card(
            "Fluency",
            plots.lines("fluency", at, [Line(fluency, "ink")], percent=True, zero=True),
            "The share of responses that are well formed. Gold that rises while fluency falls is reward hacking.",
        ),
        Card(
            "Gold for each nat of KL",
            plots.path("frontier", kl, gold, ("KL, nats per response", "gold")),
            "One dot a round. Where the curve bends down, more optimisation makes things worse.",
        ),
    )


def _fitting(record: Record) -> tuple[Card, ...]:
    at = _numbers(record)

    def both(name: str) -> list[Line]:
        held_out, training = record.series(f"fit/{name}_held_out"), record.series(f"fit/{name}")
        return [Line(held_out, "learned", "held out"), Line(training, "muted", "training", dash="--")]

    return (
        Card(
            "Accuracy",
            plots.lines("accuracy", at, both("accuracy"), percent=True),
            "The share of comparisons whose winner the reward model names. 50 % is a coin; held-out comparisons were "
            "never trained on.",
        ),
        Card(
            "Loss",
            plots.lines("loss", at, both("loss")),
            "Negative log-likelihood of a judgement in nats; a coin has 0.69. A held-out loss that rises while the "
            "training loss falls is overfitting.",
        ),
        Card(
            "Calibration",
            plots.reliability("calibration", record.reliability),
            "Of held-out comparisons that the model is so sure about, the share in which it was right, with 95 % "
            "intervals; below the dashes it is too sure. Bars and numbers count the comparisons.",
        ),
    )


def _cost(record: Record, facts: Facts) -> tuple[Card, ...]:
    at = _numbers(record)
    seconds = {stage: record.series(f"seconds/{stage}") for stage in STAGES}
    labels = [("answered", "learned", "-"), ("asked", "muted", "--"), ("skipped", "gold", ":")]
    steps = [("learn", "improve", "-"), ("query", "sample", "--"), ("evaluate", "evaluate", ":")]
    return (
        Card(
            "Labels",
            plots.lines("labels", at, [Line(record.series(f"label/{n}"), c, n, d) for n, c, d in labels], zero=True),
            "Queries asked, answered and skipped so far.",
        ),
        Card(
            f"{facts.words.spent}s".capitalize(),
            plots.lines("steps", at, [Line(record.series(f"steps/{n}"), c, n, d) for n, c, d in steps], zero=True),
            "Spent so far by purpose; every one is counted once.",
        ),
        Card(
            "Seconds of each round",
            plots.stacked("time", at, seconds),
            "Wall time by stage, in the colours of the bar below.",
        ),
    )
