"""The figures of a report, by the question that they answer, each with how to read it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle

from markupsafe import Markup

from prefrl.evaluate.card import Hindsight
from prefrl.evaluate.summary import STAGES
from prefrl.report import plots
from prefrl.report.costs import Spent, account, costs
from prefrl.report.facts import Facts
from prefrl.report.particular import dreaming, exactly, judging, shifting
from prefrl.report.plots import Card, Line, Series, known
from prefrl.report.records import Record, visible, whole
from prefrl.report.words import show_count, show_number, show_time
from prefrl.stats.estimates import Estimate

ROUNDING = 1e-9
TASKS = ("gold", "learned", "improve", "label", "evaluate", "ink")
"""Colours of several tasks, by turns."""
INTERVAL = 1.96
"""Standard errors on each side of a mean."""
IMAGINED = (
    " They are about what the policy would do, imagined in its learned world, or about what it did where that world "
    "could not be followed for a whole segment."
)
TRAINING = {
    "Entropy": ("improve/entropy", "How undecided the policy is, in nats a step: it falls as it makes up its mind."),
    "Step size": (
        "improve/kl_old",
        "How far an update moves the policy, in nats: a jump is one that went wrong.",
    ),
    "Clipped": ("improve/clipped", "The share of steps whose probability ratio left the clip's range."),
    "Critic": ("improve/explained", "The share of the returns' variance that the critic foresees: 1 is all, 0 none."),
    "Loss": ("improve/loss", "What the gradient steps minimise: it need not fall for the policy to get better."),
    "Cloning": ("improve/cloning_loss", "How far it is from what was shown, in nats a step: it falls as it follows."),
    "Learning rate": ("improve/learning_rate", "At the end of each round's updates, or on average."),
    "Length": ("evaluate/length", "Of what the policy does, on average: a reward that pays for length shows here."),
}
"""Name -> the metric, and how to read it."""


@dataclass(frozen=True)
class Chapter:
    """Figures that answer one question."""

    question: str
    cards: tuple[Card, ...]


def chapters(record: Record, facts: Facts) -> tuple[Chapter, ...]:
    """All figures that the run can have: none of a text's drift where it measures none, none of gold where there is
    none, and once it is over none that is empty."""
    found: tuple[Chapter, ...] = (
        Chapter("Did it help?", (*_learning(record, facts), *_drift(record, facts))),
        Chapter("Does it follow the expert?", shifting(record)),
        Chapter("How far from the best?", exactly(record)),
        Chapter("Was the judge fair?", judging(record)),
        Chapter("Was the reward model right?", () if facts.fixed else _fitting(record)),
        Chapter("Is its world like the real one?", dreaming(record)),
        Chapter("How did it learn?", _training(record)),
        Chapter("What did it cost?", _cost(record, facts)),
    )
    if facts.finished:
        found = tuple(replace(c, cards=tuple(card for card in c.cards if card.figure)) for c in found)
    return tuple(chapter for chapter in found if chapter.cards)


def _learning(record: Record, facts: Facts) -> tuple[Card, ...]:
    gold = (_gold(record), *_golds(record)) if known(record.series("evaluate/gold")) or not facts.finished else ()
    if record.hindsight is None:
        return (*gold, _learned_then(record, facts))
    agreement = (_agreement(record),) if gold else ()
    return (*gold, *_by_newest(record.hindsight, facts), *agreement)


def _gold(record: Record) -> Card:
    at, gold, spread = record.numbers, record.series("evaluate/gold"), record.series("evaluate/gold_std")
    counts = record.series("evaluate/count")
    means = known(counts)  # runs of before did not count
    width = [
        None if g is None or s is None else INTERVAL * s / math.sqrt(n) if n else s
        for g, s, n in zip(gold, spread, counts, strict=True)
    ]
    edges = [
        [None if g is None or w is None else g + sign * w for g, w in zip(gold, width, strict=True)] for sign in (-1, 1)
    ]
    undone = record.series("evaluate/undone_gold")
    rounds = [str(number) for number, value in zip(at, undone, strict=True) if value is not None]
    low, high = edges if known(width) else ((), ())
    curves = [Line(gold, "gold", "of the policy that stands" if rounds else "", low=low, high=high)]
    said = f" Undone, since the newest reward saw a clear loss: round {', '.join(rounds)}." if rounds else ""
    band = "95 % interval of the mean" if means else "standard deviation between episodes or responses"
    return Card(
        "Gold, hidden from the learner",
        plots.lines("gold", at, [*curves, *([Line(undone, "muted", "undone")] if rounds else [])]),
        "The task's own value of fresh behaviour, which nothing that learns may read: up is better. "
        f"The band is the {band}.{said}",
    )


def _golds(record: Record) -> tuple[Card, ...]:
    """Of each of several tasks."""
    mark = "evaluate/gold/"
    names = sorted({key.removeprefix(mark) for line in record.rounds for key in line if key.startswith(mark)})
    shades = zip(names, cycle(TASKS), strict=False)
    curves = [Line(record.series(mark + name), colour, visible(name, 40)) for name, colour in shades]
    drawn = plots.lines("golds", record.numbers, curves) if curves else Markup("")
    reading = "The mean of the episodes of each task. What is called gold elsewhere is the mean of these."
    return (Card("Gold of each task", drawn, reading),) if drawn else ()


def _by_newest(found: Hindsight, facts: Facts) -> tuple[Card, ...]:
    at = [seen.round for seen in found.rounds]
    who = "the reward that the run began with" if facts.fixed else f"the newest reward, of round {found.fitted_round}"
    behaviour = facts.words.behaviour

    def line(estimates: Sequence[Estimate]) -> Line:
        return Line(
            [e.value for e in estimates], "learned", low=[e.low for e in estimates], high=[e.high for e in estimates]
        )

    return (
        Card(
            "Learned reward",
            plots.lines("learned", at, [line([seen.learned for seen in found.rounds])]),
            f"What each round's {behaviour}s are worth by {who}: one reward for all rounds, so that they can be "
            "compared. The policy was trained on it, and may exploit its errors. The band is the 95 % interval.",
        ),
        Card(
            "Wins against the start",
            plots.lines(
                "won",
                at[1:],
                [line([seen.won for seen in found.rounds[1:]])],
                percent=True,
                zero=True,
                beside=0.5,
            ),
            f"How often a round's {behaviour} is worth more, by {who}, than the starting policy's from the same "
            f"{facts.words.start}. At the dashes the policy is no better than the start.",
        ),
    )


def _learned_then(record: Record, facts: Facts) -> Card:
    """What each round's reward said of its own policy."""
    scale = (
        "It is the reward that the run began with, the same in all rounds."
        if facts.fixed
        else "It has no absolute scale and is fitted anew each round: it may fall while the policy gets better. "
        "Do not compare its values with gold, or between rounds."
    )
    return Card(
        "Learned reward",
        plots.lines("learned", record.numbers, [Line(record.learned, "learned", dash="--")]),
        f"What the policy was trained on. {scale}",
    )


def _agreement(record: Record) -> Card:
    learned = record.by_newest
    return Card(
        "Do the two agree?",
        plots.path("agreement", learned, record.series("evaluate/gold"), ("learned reward", "gold")),
        "One dot a round, joined in order. Up is progress. Right and down is the mark of a policy that exploits "
        "errors of the reward model.",
    )


def _drift(record: Record, facts: Facts) -> tuple[Card, ...]:
    if not facts.words.drifts and facts.kl is None:
        return ()
    at = record.numbers
    kl, fluency, gold = (record.series(f"evaluate/{key}") for key in ("kl", "fluency", "gold"))
    return (
        Card(
            "Distance from the start (KL)",
            plots.lines("kl", at, [Line(kl, "ink")], zero=True),
            f"Nats per {facts.words.behaviour} between the policy and the starting one: how far it has moved to get "
            "here.",
        ),
        _side_effect(record, fluency),
        Card(
            "Gold for each nat of KL",
            plots.path("frontier", kl, gold, (f"KL, nats per {facts.words.behaviour}", "gold")),
            "One dot a round. Where the curve bends down, more optimisation makes things worse.",
        ),
        _gains(record, kl, gold, facts.words.behaviour),
    )


def _side_effect(record: Record, fluency: Series) -> Card:
    """What a policy may lose on its way: whether texts stay fluent, or pictures differ."""
    spread = record.series("evaluate/spread")
    if any(value is not None for value in spread):
        return Card(
            "Spread",
            plots.lines("spread", record.numbers, [Line(spread, "ink")], zero=True),
            "How much pictures of one caption differ, as a share of how much real ones do. Gold that rises while the "
            "spread falls to nothing is one picture drawn over and over.",
        )
    return Card(
        "Fluency",
        plots.lines("fluency", record.numbers, [Line(fluency, "ink")], percent=True, zero=True),
        "The share of responses that are well formed. Gold that rises while fluency falls is reward hacking.",
    )


def _gains(record: Record, kl: Series, gold: Series, behaviour: str) -> Card:
    curves = [
        Line(_of_best_gain(gold), "gold", "gold"),
        Line(_of_best_gain(record.by_newest), "learned", "learned reward", dash="--"),
    ]
    return Card(
        "Over-optimisation",
        plots.against("gains", kl, curves, (f"KL, nats per {behaviour}", "share of the best gain")),
        "What was gained since the start, as a share of the most that either has gained. Gold that bends down while "
        "the learned reward goes on rising is Goodhart's law at work: an earlier round is the better policy.",
    )


def _of_best_gain(values: Series) -> list[float | None]:
    """From 0 at the first to 1 at the best; nothing where nothing was gained."""
    known = [value for value in values if value is not None]
    best = max(known) - known[0] if known else 0.0
    return [None if value is None or not best else (value - known[0]) / best for value in values]


def _fitting(record: Record) -> tuple[Card, ...]:
    at = record.numbers

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
        *(() if record.card else (_calibration(record),)),  # a card has one of its own
        *_apart(record),
    )


def _apart(record: Record) -> tuple[Card, ...]:
    """What comparisons and demonstrations had each in fits on both."""
    if not known(record.series("fit/trained/shown")):
        return ()
    kinds = (("judged", "judgements", "learned", "-"), ("shown", "demonstrations", "gold", "--"))

    def curves(key: str) -> list[Line]:
        return [Line(record.series(f"fit/{key}/{kind}"), colour, name, dash) for kind, name, colour, dash in kinds]

    def newest(key: str, kind: str) -> float | None:
        return record.last(f"fit/{key}/{kind}")

    told = " and ".join(
        f"{show_count(whole(newest('trained', kind)), name[:-1])} of weight {show_number(newest('weight', kind))}"
        for kind, name, _, _ in kinds
    )
    out = " and ".join(show_count(whole(newest("held_out", kind)), name[:-1]) for kind, name, _, _ in kinds)
    return (
        Card(
            "Accuracy on what was judged, and on what was shown",
            plots.lines("apart-accuracy", record.numbers, curves("accuracy_held_out"), percent=True),
            "Of held-out judgements, and of held-out demonstrations, which say that what was shown is better than what "
            f"the policy did: the share that the reward model names right. In the newest fit {out} were held out.",
        ),
        Card(
            "Shares of the loss",
            plots.lines("apart-loss", record.numbers, curves("loss_share"), percent=True, zero=True),
            f"How much of the fit's loss is from each. The newest fit was trained on {told}: a share of the loss above "
            "the share of the weight is what it could not yet explain.",
        ),
    )


def _calibration(record: Record) -> Card:
    return Card(
        "Calibration",
        plots.reliability("calibration", record.reliability),
        "Of held-out comparisons that the model is so sure about, the share in which it was right, with 95 % "
        "intervals; below the dashes it is too sure. Bars and numbers count the comparisons.",
    )


def _training(record: Record) -> tuple[Card, ...]:
    """What the learner says of itself, where it says it and it changes."""
    found = {name: record.series(f"{TRAINING[name][0]}") for name in TRAINING}
    return tuple(
        Card(name, plots.lines(f"training-{i}", record.numbers, [Line(found[name], "improve")]), reading)
        for i, (name, (_, reading)) in enumerate(TRAINING.items())
        if _changes(found[name])
    )


def _changes(values: Series) -> bool:
    """By more than rounding: the ratio of a single step is always 1, and its distance some 1e-13."""
    known = [value for value in values if value is not None]
    return bool(known) and max(known) - min(known) > ROUNDING


def _cost(record: Record, facts: Facts) -> tuple[Card, ...]:
    at = record.numbers
    seconds = {stage: record.series(f"seconds/{stage}") for stage in STAGES}
    steps = [("learn", "improve", "-"), ("query", "sample", "--"), ("evaluate", "evaluate", ":")]
    return (
        *_labels(record, facts),
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
        *_outside(facts),
    )


def _labels(record: Record, facts: Facts) -> tuple[Card, ...]:
    """None where a run has ended without a label."""
    if facts.finished and not any(facts.labels.values()):
        return ()
    curves = [("answered", "answered", "learned", "-"), ("asked", "asked", "muted", "--")]
    curves.append(("skipped", "skipped", "gold", ":"))
    shown = ""
    if facts.labels["demonstrations"]:
        curves.append(("demonstrations", "shown", "improve", "-."))
        shown = " An answer that shows what to do is counted as shown as well."
    drawn = [Line(record.series(f"label/{name}"), colour, word, dash) for name, word, colour, dash in curves]
    about = IMAGINED if record.imagined else ""
    said = f"Queries asked, answered and skipped so far.{about}{shown}"
    return (Card("Labels", plots.lines("labels", record.numbers, drawn, zero=True), said),)


def _outside(facts: Facts) -> tuple[Card, ...]:
    """Where a simulator or a simulated teacher hides what is dear: the same run with a real world and real people."""
    steps = sum(facts.steps[purpose] or 0 for purpose in ("learn", "query", "evaluate"))  # the real ones
    labels = facts.labels["answered"] or 0
    if not facts.seconds or not (facts.rate or labels):
        return ()
    waited = facts.seconds.get("label", 0.0) if facts.people else 0.0
    machine = sum(facts.seconds.values()) - waited
    found = costs(Spent(steps, facts.rate, labels, facts.people, machine))
    drawn = [(one.who, one.seconds, show_time(one.seconds)) for one in found]
    colours = {"the world": "sample", "people": "label", "the machine": "improve"}
    figure = plots.spans("outside", drawn, [colours[one.who] for one in found])
    return (Card("Out in the world", figure, account(found)),)
