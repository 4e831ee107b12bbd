"""Runs side by side: which belong together, what tells them apart, and the results of each group."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import yaml

from prefrl.components import flat
from prefrl.report.facts import Facts, gather
from prefrl.report.records import Record, mapping, number, read, visible
from prefrl.stats import aggregates
from prefrl.stats.estimates import Estimate
from prefrl.types import Floats

SHOWN = 3
"""Settings that a group is named by; where more differ it is named by its folder."""
APART = ("seed", "track", "labeler.port", "labeler.host", "labeler.clips")
"""Settings that may differ within a group."""


@dataclass(frozen=True)
class Seen:
    """A run, as its folder tells it."""

    folder: Path
    record: Record
    facts: Facts

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Dotted name -> value, without what may differ between the runs of a group."""
        try:
            tree = yaml.safe_load(self.record.config)
        except yaml.YAMLError:
            tree = None
        return {name: value for name, value in flat(mapping(tree)) if name not in APART}

    @property
    def seed(self) -> int:
        return self.facts.seed or 0


@dataclass(frozen=True)
class Group:
    """Finished runs of one task that differ in their seeds alone."""

    name: str
    runs: tuple[Seen, ...]
    by_gold: bool
    """Whether the score is gold; else it is the share of wins against the start."""

    @cached_property
    def scores(self) -> Floats:
        """What the runs ended with, of those that have a score."""
        return np.array([found for run in self.runs if (found := ended(run.facts, self.by_gold)) is not None])

    @cached_property
    def score(self) -> Estimate:
        return aggregates.of_runs([self.scores], np.random.default_rng(0))

    def average(self, values: Iterable[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return mean(known) if known else None

    def curve(self, key: str) -> list[tuple[int, Estimate]]:
        """(round, the interquartile mean of a metric over the runs), for the rounds that all runs have."""
        rows = [{line["round"]: number(line.get(key)) for line in run.record.rounds} for run in self.runs]
        rng, found = np.random.default_rng(0), []
        for at in sorted(set.intersection(*(set(row) for row in rows))):
            values = [row[at] for row in rows]
            if None not in values:
                found.append((int(at), aggregates.of_runs([np.array(values, float)], rng)))
        return found


@dataclass(frozen=True)
class Contest:
    """All groups of one task."""

    task: str
    groups: tuple[Group, ...]
    by_gold: bool
    """Whether the score is gold; else it is the share of wins against the start."""

    def improvement(self, ours: Group, theirs: Group) -> Estimate:
        return aggregates.improvement([ours.scores], [theirs.scores], np.random.default_rng(0))


def ended(facts: Facts, by_gold: bool) -> float | None:
    """A run's score: its last gold, or its share of wins against the start."""
    if by_gold:
        return facts.gold[1]
    return None if facts.won is None else facts.won.value


def found_in(paths: Sequence[Path]) -> list[Seen]:
    """The runs in some folders: a run's own, or one that holds runs, however deep. Raises `ValueError` for none."""
    folders: dict[Path, Path] = {}
    for path in paths:
        if not path.is_dir():
            raise ValueError(
                f"{path} is a file: expected a run's folder" if path.is_file() else f"{path}: no such folder"
            )
        own = [path] if (path / "metrics.jsonl").is_file() else sorted(p.parent for p in path.rglob("metrics.jsonl"))
        if not own:
            raise ValueError(f"{path} holds no run: expected metrics.jsonl in it, or in a folder in it")
        folders |= {folder.resolve(): folder for folder in own}
    records = [(folder, read(folder, examples=False)) for folder in folders.values()]
    return [Seen(folder, record, gather(record)) for folder, record in records]


def contests(runs: Sequence[Seen]) -> list[Contest]:
    """The finished runs, by task and then by their settings, in the order in which they came."""
    found = []
    for task in dict.fromkeys(run.facts.task for run in runs):
        kept = [run for run in runs if run.facts.task == task and run.facts.finished]
        alike: dict[str, dict[int, Seen]] = {}  # by settings, then by seed: a second run of both would tell nothing new
        for run in kept:
            alike.setdefault(repr(sorted(run.settings.items())), {}).setdefault(run.seed, run)
        groups = [tuple(sorted(group.values(), key=lambda run: run.seed)) for group in alike.values()]
        if groups:
            by_gold = any(run.facts.gold[0] is not None or run.facts.gold[1] is not None for run in kept)
            made = (Group(name, group, by_gold) for name, group in zip(_names(groups), groups, strict=True))
            found.append(Contest(task, tuple(made), by_gold))
    return found


def _names(groups: Sequence[tuple[Seen, ...]]) -> list[str]:
    """By the settings that differ; by folder where there are many, or none."""
    differing = _differing([group[0].settings for group in groups])
    if 0 < len(differing) <= SHOWN:
        names = _shortened(differing)
        said = [
            ", ".join(f"{name}={_short(group[0].settings.get(key))}" for key, name in names.items()) for group in groups
        ]
    else:
        said = [_common(group) for group in groups]
    return [f"{name} ({said[:at].count(name) + 1})" if said.count(name) > 1 else name for at, name in enumerate(said)]


def _differing(settings: Sequence[dict[str, Any]]) -> list[str]:
    """Where a kind differs, the rest of that component is not compared: its settings are others."""
    keys = dict.fromkeys(key for one in settings for key in one)
    differ = [key for key in keys if len({repr(one.get(key)) for one in settings}) > 1]
    kinds = [key.removesuffix("kind") for key in differ if key.endswith(".kind")]
    return [key for key in differ if key.endswith(".kind") or not any(key.startswith(kind) for kind in kinds)]


def _shortened(keys: Sequence[str]) -> dict[str, str]:
    """`learner.beta` is said as `beta`, where no other key ends so; a kind keeps its component's name."""
    last = [key.rsplit(".", 1)[-1] for key in keys]
    return {key: end if last.count(end) == 1 and end != "kind" else key for key, end in zip(keys, last, strict=True)}


def _common(group: tuple[Seen, ...]) -> str:
    """A name of a group's folders, without what tells the seeds apart."""
    folder = group[0].folder
    last = folder.parent.name if folder.name == f"seed-{group[0].seed}" and folder.parent.name else folder.name
    return visible(last, 200)


def _short(value: object) -> str:
    return visible("null" if value is None else str(value).lower() if isinstance(value, bool) else value, 40)


def left_out(runs: Sequence[Seen], found: Sequence[Contest]) -> list[str]:
    """A line for each run that does not count, and why."""
    counted = {run.folder: contest for contest in found for group in contest.groups for run in group.runs}
    lines = []
    for run in runs:
        if not run.facts.finished:
            lines.append(f"{run.folder}: not finished, round {run.facts.rounds} of {run.facts.planned or '?'}")
        elif run.folder not in counted:
            lines.append(f"{run.folder}: another run has the same settings and seed")
        elif ended(run.facts, counted[run.folder].by_gold) is None:
            lines.append(f"{run.folder}: it has no score, its last gold is not a number")
    return lines
