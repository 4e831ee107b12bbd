"""Cells of a .csv that a spreadsheet would take for formulas: written with an apostrophe before them, and read without.

The column `guarded` names the columns of a row that got one, so that nobody else's apostrophe is taken away.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

STARTS = ("=", "+", "-", "@", "\t", "\r")
"""What a spreadsheet takes for the start of a formula (OWASP, CSV injection)."""
GUARD = "'"
GUARDED = "guarded"


def guarded(row: Mapping[str, str], columns: Iterable[str]) -> dict[str, str]:
    """The row with an apostrophe before what could be a formula, and before nothing at all: that is no missing cell."""
    risky = [name for name in columns if not row[name] or row[name].lstrip(" \n").startswith(STARTS)]
    return {name: GUARD + cell if name in risky else cell for name, cell in row.items()} | {GUARDED: " ".join(risky)}


def unguarded(row: Mapping[str, Any]) -> dict[str, Any]:
    """The row as it was before `guarded`; other rows as they are. Raises `ValueError` where an apostrophe is gone."""
    named = (row.get(GUARDED) or "").split()
    for name in named:
        if not (row.get(name) or "").startswith(GUARD):
            raise ValueError(f"column {GUARDED!r} names {name!r}, whose cell starts with no apostrophe")
    return {n: cell[1:] if n in named else cell for n, cell in row.items() if n != GUARDED}
