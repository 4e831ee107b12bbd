"""Figures that only some runs have: beside an expert, in a world known exactly or learned, with a judge."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

from markupsafe import Markup

from prefrl.evaluate.card import Mistakes
from prefrl.report import plots
from prefrl.report.plots import Card, Line, known
from prefrl.report.records import Record
from prefrl.report.words import show_count, show_number


def shifting(record: Record) -> tuple[Card, ...]:
    """How errors come of errors, where an expert was at hand to measure them."""
    shift = record.shift
    if shift is None or not shift.rounds:
        return ()
    first, last = shift.rounds[0], shift.rounds[-1]
    shown = [(first, "muted", "start"), (last, "improve", f"round {last.round}")][-len(shift.rounds) :]
    at = [[shift.every * (i + 1) for i in range(len(one.error))] for one, _, _ in shown]
    sums = [_added_up(one, shift.every) for one, _, _ in shown]
    ends, eps = at[-1], last.eps
    level = [(ends, Line([eps] * len(ends), "ink", "eps", "--"))]
    bounds = [
        (ends, Line([eps * h for h in ends], "ink", "eps H", "--")),
        (ends, Line([eps * h * h / 2 for h in ends], "ink", "eps H²/2", ":")),
    ]
    return (
        Card(
            "Error at each step",
            plots.several(
                "shift-error",
                [*((x, Line(one.error, c, n)) for x, (one, c, n) in zip(at, shown, strict=True)), *level],
                "step of an episode",
            ),
            "How far the policy's action is from the expert's in the states that the policy comes to: 0 is the same, 1 "
            f"the farthest there is. The mean over {shift.episodes} evaluation episodes, as long as they go on. eps, "
            f"{show_number(eps)}, is the mean error of round {last.round} over all steps of as many episodes of the "
            "expert's own. A policy that stays far above it has left the states that the expert comes to.",
        ),
        Card(
            "Mistakes up to step H",
            plots.several(
                "shift-sum",
                [
                    *((x, Line(s, c, n)) for x, s, (_, c, n) in zip(at, sums, shown, strict=True)),
                    *(bounds if eps else ()),
                ],
                "H, steps of an episode",
                log=True,
            ),
            f"The same errors added up, both axes logarithmic. {_compounding(sums[-1][-1], eps, ends[-1])}",
        ),
    )


def exactly(record: Record) -> tuple[Card, ...]:
    """Regret, and maps of reward, policy and value, where all of a world is known."""
    exact = record.exact
    if exact is None or not exact.rounds:
        return ()
    numbers, regrets = [one.round for one in exact.rounds], [one.regret for one in exact.rounds]

    def drawn(name: str, values: Sequence[float], moves: Sequence[tuple[int, int]] = ()) -> Markup:
        return plots.cells(f"exact-{name}", exact.rows, exact.cells, values, moves)

    return (
        Card(
            "Regret",
            plots.lines("exact-regret", numbers, [Line(regrets, "improve")], percent=True, zero=True),
            "By how much of the way from the best policy down to the worst a round's policy lies behind; computed from "
            f"the world's tables, not played. The newest misses {regrets[-1]:.1%}.",
        ),
        Card(
            "Gold of each cell",
            drawn("gold", exact.gold),
            "The reward of a step from each cell, which nothing that learns sees. Letters are those of task.rows.",
        ),
        Card(
            "What was learned of it",
            drawn("learned", exact.learned),
            "The newest reward model's, the mean over actions. Zero and scale are its own: compare the pattern.",
        ),
        Card(
            "Where the policy goes, and how often it is there",
            drawn("visits", exact.visits, exact.moves),
            f"The share of its time in each cell, with a discount of {exact.discount:g} a step. Arrows are its moves.",
        ),
        Card(
            "What each cell is worth to it",
            drawn("worth", exact.worth, exact.moves),
            f"The gold that it earns from there on, with a discount of {exact.discount:g} a step.",
        ),
    )


def _added_up(one: Mistakes, every: int) -> list[float]:
    return list(accumulate(every * e * r for e, r in zip(one.error, one.running, strict=True)))


def _compounding(total: float, eps: float, steps: int) -> str:
    if not eps:
        return "The newest policy errs nowhere in the expert's own episodes, so there are no lines to compare with."
    linear, square = show_number(total / (eps * steps)), show_number(2 * total / (eps * steps**2))
    return (
        "With an error of eps at every step they are eps H; where one mistake spoils all that comes after it they are "
        f"about eps H²/2. After {show_count(steps, 'step')} the newest policy has {show_number(total)}, which is "
        f"{linear} times eps H and {square} times eps H²/2."
    )


def judging(record: Record) -> tuple[Card, ...]:
    """Of a judge that is asked in both orders."""
    shares = {"flipped": record.series("label/flipped"), "refused": record.series("label/refused")}
    bias = record.series("label/position_bias")
    if not known(shares["refused"]):
        return ()
    newest = next((value for value in reversed(bias) if value is not None), None)
    told = "" if newest is None else f" In the newest round that is {show_number(newest)}."
    curves = [
        Line(shares["flipped"], "muted", "changed with the order"),
        Line(shares["refused"], "gold", "refused", ":"),
    ]
    return (
        Card(
            "Position bias",
            plots.lines("bias", record.numbers, [Line(bias, "muted")], zero=True),
            "The mean probability that the judge gives to what it is shown first, less a half: 0 is fair, and 0.5 is "
            f"one that always says the first.{told} Its answers are means over both orders.",
        ),
        Card(
            "Changed with the order, or refused",
            plots.lines("verdicts", record.numbers, curves, zero=True),
            "The shares of pairs whose winner changes with the order, and of those that the judge refused, which are "
            "skipped.",
        ),
    )


def dreaming(record: Record) -> tuple[Card, ...]:
    """Of learners with a learned world."""
    at, held, reach = record.numbers, record.series("improve/world_held_out"), record.series("improve/reach")
    if not known(held):
        return ()
    imagined = record.series("evaluate/imagined")
    real = [r if i is not None else None for r, i in zip(record.series("evaluate/learned"), imagined, strict=True)]
    dreamt = "The run stopped dreaming where they have no steps. " if 0 in reach else ""
    curves = [Line(record.series("improve/branch"), "improve", "mean"), Line(reach, "muted", "most", "--")]
    both = [Line(real, "learned", "real"), Line(imagined, "sample", "imagined", "--")] if known(imagined) else []
    return (
        Card(
            "Imagined and real return",
            plots.lines("imagined", at, both),
            "The learned reward of the same policy from the same first states, in the learned world and in the real "
            "one. Where the imagined one is far above, the policy lives on the world's mistakes.",
        ),
        Card(
            "Error of the learned world",
            plots.lines("world", at, [Line(held, "muted")], zero=True),
            "In real steps that no fit saw, as a share of the variance of what a step changes: 1 is a world that knows "
            "no more than the mean.",
        ),
        Card(
            "Steps of an imagined branch",
            plots.lines("branches", at, [one for one in curves if known(one.values)], zero=True),
            f"{dreamt}A branch is cut where the members of the world disagree, and none is longer than its held-out "
            "error allows.",
        ),
    )
