"""Runs side by side, as one self-contained page, and as a table for a document or a program."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from string import ascii_uppercase

import numpy as np
from markupsafe import Markup

from prefrl.report import plots
from prefrl.report.groups import Contest, Group, Seen, contests, ended, found_in, left_out
from prefrl.report.plots import Card, Line, Strip
from prefrl.report.report import page
from prefrl.report.words import show_count, show_number, show_share, show_time
from prefrl.stats import aggregates
from prefrl.stats.estimates import Estimate
from prefrl.storage.files import write_file
from prefrl.types import Json

COLOURS = ("gold", "learned", "fit", "evaluate", "sample", "label", "improve")
DASHES = ("-", "--", ":")
STEPS = 60
"""Points of a performance profile."""
MANY = 8
"""With more groups than this the table of who beats whom would not be read."""


@dataclass(frozen=True)
class Row:
    """A group in a table: name -> what is shown. The same columns for all groups of a task."""

    letter: str
    name: str
    columns: dict[str, str]


@dataclass(frozen=True)
class Section:
    """All groups of one task."""

    task: str
    headline: str
    rows: tuple[Row, ...]
    cards: tuple[Card, ...]
    duels: tuple[tuple[str, tuple[str, ...]], ...]
    """(letter, how likely it is better than each)."""


def compare(paths: Sequence[Path]) -> tuple[list[Contest], list[str]]:
    """The finished runs in some folders, by task and settings, and what is said of the others.

    Raises `ValueError` where there is none.
    """
    runs = found_in(paths)
    found = contests(runs)
    if not found:
        raise ValueError("none of the runs is finished: " + "; ".join(left_out(runs, found)))
    return found, left_out(runs, found)


def write_comparison(paths: Sequence[Path], to: Path) -> tuple[list[Contest], list[str]]:
    """Compare the runs in some folders in a page (.html), a table (.md), or numbers (.json), by the file's name.

    Raises `ValueError` where no run is finished, or the name ends otherwise.
    """
    forms = {".html": _page, ".md": markdown, ".json": _numbers}
    if to.suffix not in forms:
        raise ValueError(f"{to}: expected a name that ends in .html, .md or .json")
    found, others = compare(paths)
    write_file(to, forms[to.suffix](found, others).encode())
    return found, others


def _page(found: Sequence[Contest], others: Sequence[str]) -> str:
    runs = sum(len(group.runs) for contest in found for group in contest.groups)
    return page(
        "comparison.html",
        sections=[_section(contest, f"task{at}") for at, contest in enumerate(found)],
        left_out=others,
        runs=runs,
    )


def markdown(found: Sequence[Contest], others: Sequence[str] = ()) -> str:
    """A table for each task, with the seeds and the versions that made it."""
    blocks = []
    for contest in found:
        rows = rows_of(contest)
        heads = ["", *rows[0].columns]
        lines = [heads, ["---"] * len(heads), *([row.name, *row.columns.values()] for row in rows)]
        cells = ("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
        blocks.append("\n".join([f"**{contest.task}**, seeds {_seeds(contest)}; {_versions(contest)}", "", *cells]))
    return "\n\n".join([*blocks, *others]) + "\n"


def _numbers(found: Sequence[Contest], others: Sequence[str]) -> str:
    groups: list[Json] = [
        {
            "task": contest.task,
            "name": group.name,
            **_asked(group),
            "score": "gold" if contest.by_gold else "wins against the start",
            "interquartile_mean": group.score.value,
            "interval": [group.score.low, group.score.high],
            "runs": [_run(run, contest.by_gold) for run in group.runs],
            "settings": group.runs[0].settings,
            "made_with": _distinct(made for run in group.runs for made in run.facts.made_with),
        }
        for contest in found
        for group in contest.groups
    ]
    return json.dumps({"groups": groups, "left_out": list(others)}, indent=1)


def _run(run: Seen, by_gold: bool) -> Json:
    facts = run.facts
    return {
        "folder": str(run.folder),
        "seed": facts.seed,
        "score": ended(facts, by_gold),
        "gold": facts.gold[:2],
        "kl": facts.kl,
        "fluency": facts.fluency,
        "reward_accuracy": facts.reward_accuracy,
        "labels": facts.labels["answered"],
        "steps": dict(facts.steps),
        "seconds": facts.total_seconds,
    }


def _asked(group: Group) -> Json:
    """What makes the group again: preset or file, settings, and the command; None where the runs do not say it."""
    known = [run.facts for run in group.runs if run.facts.source]
    if not known:
        return {"source": None, "overrides": [], "command": None}
    source, overrides = known[0].source, [one for one in known[0].overrides if not one.startswith("seed=")]
    seeds = [run.seed for run in group.runs]
    several = ["--seeds", str(len(seeds))] if len(seeds) > 1 and _in_a_row(seeds) else []
    first = f"seed={seeds[0] if several or len(seeds) == 1 else 'SEED'}"
    command = shlex.join(["prefrl", "run", source, *several, *overrides, first])
    return {"source": source, "overrides": overrides, "command": command}


def _distinct(values: Iterable[Json]) -> list[Json]:
    return list({json.dumps(value, sort_keys=True): value for value in values}.values())


def rows_of(contest: Contest) -> list[Row]:
    """The results of each group; a column that no group fills is left out."""
    rows = [(letter, group.name, _columns(contest, group)) for letter, group in _lettered(contest)]
    kept = [name for name in rows[0][2] if any(columns[name] != "–" for _, _, columns in rows)]
    return [Row(letter, name, {key: columns[key] for key in kept}) for letter, name, columns in rows]


def _columns(contest: Contest, group: Group) -> dict[str, str]:
    show = show_number if contest.by_gold else show_share
    facts = [run.facts for run in group.runs]
    before = group.average(f.gold[0] for f in facts) if contest.by_gold else None
    return {
        "runs": show_count(len(group.scores)),
        "before": show_number(before, group.score.value),
        "gold" if contest.by_gold else "wins against the start": _with_interval(group.score, contest.by_gold),
        "worst": show(min(group.scores.tolist(), default=None)),
        "best": show(max(group.scores.tolist(), default=None)),
        "labels": _whole(group.average(f.labels["answered"] for f in facts)),
        "steps": _whole(group.average(f.steps["learn"] for f in facts)),
        "KL, nats": show_number(group.average(f.kl for f in facts)),
        "fluency": show_share(group.average(f.fluency[1] for f in facts)),
        "reward accuracy": show_share(group.average(f.reward_accuracy for f in facts)),
        "time": show_time(group.average(f.total_seconds for f in facts)),
    }


def _whole(value: float | None) -> str:
    return show_count(None if value is None else round(value))


def _with_interval(of: Estimate, by_gold: bool) -> str:
    if of.value is None:
        return "–"
    if by_gold:
        value, low, high = (show_number(v, of.value) for v in (of.value, of.low, of.high))
    else:
        value, low, high = (show_share(v) for v in (of.value, of.low, of.high))
    return value if of.low is None else f"{value} ({low} to {high})"


def _lettered(contest: Contest) -> list[tuple[str, Group]]:
    return [(ascii_uppercase[at] if at < 26 else str(at + 1), group) for at, group in enumerate(contest.groups)]


def _section(contest: Contest, name: str) -> Section:
    few = 1 < len(contest.groups) <= MANY
    duels = tuple((letter, _against_all(contest, ours)) for letter, ours in _lettered(contest)) if few else ()
    return Section(contest.task, _headline(contest), tuple(rows_of(contest)), _cards(contest, name), duels)


def _against_all(contest: Contest, ours: Group) -> tuple[str, ...]:
    return tuple("" if ours is other else _chance(contest.improvement(ours, other)) for other in contest.groups)


def _chance(of: Estimate) -> str:
    if of.value is None:
        return "–"
    return f"{of.value:.2f}" if of.low is None else f"{of.value:.2f} ({of.low:.2f} to {_known(of.high, 1.0):.2f})"


def _headline(contest: Contest) -> str:
    """The best group, and how sure that is."""
    lettered = _lettered(contest)
    letter, best = max(lettered, key=lambda pair: _known(pair[1].score.value, -np.inf))
    ended = _with_interval(best.score, contest.by_gold)
    said = f"gold {ended}" if contest.by_gold else f"{ended} wins against the start"
    if len(lettered) == 1:
        return f"{show_count(len(best.runs), 'run')}: {said}."
    chances = {other: contest.improvement(best, group) for other, group in lettered if group is not best}
    nearest = min(chances, key=lambda other: _known(chances[other].low, 0.0))
    low = chances[nearest].low
    if low is None or low <= 0.5:
        return f"No group is surely ahead. {letter}, {best.name}, has {said}; against {nearest} that may be luck."
    chance = _chance(chances[nearest])
    return f"{letter}, {best.name}, is ahead: {said}. A run of it beats one of {nearest} with a chance of {chance}."


def _known(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _cards(contest: Contest, name: str) -> tuple[Card, ...]:
    styles = list(islice(cycle((colour, dash) for dash in DASHES for colour in COLOURS), len(contest.groups)))
    lettered = _lettered(contest)
    strips = [
        Strip(letter, group.scores.tolist(), group.score.value, group.score.low, group.score.high, colour)
        for (letter, group), (colour, _) in zip(lettered, styles, strict=True)
        if group.score.value is not None
    ]
    what = "gold" if contest.by_gold else "wins against the start"
    found = [
        Card(
            f"Where they ended: {what}",
            plots.strips(f"{name}-ended", strips, what),
            "Each dot is a run; the diamond is the mean of the middle half, with its 95 % interval.",
        ),
        *_over_rounds(contest, styles, name),
        Card(
            "How many runs got how far",
            _profiles(contest, styles, f"{name}-profile"),
            f"The share of runs that ended above each value of {what}: higher and further right is better.",
        ),
    ]
    return tuple(card for card in found if card.figure)


def _over_rounds(contest: Contest, styles: Sequence[tuple[str, str]], name: str) -> list[Card]:
    wanted = {
        "evaluate/gold": ("Gold", "The mean of the middle half of the runs, and its 95 % interval."),
        "evaluate/kl": ("KL", "How far from its start the policy is, in nats a response."),
    }
    cards = []
    for key, (title, reading) in wanted.items():
        curves = []
        for (letter, group), (colour, dash) in zip(_lettered(contest), styles, strict=True):
            points = group.curve(key)
            of = [estimate for _, estimate in points]
            line = Line([e.value for e in of], colour, letter, dash, [e.low for e in of], [e.high for e in of])
            curves.append(([at for at, _ in points], line))
        figure = plots.several(f"{name}-{key.replace('/', '-')}", curves, "round")
        cards.append(Card(f"{title} over rounds", figure, reading))
    return cards


def _profiles(contest: Contest, styles: Sequence[tuple[str, str]], name: str) -> Markup:
    scores = np.concatenate([group.scores for group in contest.groups])
    if len(scores) < 2 or np.ptp(scores) == 0:
        return Markup("")
    at = np.linspace(scores.min() - 0.02 * np.ptp(scores), scores.max(), STEPS)
    curves = []
    for (letter, group), (colour, dash) in zip(_lettered(contest), styles, strict=True):
        if not len(group.scores):
            continue
        share, low, high = aggregates.profile([group.scores], at, np.random.default_rng(0))
        line = Line(share.tolist(), colour, letter, dash, low.tolist(), high.tolist())
        curves.append((at.tolist(), line))
    return plots.several(name, curves, "gold" if contest.by_gold else "wins against the start")


def _seeds(contest: Contest) -> str:
    seeds = sorted({run.facts.seed for group in contest.groups for run in group.runs if run.facts.seed is not None})
    return f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 2 and _in_a_row(seeds) else ", ".join(map(str, seeds))


def _in_a_row(seeds: Sequence[int]) -> bool:
    return list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))


def _versions(contest: Contest) -> str:
    first: Seen = contest.groups[0].runs[0]
    return ", ".join(f"{name} {version}" for name, version in first.facts.versions.items())
