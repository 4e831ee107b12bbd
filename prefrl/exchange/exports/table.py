"""A table for spreadsheets: one pair a row, its cells guarded so that none is taken for a formula."""

from __future__ import annotations

import csv
from io import TextIOWrapper
from pathlib import Path
from typing import IO, Any

from prefrl.exchange.exports.given import LABELER, STRENGTH, TIME, WEIGHT, Exported, Tally, whole_file
from prefrl.exchange.exports.rows import Pair, each_pair
from prefrl.exchange.guard import GUARDED, guarded
from prefrl.storage.log import StoreError
from prefrl.store import Store

TEXTS = ("prompt", "chosen", "rejected", "labeler")
COLUMNS = ("prompt", "chosen", "rejected", "preference", "labeler", "weight", "at", "query", GUARDED)


def export_csv(store: Store[Any], path: Path) -> Exported:
    """Write every pair that the judgements imply, ties included: a tie has the preference 0.5.

    A cell that a spreadsheet would take for a formula gets an apostrophe before it, as does an empty text; the column
    `guarded` names these cells, and an import takes the apostrophes away again.
    """
    tally = Tally({LABELER, STRENGTH, TIME, WEIGHT})
    try:
        with whole_file(path) as file:
            written, changed = _write(store, tally, file)
    except UnicodeEncodeError as error:
        raise StoreError(f"a text that is no valid Unicode does not fit a table ({error.reason}): use bundle") from None
    note = f"{changed} x row with an apostrophe before a cell, so that no spreadsheet takes it for a formula"
    return tally.done(store, written, *([note] if changed else []))


def _write(store: Store[Any], tally: Tally, file: IO[bytes]) -> tuple[int, int]:
    """How many rows were written, and in how many a cell was guarded."""
    text, written, changed = TextIOWrapper(file, "utf-8", newline="", write_through=True), 0, 0
    try:
        table = csv.DictWriter(text, COLUMNS, quoting=csv.QUOTE_ALL, lineterminator="\n")
        table.writeheader()
        for pair in each_pair(store, tally, "csv"):
            row = guarded(_row(pair), TEXTS)
            table.writerow(row)
            written, changed = written + 1, changed + bool(row[GUARDED])
    finally:
        text.detach()
    return written, changed


def _row(pair: Pair) -> dict[str, str]:
    answer, query = pair.given.answer, pair.given.query
    assert answer.reason is None
    return {
        "prompt": pair.chosen.prompt,
        "chosen": pair.chosen.text,
        "rejected": pair.rejected.text,
        "preference": repr(pair.preference),
        "labeler": answer.labeler,
        "weight": repr(answer.weight),
        "at": pair.given.at,
        "query": query.id,
    }
