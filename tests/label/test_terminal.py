import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from prefrl import Config
from prefrl.judgements import Comparison, Ranking, Skip
from prefrl.label.terminal import Stopped, Terminal, TerminalSettings, interpret, understood
from prefrl.page.clips.encode import side_by_side, write_clip
from prefrl.store import Store
from prefrl.types import Query, Response, Segment


class Task:
    name, kind, fps = "fake", "text", 10.0

    def frames(self, segment: Segment) -> np.ndarray:
        return np.zeros((len(segment), 33, 21, 3), np.uint8)


def person(*typed: str, clips: Path = Path("clips")) -> tuple[Terminal, io.StringIO]:
    """Somebody who types these lines, and what they see."""
    seen = io.StringIO()
    console = Console(file=seen, width=100)
    lines: Iterator[str] = iter(typed)

    def read(prompt: str) -> str:
        try:
            return next(lines)
        except StopIteration:
            raise EOFError from None

    console.input = read  # type: ignore[assignment,method-assign]
    task: Any = Task()
    return Terminal(TerminalSettings(name="ann", clips=clips), task, console), seen


def queries(*names: str, count: int = 1) -> list[Query[Response]]:
    return [Query(tuple(Response(f"prompt {i}", f"{n} {i}") for n in names)) for i in range(count)]


@pytest.mark.parametrize(
    ("typed", "preference"), [("1", 1.0), ("2", 0.0), ("t", 0.5), ("1>2", 1.0), ("2>1", 0.0), ("1=2", 0.5)]
)
def test_a_choice_is_kept_in_the_order_of_the_query_and_not_of_the_screen(typed: str, preference: float) -> None:
    assert interpret(typed, "q", [0, 1], "ann") == Comparison("q", preference, "ann", (0, 1))
    assert interpret(typed, "q", [1, 0], "ann") == Comparison("q", 1 - preference, "ann", (1, 0))


def test_a_ranking_with_a_tie_is_kept_in_the_order_of_the_query() -> None:
    assert interpret("3>1=2", "q", [2, 0, 1], "ann") == Ranking("q", (1, 0, 1), "ann", (2, 0, 1))
    assert interpret("t", "q", [2, 0, 1], "ann") == Ranking("q", (0, 0, 0), "ann", (2, 0, 1))


@pytest.mark.parametrize("typed", ["", "3", "12", "1>1", "1>2>3", "yes", ">", "1>2=", "1 2"])
def test_what_makes_no_sense_is_asked_again(typed: str, text_store: Store[Response]) -> None:
    assert not understood(typed, 2)
    text_store.ask(queries("a", "b"))
    terminal, seen = person(typed, "1")
    terminal.answer(text_store, np.random.default_rng(0))
    assert "is no answer" in seen.getvalue()
    assert text_store.counts()["answered"] == 1


def test_a_sitting_with_every_kind_of_answer(text_store: Store[Response]) -> None:
    text_store.ask(queries("a", "b", count=5))
    terminal, seen = person("1", "t", "x", "s", "2")
    terminal.answer(text_store, np.random.default_rng(0))
    kinds = [a.reason if isinstance(a, Skip) else a.preference for a in text_store.answers()]  # type: ignore[union-attr]
    assert kinds[1:4] == [0.5, "incomparable", "skip"]
    assert text_store.counts() == {"asked": 5, "answered": 3, "skipped": 2}
    assert all(f"{name} {i}" in seen.getvalue() for name in "ab" for i in range(5))


def test_at_a_terminal_one_key_is_an_answer(text_store: Store[Response], monkeypatch: pytest.MonkeyPatch) -> None:
    keys = iter("1z2q")
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("click.getchar", lambda: next(keys))
    labeler, seen = person()
    text_store.ask(queries("a", "b", count=3))
    with pytest.raises(Stopped):
        labeler.answer(text_store, np.random.default_rng(0))
    assert text_store.counts()["answered"] == 2
    assert "'z' is no answer" in seen.getvalue()


def test_the_goal_of_a_run_is_asked_by_whoever_asks_nothing_else() -> None:
    def asked(*changes: str) -> str:
        config = Config.load("text/toy", ["goal=Is it kind?", *changes])
        settings: Any = config.labeler.asking(config.goal)
        return str(settings.criterion if changes[0].endswith("judge") else settings.question)

    for kind in ("terminal", "web", "judge"):
        own = "labeler.criterion=Own?" if kind == "judge" else "labeler.question=Own?"
        assert asked(f"labeler.kind={kind}") == "Is it kind?"
        assert asked(f"labeler.kind={kind}", own) == "Own?"
    labeler, seen = person("q")
    labeler.settings = labeler.settings.asking("Is it kind?")
    labeler._show(queries("a", "b")[0], [0, 1])
    assert "Is it kind?" in seen.getvalue()


def test_undo_takes_the_last_answer_back_and_asks_again(text_store: Store[Response]) -> None:
    text_store.ask(queries("a", "b", count=2))
    terminal, _ = person("u", "1", "u", "2", "1")
    terminal.answer(text_store, np.random.default_rng(0))
    first = next(a for a in text_store.answers() if a.query == queries("a", "b", count=2)[0].id)
    assert isinstance(first, Comparison)
    assert first.preference == (0.0 if first.shown == (0, 1) else 1.0)
    assert text_store.counts()["answered"] == 2


@pytest.mark.parametrize("end", [("q",), ()])
def test_quitting_keeps_what_was_answered_and_a_second_sitting_goes_on(
    end: tuple[str, ...], text_store: Store[Response]
) -> None:
    text_store.ask(queries("a", "b", count=3))
    with pytest.raises(Stopped):
        person("1", *end)[0].answer(text_store, np.random.default_rng(0))
    assert text_store.counts()["answered"] == 1
    person("1", "1")[0].answer(text_store, np.random.default_rng(0))
    assert text_store.counts()["answered"] == 3


def test_hostile_text_is_shown_and_not_interpreted(text_store: Store[Response]) -> None:
    text_store.ask([Query((Response("[red]p", "[bold]x[/bold]"), Response("[red]p", "\x1b[31mred")))])
    terminal, seen = person("1")
    terminal.answer(text_store, np.random.default_rng(0))
    assert "[bold]x[/bold]" in seen.getvalue()
    assert "[red]p" in seen.getvalue()
    assert "\x1b" not in seen.getvalue()


def test_clips_are_written_side_by_side_and_named(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    store.ask([query := make_query()])
    terminal, seen = person("1", clips=tmp_path / "clips")
    terminal.answer(store, np.random.default_rng(0))
    (clip,) = (tmp_path / "clips").iterdir()
    assert clip.stem == query.id[:12]
    assert clip.name in seen.getvalue().replace("\n", "")


def test_clips_of_odd_sizes_and_lengths_are_padded() -> None:
    made = side_by_side([np.zeros((3, 33, 21, 3), np.uint8), np.full((5, 33, 21, 3), 9, np.uint8)])
    assert made.shape == (5, 34, 50, 3)
    assert (made[4, :33, :21] == 0).all()
    assert (made[4, :33, 29:50] == 9).all()


def test_an_mp4_can_be_read_back(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = write_clip(tmp_path / "clip", [np.full((6, 31, 31, 3), v, np.uint8) for v in (0, 255)], 10)
    assert path.suffix == ".mp4"
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 6
    assert frames[0][:31, :20].mean() < 20
    assert frames[0][:31, 50:].mean() > 235
