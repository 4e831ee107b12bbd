"""Logs made by hand, to count answers in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from prefrl.page import tallies
from prefrl.page.api import AgreementRow
from prefrl.page.ledger import Ledger
from prefrl.stats.estimates import Estimate
from prefrl.storage.log import row

NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)


class Made:
    """A log made by hand: pairs of clips of 50 steps, and what people said of them."""

    def __init__(self) -> None:
        self.events: list[dict[str, Any]] = []
        self.asked = 0

    def add(self, kind: str, subject: str = "", actor: str = "", body: Any = None, id: str = "") -> None:
        number = len(self.events) + 1
        at = (NOW - timedelta(hours=1) + timedelta(seconds=number)).isoformat(timespec="milliseconds")
        self.events.append(row(id or f"event-{number}", kind, subject, actor, body or {}) | {"seq": number, "at": at})

    def ask(self, count: int = 1, size: int = 2, **more: Any) -> list[str]:
        queries = [f"q{self.asked + i}" for i in range(count)]
        self.asked += count
        for query in queries:
            for i in range(size):
                self.add("candidate", id=f"{query}-{i}", body={"type": "segment", "steps": 50})
            self.add("query", id=query, body={"candidates": [f"{query}-{i}" for i in range(size)]} | more)
        return queries

    def compare(
        self, query: str, actor: str, preference: float, shown: Sequence[int] = (0, 1), seconds: float = 8.0
    ) -> None:
        about = {"timings": {"decision_ms": 1000 * seconds}}
        self.add("comparison", query, actor, {"preference": preference, "shown": list(shown), "about": about})

    def repeat(self, query: str, actor: str, preference: float, shown: Sequence[int] = (1, 0)) -> None:
        answer = {"kind": "comparison", "preference": preference, "shown": list(shown)}
        self.add("repeat", query, actor, {"answer": answer, "about": {}})

    def ledger(self) -> Ledger:
        found = Ledger(fps=10.0)
        for event in self.events:
            found.read(event)
        return found

    def person(self, name: str) -> tallies.Person:
        ledger = self.ledger()
        rows, stands = ledger.rows, tallies.stands(ledger)
        alive = stands.copy()
        alive[[r for r, _, _ in ledger.repeats]] = True
        own = rows["person"] == ledger.people.get(name, -1)
        return tallies.person({k: v[own] for k, v in rows.items()}, stands[own], alive[own])

    def agreement(self, rng: np.random.Generator) -> tuple[AgreementRow, dict[int, Estimate]]:
        ledger = self.ledger()
        return tallies.agreement(ledger.rows, ledger.pairs, tallies.stands(ledger), rng)


def sweep(made: Made, name: str, decide: Callable[[int], float], seconds: float = 8.0, flip: bool = True) -> None:
    """Somebody answers every query; sides are shown at random, and `decide` gives P(left is better)."""
    order = np.random.default_rng(len(name))
    for i in range(made.asked):
        shown = (1, 0) if flip and order.random() < 0.5 else (0, 1)
        left = decide(i)
        made.compare(f"q{i}", name, left if shown == (0, 1) else 1 - left, shown, seconds)
