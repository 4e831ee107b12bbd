"""A run's folder as a report reads it: whatever is there, cleaned; whatever is not, named.

Texts come from language models and files may be half-written or edited, so nothing here trusts a type or a size.
"""

from __future__ import annotations

import base64
import json
import math
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
import yaml

from prefrl.evaluate.calibration import reliability
from prefrl.evaluate.card import Bin, Exact, Hindsight, ReportCard, Shift, read_part
from prefrl.stats.estimates import Part
from prefrl.types import Json

P = TypeVar("P", bound=Part)
Json: TypeAlias = Json
MAX_TEXT = 4_000
MAX_CONFIG = 50_000
MAX_PICTURE = 4_000_000
MAX_EXAMPLES = 24
BIDI = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
MAGIC = {"png": b"\x89PNG\r\n\x1a\n", "webp": b"RIFF"}
"""How files of pictures begin."""


@dataclass(frozen=True)
class Example:
    """A candidate to look at."""

    gold: float | None
    learned: float | None
    prompt: str
    text: str
    caption: str
    picture: str
    """A `data:` address of a PNG, or empty."""
    film: str = ""
    """A `data:` address of a WebP that plays, or empty."""
    still: bool = False
    """Whether it is a single picture."""


@dataclass(frozen=True)
class Record:
    """What a run's folder holds so far."""

    name: str
    """The folder's."""
    summary: Json
    rounds: tuple[Json, ...]
    """The lines of metrics.jsonl in order of `round`; of two lines for one round the later one counts."""
    config: str
    planned: int | None
    """Rounds that the settings ask for."""
    imagined: bool
    """Whether queries are about what the policy would do."""
    reliability: tuple[Bin, ...]
    """Of the held-out comparisons of the newest fit."""
    fitted_round: int | None
    """The round of that fit."""
    before: tuple[Example, ...]
    after: tuple[Example, ...]
    card: ReportCard | None
    """How good the reward model is, where that was measured."""
    hindsight: Hindsight | None
    """All rounds by the newest reward, where that was measured."""
    shift: Shift | None
    """How far the policy is from an expert, where that was measured."""
    exact: Exact | None
    """What is known exactly, in a world of few states."""
    labels: Json
    """What was asked and answered, of a folder of answers alone."""
    missing: tuple[str, ...]
    """Files that are not there yet, or cannot be read, in words."""

    def series(self, key: str) -> list[float | None]:
        """One metric over the rounds; None where a round has none."""
        return [number(line.get(key)) for line in self.rounds]

    def last(self, key: str) -> float | None:
        return next((value for value in reversed(self.series(key)) if value is not None), None)

    @property
    def numbers(self) -> list[int]:
        """Of the rounds."""
        return [whole(line["round"]) or 0 for line in self.rounds]

    @property
    def learned(self) -> list[float | None]:
        """The learned reward by round; what a model said before its first fit is noise, and left out."""
        fits = [loss is not None for loss in self.series("fit/loss")]
        first = fits.index(True) if True in fits else 0
        return [value if i >= first else None for i, value in enumerate(self.series("evaluate/learned"))]

    @property
    def by_newest(self) -> list[float | None]:
        """The same by the newest reward, where that was measured, else as each round's own said."""
        if self.hindsight is None:
            return self.learned
        by_round = {seen.round: seen.learned.value for seen in self.hindsight.rounds}
        return [by_round.get(number) for number in self.numbers]


def read(folder: Path, examples: bool = True) -> Record:
    """Read a run's folder, with or without its examples. Raises `NotADirectoryError` when there is none; every file in
    it may be missing."""
    if not folder.is_dir():
        raise NotADirectoryError(f"expected the folder of a run, got {str(folder)!r}, which is not a folder")
    missing: list[str] = []
    config = _config(folder / "config.yaml", missing)
    summary = _json(folder / "summary.json", dict, missing, "no round is over yet")
    rounds = _rounds(folder / "metrics.jsonl", missing)
    fitted = any(number(line.get("fit/loss")) is not None for line in rounds)
    why = "nothing could be held out" if fitted else "no reward model has been fitted yet"
    held_out = _json(folder / "held_out.json", dict, missing, why)
    return Record(
        name=visible(folder.resolve().name, 200),
        summary=summary,
        rounds=rounds,
        config=visible(config, MAX_CONFIG),
        planned=whole(_setting(config, "loop").get("rounds")),
        imagined=_setting(config, "select").get("imagined") is True,
        reliability=_reliability(held_out, missing),
        fitted_round=whole(held_out.get("round")),
        before=_examples(folder / "examples" / "before.json", missing) if examples else (),
        after=_examples(folder / "examples" / "after.json", missing) if examples else (),
        card=_part(ReportCard, folder / "card.json", missing),
        hindsight=_part(Hindsight, folder / "hindsight.json", missing),
        shift=_part(Shift, folder / "shift.json", missing),
        exact=_part(Exact, folder / "exact.json", missing),
        labels=_json(folder / "labels.json", dict, [], ""),
        missing=tuple(missing),
    )


def number(value: object) -> float | None:
    """A finite number of a size that can be drawn, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < 1e15 and math.isfinite(value) else None


def whole(value: object) -> int | None:
    found = number(value)
    return None if found is None else int(found)


def mapping(value: object) -> Json:
    return {visible(k): v for k, v in value.items() if isinstance(k, str)} if isinstance(value, dict) else {}


def listed(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def visible(value: object, limit: int = MAX_TEXT) -> str:
    """A text in which control and direction characters are spelled out, cut (and saying so) beyond `limit`."""
    if value is None:
        return ""
    text = value if isinstance(value, str) else str(value)
    shown = "".join(_spell(c) for c in text[:limit])
    return shown if len(text) <= limit else f"{shown} … [{len(text) - limit:,} more characters]"


def _spell(character: str) -> str:
    if character in "\n\t":
        return character
    hidden = character in BIDI or unicodedata.category(character) in ("Cc", "Cs")
    return f"⟨U+{ord(character):04X}⟩" if hidden else character


def _json(path: Path, kind: type, missing: list[str], why: str) -> Any:
    """The file's value when it is of that kind, else an empty one and a word in `missing`."""
    if not path.is_file():
        missing.append(f"{path.name}: {why}")
        return kind()
    try:
        value = json.loads(path.read_bytes())
    except (ValueError, OSError, RecursionError):
        value = None
    if not isinstance(value, kind):
        missing.append(f"{path.name}: cannot be read")
        return kind()
    return value


def _rounds(path: Path, missing: list[str]) -> tuple[Json, ...]:
    lines = path.read_bytes().splitlines() if path.is_file() else []
    parsed = [_line(line) for line in lines]
    found = {at: row for row in parsed if (at := whole(row.get("round"))) is not None}
    if not found:
        missing.append(f"{path.name}: no round has been evaluated yet")
    if unread := sum(whole(row.get("round")) is None for row in parsed):
        missing.append(f"{path.name}: {unread} of its lines cannot be read")
    return tuple(found[at] for at in sorted(found))


def _line(line: bytes) -> Json:
    """One line of metrics; empty when it is half-written."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _config(path: Path, missing: list[str]) -> str:
    if not path.is_file():
        missing.append(f"{path.name}: the settings are not there")
        return ""
    return path.read_bytes().decode("utf-8", "replace")


def _setting(config: str, name: str) -> Json:
    """A part of the settings; empty where they cannot be read."""
    try:
        settings = yaml.safe_load(config)
    except (yaml.YAMLError, ValueError, RecursionError):
        return {}
    return mapping(mapping(settings).get(name))


def _reliability(held_out: Json, missing: list[str]) -> tuple[Bin, ...]:
    """Of all comparisons for which both numbers are there and lie in [0, 1]."""
    columns = [held_out.get(name) for name in ("predicted", "preference")]
    rows = [column if isinstance(column, list) else [] for column in columns]
    if held_out and len(rows[0]) != len(rows[1]):
        missing.append("held_out.json: predictions and preferences differ in number")
        return ()
    pairs = [(number(p), number(q)) for p, q in zip(*rows, strict=True)]
    good = [(p, q) for p, q in pairs if p is not None and q is not None and 0 <= p <= 1 and 0 <= q <= 1]
    if len(good) < len(pairs):
        missing.append(f"held_out.json: {len(pairs) - len(good)} comparisons without a usable number are left out")
    return reliability(*np.array(good, np.float64).T) if good else ()


def _part(cls: type[P], path: Path, missing: list[str]) -> P | None:
    """What a file holds, where there is one."""
    found = read_part(cls, path)
    if found is None and path.is_file():
        missing.append(f"{path.name}: cannot be read")
    return found


def _examples(path: Path, missing: list[str]) -> tuple[Example, ...]:
    entries = _json(path, list, missing, "no examples yet")
    if len(entries) > MAX_EXAMPLES:
        missing.append(f"{path.name}: only the first {MAX_EXAMPLES} of {len(entries)} examples are shown")
    return tuple(_example(entry, path.parent) for entry in entries[:MAX_EXAMPLES] if isinstance(entry, dict))


def _example(entry: Json, folder: Path) -> Example:
    picture, problem = _picture(entry.get("strip"), folder, "png")
    film, _ = _picture(entry.get("film"), folder, "webp")  # one that is missing is no loss: the strip says the same
    return Example(
        gold=number(entry.get("gold")),
        learned=number(entry.get("learned")),
        prompt=visible(entry.get("prompt")),
        text=visible(entry.get("text")),
        caption=problem or visible(entry.get("caption")),
        picture=picture,
        film=film,
        still=entry.get("still") is True,
    )


def _picture(name: object, folder: Path, form: str) -> tuple[str, str]:
    """(data address, what is wrong): only a picture that lies in that very folder is taken, never a path or a link."""
    if name is None:
        return "", ""
    path = next((p for p in folder.iterdir() if p.name == name and p.is_file() and not p.is_symlink()), None)
    if path is None:
        return "", "The picture is not there."
    if path.stat().st_size > MAX_PICTURE or not (data := path.read_bytes()).startswith(MAGIC[form]):
        return "", f"The picture is too large, or no {form.upper()}."
    return f"data:image/{form};base64," + base64.b64encode(data).decode("ascii"), ""
