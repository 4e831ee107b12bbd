"""A folder that `datasets.load_dataset` reads: pairs for training, every judgement beside them, and a card."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import sqlalchemy as sql
import yaml

from prefrl.exchange.dataset_folders import JUDGEMENTS, OURS
from prefrl.exchange.exports.given import (
    LABELER,
    ORDER,
    STRENGTH,
    TIME,
    WEIGHT,
    WHOLE,
    Exported,
    Tally,
    each_answer,
    json_text,
    knows_strengths,
)
from prefrl.exchange.exports.rows import each_judgement, each_pair, margin
from prefrl.judgements import Comparison
from prefrl.storage.events import answer_kind
from prefrl.storage.files import whole_folder, write_file
from prefrl.storage.log import StoreError
from prefrl.storage.projection import chunks
from prefrl.storage.tables import event
from prefrl.store import Store
from prefrl.types import Fields, Json

PAIRS = "preferences"
FILE = "train-00000-of-00001.parquet"
ROWS = 1000
"""Rows in one group of a Parquet file."""
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""The Hub's size categories."""


def export_dataset(store: Store, path: Path) -> Exported:
    """Write a folder with two configurations in Parquet and a README.md that is the card of a data set.

    `preferences`, the default, has `prompt`, `chosen`, `rejected` of every decided pair, and `margin` where strengths
    are known; `judgements` has every answer as it was given. Raises `StoreError` for control segments.
    """
    margins = knows_strengths(store)
    with whole_folder(path) as work:
        pairs = _write(work / PAIRS / FILE, _pairs(store, margins), _pair_columns(margins))
        tally = Tally({LABELER, ORDER, TIME, STRENGTH, WEIGHT, WHOLE})
        written = _write(work / JUDGEMENTS / FILE, each_judgement(store, tally), _judgement_columns())
        write_file(work / "README.md", _card(store, pairs, written, margins).encode())
        write_file(work / OURS, f"{json_text({'format': 'prefrl data set', 'version': 1})}\n".encode())
    note = "the card says `license: other`: say yours in README.md before you publish it"
    return tally.done(store, written, f"{pairs} pairs for training and {written} judgements", note)


def _pairs(store: Store, margins: bool) -> Iterator[Json]:
    for pair in each_pair(store, Tally(), "dataset"):
        if pair.preference > 0.5:
            row = {"prompt": pair.chosen.prompt, "chosen": pair.chosen.text, "rejected": pair.rejected.text}
            yield row | ({"margin": margin(pair.preference)} if margins else {})


def _pair_columns(margins: bool) -> Any:
    import pyarrow as pa

    names = ("prompt", "chosen", "rejected")
    return pa.schema([*((name, pa.string()) for name in names), *([("margin", pa.float64())] if margins else [])])


def _judgement_columns() -> Any:
    import pyarrow as pa

    text, whole, wholes = pa.string(), pa.int64(), pa.list_(pa.int64())
    first = [("query", text), ("prompt", text), ("responses", pa.list_(text)), ("preference", pa.float64())]
    verdicts = [("ranks", wholes), ("best", whole), ("ratings", wholes), ("scale", whole), ("skip", text)]
    return pa.schema([*first, *verdicts, ("labeler", text), ("weight", pa.float64()), ("shown", wholes), ("at", text)])


def _write(path: Path, rows: Iterable[Fields], columns: Any) -> int:
    path.parent.mkdir(parents=True)
    return write_table(path, rows, columns)


def write_table(to: Path | IO[bytes], rows: Iterable[Fields], columns: Any) -> int:
    """Write rows as Parquet, some at a time; returns how many."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    count = 0
    try:
        with pq.ParquetWriter(to, columns) as table:
            for some in chunks(rows, ROWS):
                table.write_table(pa.Table.from_pylist(some, schema=columns))
                count += len(some)
    except UnicodeEncodeError as error:
        raise StoreError(f"a text that is no valid Unicode does not fit Parquet ({error.reason}): use bundle") from None
    return count


# --- the card -----------------------------------------------------------------------------------------------------


def _card(store: Store, pairs: int, judgements: int, margins: bool) -> str:
    size = next((name for limit, name in SIZES if judgements < limit), "n>1M")
    files = [
        {"config_name": name, "data_files": [{"split": "train", "path": f"{name}/{FILE}"}]}
        | ({"default": True} if name == PAIRS else {})
        for name in (PAIRS, JUDGEMENTS)
    ]
    settings = {
        "pretty_name": "Preferences between responses",
        "license": "other",
        "task_categories": ["text-generation"],
        "tags": ["preference", "reward-modeling", "trl"],
        "size_categories": [size],
        "configs": files,
    }
    kinds, labelers, agreement = _figures(store)
    counted = "".join(f"| {name} | {count} |\n" for name, count in sorted(kinds.items()))
    return (
        f"---\n{yaml.safe_dump(settings, sort_keys=False)}---\n\n# Preferences between responses\n\n"
        f"- `{PAIRS}` ({pairs} rows): `prompt`, `chosen`, `rejected`{', `margin`' if margins else ''}; every decided "
        "pair that the judgements imply.\n"
        f"- `{JUDGEMENTS}` ({judgements} rows): every answer as it was given; `responses` are in no particular order, "
        "`shown` says in which order they stood before the annotator, and one of `preference`, `ranks`, `best`, "
        "`ratings` or `skip` is the answer.\n\n"
        f"## How it was annotated\n\n{_protocol(store)}\n"
        f"| answers | number |\n|---|---|\n{counted}| annotators | {labelers} |\n\n{agreement}\n"
    )


def _protocol(store: Store) -> str:
    """The guideline that the annotators had last, set off so that nothing in it is markup."""
    newest = sql.select(event.c.body).where(event.c.kind == "guideline").order_by(event.c.seq.desc()).limit(1)
    with store.log.reading() as connection:
        body = connection.scalar(newest)
    if body is None:
        return "No guideline is on record.\n"
    lines = "".join(f"    {line}\n" for line in str(body["text"]).splitlines())
    return f"The newest guideline that annotators were given:\n\n{lines}"


def _figures(store: Store) -> tuple[dict[str, int], int, str]:
    """Answers by kind, how many annotators there are, and how often two of them agree."""
    kinds: dict[str, int] = {}
    labelers: set[str] = set()
    sides: dict[str, list[int]] = {}  # query -> 1, 0 or -1 for each comparison: first, tie or second
    for given in each_answer(store):
        name = given.answer.reason or answer_kind(given.answer)
        kinds[name] = kinds.get(name, 0) + 1
        labelers.add(given.answer.labeler.partition("#")[0])
        if isinstance(given.answer, Comparison):
            preference = given.answer.preference
            sides.setdefault(given.query.id, []).append((preference > 0.5) - (preference < 0.5))
    return kinds, len(labelers), _agreement(sides.values())


def _agreement(sides: Iterable[list[int]]) -> str:
    """How often two answers to one comparison say the same: first, second or tie. Chance is not taken off."""
    same = total = 0
    for some in sides:
        total += len(some) * (len(some) - 1) // 2
        same += sum((n := some.count(side)) * (n - 1) // 2 for side in (-1, 0, 1))
    if not total:
        return "No comparison was judged twice, so agreement is unknown."
    return f"Two answers to the same comparison agree in {same / total:.1%} of {total} pairs of answers."
