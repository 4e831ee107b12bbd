"""What is exact about a run in a world of few states, in `exact.json`: each round's regret, and the newest maps."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from prefrl.evaluate.card import Exact
from prefrl.storage.files import write_file

FILE = "exact.json"


def keep_exact(folder: Path, found: Exact) -> None:
    """Write a round into the file of a run's folder, after those before it."""
    before = read_exact(folder)
    (newest,) = found.rounds
    rounds = [one for one in (before.rounds if before else ()) if one.round < newest.round]
    write_file(folder / FILE, found.model_copy(update={"rounds": (*rounds, newest)}).model_dump_json().encode())


def read_exact(folder: Path) -> Exact | None:
    """What was measured so far; None where nothing was, or it cannot be read."""
    try:
        return Exact.model_validate_json((folder / FILE).read_bytes())
    except (ValidationError, OSError):
        return None
