"""What each refit changed, on the same candidates in every round."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.evaluate.card import Drift
from prefrl.judgements import Judged
from prefrl.stats.estimates import Estimate, undefined
from prefrl.stats.intervals import correlate
from prefrl.types import C

PROBES = 64
"""How many of the first judged candidates are scored after each fit."""


def read_probes(folder: Path) -> list[dict[str, Any]]:
    """The rows of `probes.jsonl`, one a fitted round; the first one names the candidates."""
    path = folder / "probes.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def first_judged(judged: Sequence[Judged[C]]) -> list[str]:
    """The ids of the first candidates that were judged, at most `PROBES`: they stay the same as judgements come in."""
    return list(dict.fromkeys(c.id for one in judged for c in one.query.candidates))[:PROBES]


def drift(rows: Sequence[dict[str, Any]]) -> list[Drift]:
    """From each row `{"round": ..., "scores": [...]}` to the next."""
    return [_step(a["scores"], b["scores"], b["round"]) for a, b in pairwise(rows)]


def _step(before: Sequence[float], after: Sequence[float], round: int) -> Drift:
    x, y = np.array(before, np.float64), np.array(after, np.float64)
    rank, spread = correlate("spearman", x, y), float(x.std())
    return Drift(
        round=round,
        spearman=undefined("all scores are equal") if rank is None else Estimate(value=rank, count=len(x)),
        shift=Estimate(value=float((y - x).mean()) / spread, count=len(x))
        if spread
        else undefined("all scores of the round before are equal"),
    )
