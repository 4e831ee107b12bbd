"""What a person sees in the terminal: progress while a run goes on, a line for each round, tables."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import Task as Row
from rich.table import Table
from rich.text import Text

from prefrl.components import ConfigError, resume_command
from prefrl.evaluate.card import ReportCard
from prefrl.kinds import named
from prefrl.loop import Loop
from prefrl.protocols import NeedsShowing
from prefrl.report import card_words
from prefrl.types import Fields, Round

if TYPE_CHECKING:
    from prefrl.duel import Duel
    from prefrl.evaluate.win_rate import WinRate
    from prefrl.rundir import Run

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)


class _Stage(ProgressColumn):
    """What goes on now, and how fast; read off the loop, which knows nothing of it."""

    def __init__(self, loop: Loop) -> None:
        super().__init__()
        self.loop = loop
        self.unit = f"{named(loop.task.kind).step}s"

    def render(self, task: Row) -> Text:
        spent = sum(self.loop.learner.steps)
        rate = (spent - task.fields["spent"]) / task.elapsed if task.elapsed else 0.0
        return Text(f"{self.loop.stage:<9} {spent:>10,} {self.unit} {rate:>8,.0f}/s", style="cyan")


@contextmanager
def progress(loop: Loop, quiet: bool) -> Iterator[Progress]:
    """A bar over the rounds on a terminal; nothing elsewhere, or while a person is asked questions."""
    columns = (SpinnerColumn(), TextColumn("round {task.completed:.0f}/{task.total:.0f}"), BarColumn(24), _Stage(loop))
    bar = Progress(
        *columns,
        TimeElapsedColumn(),
        _TimeLeft(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )
    with bar:
        total = loop.settings.rounds
        begun = max(loop.round, 0)
        bar.add_task("run", total=total, completed=begun, begun=begun, spent=sum(loop.learner.steps))
        yield bar


T = TypeVar("T")


def counted(items: Iterable[T], total: int, noun: str) -> Iterator[T]:
    """The same, with a bar on a terminal, and elsewhere a line at the end, both with a rate."""
    begun = time.perf_counter()
    columns = (TextColumn(f"{{task.completed}}/{{task.total}} {noun}"), BarColumn(24), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        row, done = bar.add_task(noun, total=total), 0
        for done, item in enumerate(items, 1):
            bar.update(row, completed=done)
            yield item
    seconds = time.perf_counter() - begun
    say(f"{done} {noun} in {duration(seconds)}, {done / max(seconds, 1e-9):.2g} a second")


class _TimeLeft(ProgressColumn):
    """Time left by the pace of the rounds so far."""

    def render(self, task: Row) -> Text:
        done = task.completed - task.fields["begun"]
        if not done or not task.total or task.elapsed is None:
            return Text("")
        left = task.elapsed / done * (task.total - task.completed)
        return Text(f"about {duration(left)} left", style="dim")


def drive(running: Run) -> None:
    """Run to the end, telling how it goes; on Ctrl-C say how to go on."""
    with running:
        for note in running.notes:
            say(note, "yellow")
        try:
            with progress(running.loop, running.config.labeler.asks_people()) as bar, interrupts() as check:
                for round in running:
                    bar.update(bar.task_ids[0], completed=round.number)
                    console.print(round_line(round), soft_wrap=True)
                    for note in round.notes:
                        say(f"  {note}", "yellow")
                    check()
        except KeyboardInterrupt:
            say(f"stopped; nothing that was labelled is lost. Go on with: {resume_command(running.folder)}")
            raise
        console.print(summary_table(running.summary))
        say(f"report: {running.report()}")
        if not (running.loop.reward.fitted or running.loop.imitates):
            raise ValueError(_nothing_learned(running))


def _nothing_learned(running: Run) -> str:
    learner, counts = running.loop.learner, running.loop.store.counts()
    shown = counts.get("demonstrations", 0)
    if isinstance(learner, NeedsShowing):
        try:
            learner.check_shown(bool(shown), judged=counts["answered"] > shown)
        except ConfigError as error:
            return f"nothing was learned: {error}"
    if shown:
        return (
            f"nothing was learned: there are {shown} demonstrations and no judgements, and this learner learns from "
            "judgements; set learner.kind=clone, or sft for text"
        )
    if not counts["answered"]:
        return (
            "nothing was learned: there is not a single answer in this run; ask for some with loop.labels, or begin "
            "with a folder of judgements that `prefrl import` wrote"
        )
    return "nothing was learned: no judgement ever preferred a candidate; look at the labeler's settings"


@contextmanager
def interrupts() -> Iterator[Callable[[], None]]:
    """Gives a function that raises KeyboardInterrupt if Ctrl-C was pressed and came to nothing.

    Python drops what is raised in a destructor or in a callback of a library, Ctrl-C too; it is then heard at the end
    of a round. Only the main thread hears of signals; elsewhere nothing changes, nor where Ctrl-C is ignored, as it is
    in what a shell script starts in the background.
    """
    pressed = False

    def heard(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield check
        return
    signal.signal(signal.SIGINT, heard)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before or signal.default_int_handler)


def say(text: str, style: str = "") -> None:
    """One line as it is: names of files are no markup, and are not broken over lines."""
    console.print(Text(text, style=style), soft_wrap=True)


def round_line(round: Round) -> Text:
    """One round in one line: what matters most first."""
    m = round.metrics
    gold = m.get("evaluate/gold", math.nan)
    parts = [
        Text(f"round {round.number:>3}", style="bold"),
        *([] if math.isnan(gold) else [Text(f"gold {gold:>9.3g}", style="blue")]),
        Text(f"learned {m['evaluate/learned']:>8.3g}" if "evaluate/learned" in m else " " * 16, style="yellow"),
    ]
    for key, label, form in (
        ("fit/accuracy_held_out", "accuracy", ".2f"),
        ("evaluate/kl", "kl", ".2f"),
        ("evaluate/fluency", "fluency", ".2f"),
        ("evaluate/spread", "spread", ".2f"),
        ("label/answered", "labels", ".0f"),
        ("steps/learn", "steps", ",.0f"),
    ):
        if not math.isnan(m.get(key, math.nan)):
            count = f" of {m['fit/held_out']:.0f}" if label == "accuracy" and "fit/held_out" in m else ""
            parts.append(Text(f"{label} {m[key]:z{form}}{count}"))
    seconds = sum(v for k, v in m.items() if k.startswith("seconds/"))
    return Text("  ").join([*parts, Text(duration(seconds), style="dim")])


def summary_table(summary: Fields) -> Table:
    """`summary.json` for people."""
    title = Text(f"{summary['task']} ({summary['kind']}), seed {summary['seed']}")
    table = Table(title=title, show_header=False, box=None)
    table.add_row("gold", Text(_gold(summary), style="bold blue"))
    accuracy = summary["reward_accuracy"]
    table.add_row("reward accuracy, held out", "not measured" if accuracy is None else number(accuracy))
    if summary["kl"] is not None:
        table.add_row("kl to the start, nats", number(summary["kl"]))
    if summary["fluency_after"] is not None:
        table.add_row("fluency", f"{number(summary['fluency_before'])} → {number(summary['fluency_after'])}")
    for name in ("labels", "steps"):
        table.add_row(name, ", ".join(f"{k} {v:,}" for k, v in summary[name].items()))
    table.add_row("time", ", ".join(f"{k} {duration(v)}" for k, v in summary["seconds"].items()))
    return table


def _gold(summary: Fields) -> str:
    """Before and after; or that the task has none, and what stands in its place."""
    before, after, best = (summary[f"gold_{when}"] for when in ("before", "after", "best"))
    if after is None:
        return "the task has none: the report says how else it did"
    return f"{number(before)} → {number(after)} (best {number(best)})"


def metrics_table(title: str, metrics: Mapping[str, float]) -> Table:
    """Names and numbers."""
    return table(title, ("metric", "value"), [(name, number(value)) for name, value in metrics.items()])


def win_rate_line(duel: Duel, found: WinRate) -> str:
    """Who won how often, and how sure that is, in a sentence."""
    rate, other = found.rate, f"that of {duel.against}" if duel.against else "its start"
    if rate.value is None:
        return f"the policy of {duel.folder} against {other}, by {duel.who}: no pair was judged"
    between = f" [{rate.low:.1%}, {rate.high:.1%}]".replace("%", "") if None not in (rate.low, rate.high) else ""
    many = f"{found.prompts} prompts" if duel.samples == 1 else f"{found.pairs} pairs, to {found.prompts} prompts,"
    return (
        f"the policy of {duel.folder} wins {100 * rate.value:.1f} %{between} of {many} against {other}, by {duel.who}"
    )


def win_rate_table(found: WinRate) -> Table:
    """What a win rate rests on."""
    rows: dict[str, float | None] = {"wins": found.wins, "ties": found.ties, "losses": found.losses}
    rows |= {"unjudged": found.unjudged, "prompts": found.prompts, "tokens": found.tokens}
    rows |= {"the other's tokens": found.other_tokens, "share won by the longer one": found.longer_won.value}
    if found.order is not None:
        rows |= {"position bias": found.order.position_bias, "share whose winner flipped": found.order.flipped}
    return table("pairs of responses", ("what", "value"), [(name, number(value)) for name, value in rows.items()])


def card_table(card: ReportCard) -> Table:
    """A reward model's report card: what it comes to, and every number."""
    made = table(card_words.headline(card), ("", "value", "95 % interval, or why not"), ())
    made.caption, made.caption_justify = Text(card_words.subject(card.about)), "left"
    for name, rows in card_words.groups(card):
        made.add_section()
        made.add_row(Text(name, style="bold"))
        for row in rows:
            made.add_row(*(Text(cell) for cell in astuple(row)))
    return made


def table(title: str, columns: Iterable[str], rows: Iterable[tuple[str, ...]]) -> Table:
    """A plain table; cells are text, never markup."""
    made = Table(title=Text(title), title_justify="left")
    for number_, column in enumerate(columns):
        made.add_column(column, overflow="fold", no_wrap=number_ == 0)
    for row in rows:
        made.add_row(*(Text(cell) for cell in row))
    return made


def number(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"


def duration(seconds: float) -> str:
    """4.2 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
