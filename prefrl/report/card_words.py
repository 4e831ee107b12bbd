"""A report card in words: one line for each number, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from prefrl.evaluate.card import About, Bucket, Calibration, LabelerPart, ReportCard
from prefrl.report.records import visible
from prefrl.report.words import show_count, show_number, show_share, show_time
from prefrl.stats.estimates import Estimate

PERCENT = "\N{NO-BREAK SPACE}%"
UNDEFINED = "not defined: "


@dataclass(frozen=True)
class Row:
    """One number."""

    name: str
    value: str
    """Empty where the number is not defined."""
    note: str
    """Its interval, or why it is not defined."""


def headline(card: ReportCard) -> str:
    """What the model is worth, in one plain sentence."""
    about, accuracy = card.about, card.accuracy
    which = "held-out comparisons" if about.held_out else "comparisons (all there are, trained on or not)"
    if accuracy.value is None:
        return f"All {show_count(about.comparisons)} {which} are ties: there is no winner to name."
    between = interval(accuracy, show_share)
    between = between.replace(" ", "\N{NO-BREAK SPACE}")  # a heading must not break within an interval
    share = show_share(accuracy.value) + (f" ({between})" if between else "")
    return f"It names the winner of {share} of {show_count(accuracy.count)} {which}."


def groups(card: ReportCard) -> list[tuple[str, list[Row]]]:
    """All numbers of the card, by question."""
    found = [
        ("Accuracy", _accuracy(card)),
        ("Calibration", _calibration(card.calibration)),
        ("Length", _length(card)),
        ("Gold", _gold(card)),
        ("Members", _members(card)),
        ("Self-test", _self_test(card)),
        ("Labelers", [row for one in card.labelers for row in _labeler(one)]),
        ("Drift between rounds", _drift(card)),
    ]
    return [(name, _folded(rows)) for name, rows in found if rows]


def _folded(rows: list[Row]) -> list[Row]:
    """One line where none of the numbers is defined: each reason is given once."""
    if len(rows) < 2 or any(row.value for row in rows):
        return rows
    reasons = dict.fromkeys(row.note.removeprefix(UNDEFINED) for row in rows)
    return [Row("nothing to measure", "", UNDEFINED + "; ".join(reasons))]


def subject(about: About) -> str:
    """What was graded, on what."""
    parts = [
        show_count(about.judgements, "judgement"),
        show_count(about.comparisons, "comparison"),
        show_count(about.ties, "tie"),
        show_count(about.candidates, "candidate"),
    ]
    beside = f"; the fit counted {show_count(about.demonstrations, 'demonstration')} beside them"
    where = f"round {about.round}; " if about.round is not None else ""
    which = "held-out" if about.held_out else "all"
    told = f"{where}{which} judgements of {visible(about.data, 200)}: {', '.join(parts)}" + (
        beside if about.demonstrations else ""
    )
    return told[:1].upper() + told[1:]


def span(bucket: Bucket) -> str:
    """The range of a bucket's margins."""
    if bucket.low.is_integer() and bucket.high.is_integer():
        low, high = show_count(int(bucket.low)), show_count(int(bucket.high))
    else:
        low, high = show_number(bucket.low, bucket.high), show_number(bucket.high, bucket.low)
    return low if low == high else f"{low} to {high}"


def _accuracy(card: ReportCard) -> list[Row]:
    by = [_share(f"where its logit is {span(b)}", b.accuracy) for b in card.by_margin]
    gold = [_share(f"where golds differ by {span(b)}", b.accuracy) for b in card.gold.buckets]
    return [_share("held out" if card.about.held_out else "all judgements", card.accuracy), *by, *gold]


def _calibration(part: Calibration) -> list[Row]:
    rows = [
        _number("log loss, nats", part.log_loss),
        _number("Brier score", part.brier),
        _number("calibration error", part.error),
    ]
    if not part.temperatures:
        return [*rows, Row("temperature", "", f"{UNDEFINED}{visible(part.log_loss_after.why)}")]
    t = " and ".join(show_number(x) for x in part.temperatures)
    return [
        *rows,
        Row("temperatures, one for each half", t, "1 is calibrated; above 1 the model is too sure"),
        _number("log loss with the other half's temperature", part.log_loss_after),
        _number("calibration error with it", part.error_after),
    ]


def _length(card: ReportCard) -> list[Row]:
    part, unit = card.lengths, visible(card.lengths.unit, 40)
    return [
        _number(f"rank correlation of score and {unit}", part.spearman),
        _number("linear correlation (Pearson)", part.pearson),
        _share('accuracy of "the longer one wins"', part.baseline),
        _share("the model, where the longer one was preferred", part.when_longer),
        _share("the model, where the shorter one was preferred", part.when_shorter),
        *(_share(f"the model, where lengths differ by {span(b)}", b.accuracy) for b in part.buckets),
    ]


def _gold(card: ReportCard) -> list[Row]:
    gold, distance = card.gold, card.distance
    return [
        _share("better one by gold named", gold.accuracy),
        _number("rank correlation (Spearman)", gold.spearman),
        _number("rank correlation (Kendall)", gold.kendall),
        _number("EPIC distance of the steps' rewards", distance.epic),
        _number("direct Pearson distance", distance.direct),
        _number("gold explained by the regression, R²", distance.explained),
    ]


def _members(card: ReportCard) -> list[Row]:
    alone = [_share(f"accuracy of member {i}", e) for i, e in enumerate(card.members.accuracy)]
    return [_share("comparisons on which all agree", card.members.unanimous), *alone] if len(alone) > 1 else []


def _self_test(card: ReportCard) -> list[Row]:
    part = card.invariance
    return [
        Row("scores hang on the candidate alone", "yes" if part.passed else "NO", "batch, order, padding, swap"),
        Row("standard deviation of scores", show_number(part.spread), f"n = {part.alone.count}"),
        _tiny("largest change of a score: alone, or in a batch", part.alone),
        _tiny("the same, in a batch turned round", part.reversed),
        _tiny("the same, beside longer ones (padding)", part.padding),
        _tiny("largest abs(P(a > b) + P(b > a) - 1)", part.swap),
        Row("time for 1000 candidates", show_time(card.seconds.value), ""),
    ]


def _labeler(one: LabelerPart) -> list[Row]:
    name = visible(one.name, 60)
    return [
        _share(f"{name}: model agrees", one.accuracy),
        _number(f"{name}: agreement beyond chance (kappa)", one.kappa),
        _share(f"{name}: agrees with gold", one.gold),
        *([_share(f"{name}: error rate by the fit", one.error_rate)] if one.error_rate.value is not None else []),
    ]


def _drift(card: ReportCard) -> list[Row]:
    rows = []
    for step in card.drift:
        rows.append(_number(f"round {step.round}: rank correlation with the round before", step.spearman))
        rows.append(_number(f"round {step.round}: mean shift, standard deviations", step.shift))
    return rows


def _share(name: str, e: Estimate) -> Row:
    if e.value is None:
        return Row(name, "", f"{UNDEFINED}{visible(e.why)}")
    return Row(name, show_share(e.value), _note(e, show_share))


def _number(name: str, e: Estimate) -> Row:
    if e.value is None:
        return Row(name, "", f"{UNDEFINED}{visible(e.why)}")
    return Row(name, show_number(e.value), _note(e, show_number))


def _tiny(name: str, e: Estimate) -> Row:
    if e.value is None:
        return Row(name, "", f"{UNDEFINED}{visible(e.why)}")
    return Row(name, f"{e.value:.1e}".replace("-", "−") if e.value else "0", f"n = {e.count}")


def _note(e: Estimate, form: Callable[[float | None], str]) -> str:
    between = interval(e, form)
    return f"{between}{'; ' if between else ''}n = {e.count:,}" + (
        f"; {visible(e.how)}" if e.how.startswith("no interval") else ""
    )


def interval(e: Estimate, form: Callable[[float | None], str]) -> str:
    """Such as "69 to 97 %"; empty where there is none."""
    if e.low is None or e.high is None:
        return ""
    low = form(e.low)
    return f"{low.removesuffix(PERCENT)} to {form(e.high)}"
