"""The run in words, and its numbers as people read them."""

from __future__ import annotations

import math
import re
from difflib import SequenceMatcher

from prefrl.report.facts import Facts
from prefrl.report.records import Example


def headline(facts: Facts) -> str:
    """What happened, in one plain sentence."""
    spent = [
        show_answers(facts),
        show_count(sum(v or 0 for v in facts.steps.values()), facts.words.spent) if any(facts.steps.values()) else "",
        show_time(facts.total_seconds) if facts.total_seconds else "",
    ]
    cost = ", ".join(word for word in spent if word)
    took = f"{'in' if facts.finished else 'so far, in'} {show_count(facts.rounds, 'round')}" + (
        f" ({cost})" if cost else ""
    )
    before, after, _ = facts.gold
    if before is None or after is None:
        return _without_gold(facts, took) if facts.rounds else _before_any_round(facts)
    start, end = show_number(before, after), show_number(after, before)
    if start == end:
        return f"Gold stayed at {end} {took}."
    return f"Gold {'rose' if after > before else 'fell'} from {start} to {end} {took}."


def show_answers(facts: Facts) -> str:
    """How many labels there were, and how many of them showed what to do; empty where that is not known."""
    answered, shown = facts.labels["answered"], facts.labels["demonstrations"]
    if answered is None or not shown:
        return "" if answered is None else show_count(answered, "label")
    return show_count(shown, "demonstration") + (
        f" and {show_count(answered - shown, 'other label')}" if answered > shown else ""
    )


def _before_any_round(facts: Facts) -> str:
    answers = show_answers(facts)
    return f"No round is over yet; there are {answers}." if facts.labels["answered"] else "No round is over yet."


def _without_gold(facts: Facts, took: str) -> str:
    if facts.won is None:
        return f"There is no gold to tell whether it helped, {took}."
    return f"The policy beats its start in {show_share(facts.won.value)} of its {facts.words.behaviour}s, {took}."


def _wins(facts: Facts) -> list[str]:
    """How sure the win rate is, in a sentence or none."""
    won, who = facts.won, "the reward it was trained on" if facts.fixed else "its newest reward"
    if won is None:
        return []
    between = f"95\N{NO-BREAK SPACE}% interval {show_share(won.low)} to {show_share(won.high)}"
    sure = "" if won.low is None else f" ({between})"
    chance = " That may be chance." if won.low is not None and won.low <= 0.5 <= (won.high or 1.0) else ""
    behaviour = f"{facts.words.behaviour}s"
    return [
        f"By {who}, {show_share(won.value)} of {won.count} {behaviour} are worth more than the start's{sure}.{chance}"
    ]


def _doubts(facts: Facts) -> list[str]:
    """That the reward may know nothing yet, and what to do about it, in a sentence; none where gold rose clearly."""
    known, (before, after, _) = facts.held_out, facts.gold
    if known is None or known.value is None or known.low is None or known.low > 0.5:
        return []
    if before is not None and after is not None and after > before and not _noise(facts, after - before):
        return []  # it knew enough
    return [
        f"On {show_count(known.count, 'held-out comparison')} the reward is not clearly better than a coin "
        f"({show_share(known.value)} right): more labels tell, and so does how often two labelers agree."
    ]


def _noise(facts: Facts, change: float) -> str:
    """What to say of a change of gold that may be chance; "" where it may not, or nobody can tell."""
    spreads = [value for value in facts.gold_spread if value is not None]
    if len(spreads) < 2:
        return ""
    if facts.measured is None:
        small = abs(change) < min(spreads)
        return f"smaller than one standard deviation between {facts.words.behaviour}s" if small else ""
    error = math.hypot(*spreads) / math.sqrt(facts.measured)
    return f"within the noise of {facts.measured} {facts.words.behaviour}s" if abs(change) < 1.96 * error else ""


def verdict(facts: Facts) -> str:
    """What to think of it: worse, within the spread, past its best, by a reward that may know nothing, less fluent."""
    before, after, best = facts.gold
    remarks = []
    if before is not None and after is not None:
        if after < before:
            remarks.append("The policy got worse.")
        if after != before and (noise := _noise(facts, after - before)):
            remarks.append(f"The change is {noise}.")
        if best is not None and best > max(after, before) and best - after > 0.1 * (best - before):
            remarks.append(f"Its best round reached {show_number(best)}: it has been better than it ended.")
    if facts.shown is not None:
        remarks.append(f"It learned from {show_count(facts.shown, 'demonstration')}; nothing was compared.")
    remarks += _wins(facts) + _doubts(facts)
    if facts.drifted is not None:
        since, near, far = facts.drifted
        remarks.append(
            f"Since round {since} it went from {show_number(near)} to {show_number(far)} nats away from its start, but "
            "its learned score did not rise: stop earlier, or keep it nearer to its start."
        )
    start, end = facts.fluency
    if start is not None and end is not None:
        if show_share(start) == show_share(end):
            remarks.append(f"Fluency stayed at {show_share(end)}.")
        else:
            change = "fell" if end < start else "rose"
            remarks.append(f"Fluency {change} from {show_share(start)} to {show_share(end)}.")
    return " ".join(remarks)


def changes(before: Example | None, after: Example) -> list[tuple[str, bool]]:
    """A text in parts, each with whether it is new beside what was there before for the same prompt; all old if
    nothing was."""
    if before is None or before.prompt != after.prompt or not before.text:
        return [(after.text, False)]
    old, new = (re.findall(r"\s*\S+|\s+$", text) for text in (before.text, after.text))
    matcher = SequenceMatcher(None, [word.strip() for word in old], [word.strip() for word in new], autojunk=False)
    return [("".join(new[a:b]), tag != "equal") for tag, _, _, a, b in matcher.get_opcodes() if b > a]


def show_number(value: float | None, beside: float | None = None) -> str:
    """Three or so significant digits, those of the larger one when beside another; a dash for what is not known."""
    if value is None:
        return "–"
    size = max(abs(value), abs(beside or 0.0))
    if size and (size < 0.001 or size >= 1e9):
        return f"{value:.1e}".replace("-", "−")
    digits = 0 if size >= 100 or not size else 1 if size >= 10 else 2 if size >= 0.1 else 3
    return f"{value:,.{digits}f}".replace("-", "−")


def show_share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f}\N{NO-BREAK SPACE}%".replace("-", "−")


def show_time(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    if seconds < 0.95:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def show_count(count: int | None, what: str = "") -> str:
    shown = "–" if count is None else f"{count:,}"
    return f"{shown} {what}{'' if count == 1 else 's'}" if what else shown
