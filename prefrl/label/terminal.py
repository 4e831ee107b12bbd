"""A person at the terminal: texts side by side, control clips as one named file a query."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Self, cast

import click
import numpy as np
from rich.columns import Columns
from rich.console import Console, Group
from rich.panel import Panel
from rich.text import Text

from prefrl.components import Settings
from prefrl.judgements import Answer, Comparison, Ranking, Skip
from prefrl.kinds import kind_of
from prefrl.page.clips.encode import write_clip
from prefrl.protocols import DrawnTask, Store, Task
from prefrl.seeding import draw_seed, keyed
from prefrl.types import C, Query


class Stopped(KeyboardInterrupt):
    """A person is done for now. What was answered is in the store."""


class TerminalSettings(Settings):
    """Ask a person at the terminal."""

    kind: Literal["terminal"] = "terminal"
    name: str = "me"
    """Who answers; kept with every answer."""
    clips: Path = Path("clips")
    """Where the clips of control queries are written."""
    question: str = ""
    """What is asked, in one sentence; the goal of the run where it is left out."""

    def asks_people(self) -> bool:
        return True

    def asking(self, goal: str) -> Self:
        return self if self.question else self.model_copy(update={"question": goal})

    def build(self, task: Task) -> Terminal:
        return Terminal(self, task)


@dataclass
class Terminal:
    """Puts open queries to a person, one at a time, until none is left or the person quits."""

    settings: TerminalSettings
    task: Task
    console: Console = field(default_factory=Console)

    @property
    def name(self) -> str:
        return self.settings.name

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        """Every answer is in the store before the next question. Raises `Stopped` when the person quits."""
        base, done = draw_seed(rng), list[str]()
        while queries := store.open_queries(self.name):
            self.console.rule(f"{len(done)} answered, {len(queries)} to go")
            query = queries[0]
            # By the query's id: asked again after an undo, it looks the same.
            shown = keyed(base, query.id).permutation(len(query.candidates)).tolist()
            self._show(query, shown)
            typed = self._ask(len(shown))
            if typed == "q":
                raise Stopped
            if typed == "u":
                self._undo(store, done)
                continue
            store.answer([interpret(typed, query.id, shown, self.name)])
            done.append(query.id)

    def _show(self, query: Query[C], shown: list[int]) -> None:
        """The candidates, numbered as they are shown."""
        candidates = [query.candidates[i] for i in shown]
        kind = kind_of(candidates[0])
        self.console.print(Text(visible(self.settings.question or kind.question), style="bold cyan"))
        if kind.shows == "clip":
            task = cast(DrawnTask[C], self.task)
            clips = [task.frames(c) for c in candidates]
            path = write_clip(self.settings.clips / query.id[:12], clips, task.fps)
            order = ", ".join(str(n + 1) for n in range(len(shown)))
            self.console.print(Text(f"watch {path} (from left to right: {order})"))
            return
        texts = [kind.shown(kind.describe(c)) for c in candidates]
        width = max(24, self.console.width // len(texts) - 2)
        panels = [Panel(Text(visible(t.text or "")), title=str(n + 1), width=width) for n, t in enumerate(texts)]
        self.console.print(Group(Text(visible(texts[0].prompt or ""), style="bold"), Columns(panels, padding=(0, 1))))

    def _ask(self, count: int) -> str:
        """A line that can be interpreted; the rules are shown again after one that cannot."""
        ranking = "1 or 2: the better one" if count == 2 else f"a ranking of 1 to {count}, best first, as 2>1=3"
        rules = f"{ranking} · t: tie · x: cannot be compared · s: skip · u: undo · q: quit"
        while True:
            self.console.print(Text(rules, style="dim"))
            try:
                typed = self._typed(count).strip().lower()
            except EOFError:
                return "q"
            if understood(typed, count):
                return typed
            self.console.print(Text(f"{typed!r} is no answer; type one of these:", style="red"))

    def _typed(self, count: int) -> str:
        """One key where that says it all and somebody sits at a terminal; else a line."""
        if count > 2 or not sys.stdin.isatty():
            return self.console.input("> ")
        self.console.print("> ", end="")
        key = click.getchar()
        self.console.print(Text(visible(key)))
        return key

    def _undo(self, store: Store[C], done: list[str]) -> None:
        if not done:
            self.console.print(Text("nothing to undo in this sitting", style="red"))
            return
        store.retract(done.pop(), self.name)


def visible(text: str) -> str:
    """Text from models is untrusted: what would steer the terminal, or reverse the reading order, shows as a mark."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)


def understood(typed: str, count: int) -> bool:
    """Is this a command, a choice of two, or a ranking that names each of `count` candidates once?"""
    if typed in set("txsuq"):
        return True
    if count == 2 and typed in ("1", "2"):
        return True
    numbers = re.split("[>=]", typed)
    return sorted(numbers) == [str(n + 1) for n in range(count)]


def interpret(typed: str, query: str, shown: list[int], labeler: str) -> Answer:
    """Turn what was typed, in the order shown, into an answer in the query's own order."""
    order = tuple(shown)
    if typed in ("s", "x"):
        return Skip(query, "skip" if typed == "s" else "incomparable", labeler, order)
    ranks = [0] * len(shown)
    if typed != "t":
        typed = {"1": "1>2", "2": "2>1"}.get(typed, typed)
        for rank, tier in enumerate(typed.split(">")):
            for number in tier.split("="):
                ranks[shown[int(number) - 1]] = rank
    if len(ranks) > 2:
        return Ranking(query, tuple(ranks), labeler, order)
    return Comparison(query, 0.5 + 0.5 * float(np.sign(ranks[1] - ranks[0])), labeler, order)
