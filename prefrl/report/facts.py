"""The run in numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from prefrl.evaluate.summary import STAGES
from prefrl.kinds import RESPONSES, SEGMENTS, Kind, find
from prefrl.report.records import Record, listed, mapping, number, visible, whole
from prefrl.stats.estimates import Estimate
from prefrl.types import Json

FARTHER, MUCH_FARTHER = 0.5, 1.25
"""Nats more, and how many times as many, that are not to be had for nothing."""


class Drifted(NamedTuple):
    """A policy that went on from the start, while its score did not rise."""

    since: int
    """The round with the best score."""
    before: float
    """Nats, after that round."""
    now: float


@dataclass(frozen=True)
class Facts:
    """The run in numbers: from summary.json, or from the rounds so far. None is not known."""

    task: str
    kind: str
    finished: bool
    rounds: int
    planned: int | None
    seed: int | None
    gold: tuple[float | None, float | None, float | None]
    """Before, after, best."""
    gold_spread: tuple[float | None, float | None]
    """Standard deviation between episodes or responses, before and after."""
    measured: int | None
    """Episodes or responses of an evaluation."""
    won: Estimate | None
    """How often the newest policy beats the start, by the newest reward; None where that was not measured."""
    fixed: bool
    """Whether the reward is one that the run began with, and never fitted."""
    fluency: tuple[float | None, float | None]
    reward_accuracy: float | None
    held_out: Estimate | None
    """The newest reward's accuracy on what its fit left out; None where nothing was graded."""
    kl: float | None
    drifted: Drifted | None
    shown: int | None
    """Demonstrations that the policy learned from, where nothing was fitted beside; None where it learned otherwise."""
    labels: Mapping[str, int | None]
    """Those asked, answered and skipped, and how many of the answers are demonstrations."""
    steps: Mapping[str, int | None]
    rate: float | None
    """Steps a second in the world; None where there is none outside, or nobody knows."""
    people: float | None
    """Seconds that people took to answer; None where nobody measured it."""
    seconds: Mapping[str, float]
    """By stage; only stages that were timed."""
    total_seconds: float | None
    versions: Mapping[str, str]
    source: str
    """The preset, or the name of the file of settings; empty where it is not known."""
    overrides: tuple[str, ...]
    made_with: tuple[Json, ...]
    """What the processes that had a part in it computed with: commit, processor, threads, versions."""

    @property
    def words(self) -> Kind[Any]:
        """What people call things where candidates are of this kind; those of control where it is not known."""
        return find(self.kind) or SEGMENTS


def gather(record: Record) -> Facts:
    """The run's facts: the summary's where it has them, else what the rounds say so far."""
    summary, last = record.summary, record.last
    gold, fluency = record.series("evaluate/gold"), record.series("evaluate/fluency")
    spread = record.series("evaluate/gold_std")
    known = [value for value in gold if value is not None]
    seconds = _seconds(record)
    rounds = whole(summary.get("rounds")) or max((whole(line["round"]) or 0 for line in record.rounds), default=0)

    def total(name: str, keys: Sequence[str], stage: str) -> dict[str, int | None]:
        of = mapping(summary.get(name)) or (record.labels if name == "labels" else {})
        return {key: whole(of[key]) if key in of else whole(last(f"{stage}/{key}")) for key in keys}

    def first(key: str, fallback: float | None) -> float | None:
        return number(summary[key]) if key in summary else fallback

    return Facts(
        task=visible(summary.get("task") or record.name, 200),
        kind=visible(summary.get("kind") or (RESPONSES.name if any(v is not None for v in fluency) else ""), 20),
        finished=bool(summary) and rounds >= (record.planned or 0),
        rounds=rounds,
        planned=record.planned,
        seed=whole(summary.get("seed")),
        gold=(
            first("gold_before", gold[0] if gold else None),
            first("gold_after", gold[-1] if gold else None),
            first("gold_best", max(known, default=None)),
        ),
        gold_spread=(spread[0], spread[-1]) if spread else (None, None),
        measured=whole(record.last("evaluate/count")),
        won=_won(record),
        fixed=_fixed(record),
        fluency=(
            first("fluency_before", fluency[0] if fluency else None),
            first("fluency_after", fluency[-1] if fluency else None),
        ),
        reward_accuracy=first("reward_accuracy", last("fit/accuracy_held_out")),
        held_out=record.card.accuracy if record.card and record.card.about.held_out else None,
        kl=first("kl", last("evaluate/kl")),
        drifted=_drifted(record),
        shown=None if _has_fitted(record) else whole(last("improve/demonstrations")),
        labels=total("labels", ("asked", "answered", "skipped", "demonstrations"), "label"),
        steps=total("steps", ("learn", "query", "evaluate"), "steps"),
        rate=number(summary.get("steps_per_second")),
        people=number(summary.get("people_seconds")),
        seconds=seconds,
        total_seconds=number(mapping(summary.get("seconds")).get("total")) or sum(seconds.values()) or None,
        versions={visible(k, 100): visible(v, 200) for k, v in mapping(summary.get("versions")).items()},
        source=visible(summary.get("source"), 200),
        overrides=tuple(visible(one, 200) for one in listed(summary.get("overrides"))),
        made_with=tuple(mapping(one) for one in listed(summary.get("made_with"))),
    )


def _won(record: Record) -> Estimate | None:
    found = record.hindsight.rounds[-1].won if record.hindsight and record.hindsight.rounds else None
    return found if found is not None and found.value is not None else None


def _fixed(record: Record) -> bool:
    """No round has fitted, and yet a reward had something to say."""
    return not _has_fitted(record) and any(value is not None for value in record.series("evaluate/learned"))


def _has_fitted(record: Record) -> bool:
    return any(value is not None for value in record.series("fit/loss"))


def _drifted(record: Record) -> Drifted | None:
    if record.hindsight is None and not _fixed(record):
        return None  # each round's reward has a scale of its own
    scored = zip(record.by_newest, record.series("evaluate/kl"), record.numbers, strict=True)
    known = [(score, kl, number) for score, kl, number in scored if score is not None and kl is not None]
    if len(known) < 2:
        return None
    (best, before, since), (score, now, _) = max(known[:-1], key=lambda one: (one[0], -one[1])), known[-1]
    farther = now > max(before + FARTHER, MUCH_FARTHER * before)
    return Drifted(since, before, now) if farther and score <= best else None


def _seconds(record: Record) -> dict[str, float]:
    of = mapping(record.summary.get("seconds"))
    found = {}
    for stage in STAGES:
        spent = sum(value or 0.0 for value in record.series(f"seconds/{stage}"))
        found[stage] = max(number(of.get(stage)) or spent, 0.0)
    return {stage: value for stage, value in found.items() if value}


def calibration(record: Record) -> dict[str, float | None]:
    """Brier score and calibration error as the fit of the held-out comparisons logged them."""
    lines = [line for line in record.rounds if record.fitted_round in (None, whole(line["round"]))]
    newest = lines[-1] if lines else {}
    return {
        "Brier score": number(newest.get("fit/brier_held_out")),
        "calibration error": number(newest.get("fit/calibration_error_held_out")),
    }
