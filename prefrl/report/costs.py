"""What a run would cost out there: hours of the world, minutes of people and seconds of the machine, side by side.

In a simulator a step costs nothing, and a simulated teacher answers at once. A robot takes its time for each step, and
a person for each answer: which of the three is slowest says what to save.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from prefrl.report.words import show_count, show_number, show_time

AN_ANSWER = 5.0
"""Seconds of a person for an answer that nobody timed: those of Christiano et al. 2017, section 3.1, took 3 to 5."""


class Spent(NamedTuple):
    """What a run takes, or will take."""

    steps: int
    """Of the environment, all purposes together."""
    rate: float | None
    """Steps a second in the world; None where there is no world outside, as for texts."""
    answers: int
    people: float | None
    """Seconds that people took for their answers; None where nobody measured it, 0 where a model gave them."""
    machine: float
    """Seconds of computing; waiting for people is not among them."""


class Cost(NamedTuple):
    """A share of it."""

    who: str
    seconds: float
    how: str
    """How the seconds come about, as the end of a sentence about them."""


def costs(spent: Spent) -> tuple[Cost, ...]:
    """The world's where there is one, people's where anything was answered, and the machine's."""
    found = []
    if spent.rate:
        how = f"{show_count(spent.steps, 'step')} at {show_number(spent.rate)} a second"
        found.append(Cost("the world", spent.steps / spent.rate, how))
    if spent.people:
        found.append(Cost("people", spent.people, f"{show_count(spent.answers, 'answer')}, as the page timed them"))
    elif spent.people is None and spent.answers:
        how = f"{show_count(spent.answers, 'answer')} at {AN_ANSWER:g} s each"
        found.append(Cost("people", AN_ANSWER * spent.answers, how))
    return (*found, Cost("the machine", spent.machine, "all stages but waiting for people"))


def account(found: Sequence[Cost]) -> str:
    """All of it in a sentence each, the slowest named last."""
    each = " ".join(f"{one.who.capitalize()}: {show_time(one.seconds)} ({one.how})." for one in found)
    slowest = max(found, key=lambda one: one.seconds)
    return f"{each} The bottleneck is {slowest.who}." if len(found) > 1 else each
