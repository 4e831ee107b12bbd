"""What is exact about a run in a world of few states, in `exact.json`: each round's regret, and the newest maps."""

from __future__ import annotations

from pathlib import Path

from prefrl.evaluate.card import Exact, read_part
from prefrl.storage.files import write_file

FILE = "exact.json"


def keep_exact(folder: Path, found: Exact) -> None:
    """Write a round into the file of a run's folder, after those before it."""
    before = read_part(Exact, folder / FILE)
    (newest,) = found.rounds
    rounds = [one for one in (before.rounds if before else ()) if one.round < newest.round]
    write_file(folder / FILE, found.model_copy(update={"rounds": (*rounds, newest)}).model_dump_json().encode())
