"""The tables of results.md that are made from records: `python docs/records.py` writes them, `--check` compares.

A record, `records/NAME.json`, is what `prefrl compare FOLDER --out docs/records/NAME.json` found in the folder of a
sweep. Its table stands between `<!-- record: NAME -->` and `<!-- end of record -->`; several names share a table.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE / "results.md"
RECORDS = HERE / "records"
SWEEPS = HERE.parent / "benchmarks" / "sweeps"
BLOCK = re.compile(r"<!-- record: ([\w -]+?) -->\n.*?<!-- end of record -->", re.DOTALL)
NONE = "–"


def in_step(page: str) -> str:
    """The page with the tables of today's records."""
    return BLOCK.sub(lambda found: _block(found[1].split()), page)


def names(page: str) -> list[str]:
    """The records that a page shows."""
    return [name for found in BLOCK.finditer(page) for name in found[1].split()]


def read(name: str) -> list[dict[str, Any]]:
    """The groups of a record. Raises `ValueError` for one without gold, which these tables are about."""
    path = RECORDS / f"{name}.json"
    if not path.exists():
        raise ValueError(f"results.md shows the record {name}, but {path} is not there: write it with prefrl compare")
    found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["groups"]
    if any(group["score"] != "gold" for group in found):
        raise ValueError(f"{name}.json: expected runs with gold, got {found[0]['score']}")
    return found


def _block(records: Sequence[str]) -> str:
    groups = [(name, group) for name in records for group in read(name)]
    kept = [head for head, show in COLUMNS.items() if any(show(group) != NONE for _, group in groups)]
    rows = [kept, ["---"] * len(kept), *([COLUMNS[head](group) for head in kept] for _, group in groups)]
    table = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    lines = [f"<!-- record: {' '.join(records)} -->", *table, "", *_origins(groups), "<!-- end of record -->"]
    return "\n".join(lines)


def _origins(groups: Sequence[tuple[str, dict[str, Any]]]) -> list[str]:
    """A line for each code and machine, with the commands and files of what came of it."""
    alike: dict[str, list[str]] = {}
    for name, group in groups:
        said = " then ".join(map(_made, group["made_with"])) or "not known"
        alike.setdefault(said, []).append(f"`{_command(name, group)}` ([each seed](records/{name}.json))")
    return [f"- {', '.join(dict.fromkeys(commands))}: {said}." for said, commands in alike.items()]


def _command(name: str, group: dict[str, Any]) -> str:
    file = SWEEPS / f"{name}.yaml"
    return f"prefrl sweep benchmarks/sweeps/{name}.yaml" if file.exists() else group["command"] or name


def _made(made: dict[str, Any]) -> str:
    """Code, machine and libraries in one line."""
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    if "commit" not in made:
        return versions
    commit = f"commit {made['commit'][:10]}" if made["commit"] else "no commit"
    commit += " with changes" * bool(made["changed"])
    processor = f"{made['processor'] or 'a processor without a name'} ({made['instructions']})"
    machine = ", ".join([processor, *filter(None, [made["gpu"]]), _count(made["cores"], "core")])
    ranks = [_count(made["ranks"], "rank")] * (made["ranks"] > 1)
    return "; ".join([commit, ", ".join([machine, *ranks, _count(made["threads"], "thread")]), versions])


def _count(many: int, what: str) -> str:
    return f"{many} {what}{'s' * (many != 1)}"


# --- columns ----------------------------------------------------------------------------------------------------------


def _name(group: dict[str, Any]) -> str:
    """The preset and the settings that differ from it."""
    return f"`{' '.join([group['source'] or group['name'], *group['overrides']])}`"


def _seeds(group: dict[str, Any]) -> str:
    seeds = [run["seed"] for run in group["runs"]]
    together = len(seeds) > 2 and seeds == list(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]} to {seeds[-1]}" if together else ", ".join(map(str, seeds))


def _score(group: dict[str, Any]) -> str:
    low, high = group["interval"]
    value = f"**{_number(group['interquartile_mean'])}**"
    return value if low is None else f"{value} ({_number(low)} to {_number(high)})"


def _number(value: float | None) -> str:
    if value is None:
        return NONE
    size = abs(value)
    return f"{value:,.0f}" if size >= 100 else f"{value:.1f}" if size >= 10 else f"{value:.2f}"


def _average(value: Callable[[dict[str, Any]], float | None], show: Callable[[float], str]) -> Callable[..., str]:
    def shown(group: dict[str, Any]) -> str:
        found = [value(run) for run in group["runs"]]
        known = [one for one in found if one is not None]
        return show(mean(known)) if known else NONE

    return shown


def _range(group: dict[str, Any]) -> str:
    scores = [run["score"] for run in group["runs"] if run["score"] is not None]
    return f"{_number(min(scores))} to {_number(max(scores))}" if len(scores) > 1 else NONE


def _steps(run: dict[str, Any]) -> float | None:
    return _sum([run["steps"]["learn"], run["steps"]["query"]])


def _sum(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _kept_fluency(run: dict[str, Any]) -> float | None:
    before, after = run["fluency"]
    return after / before if before and after is not None else None


COLUMNS: dict[str, Callable[..., str]] = {
    "run": _name,
    "seeds": _seeds,
    "gold before": _average(lambda run: run["gold"][0], _number),
    "gold after: interquartile mean (95 %)": _score,
    "mean": _average(lambda run: run["score"], _number),
    "range": _range,
    "labels": _average(lambda run: run["labels"], "{:,.0f}".format),
    "steps to learn + query": _average(_steps, "{:,.0f}".format),
    "KL, nats": _average(lambda run: run["kl"], "{:.2f}".format),
    "fluency after / before": _average(_kept_fluency, "{:.2f}".format),
    "seconds": _average(lambda run: run["seconds"], "{:.0f}".format),
}
"""Head -> what a group shows there; means over its seeds where the head does not say otherwise."""


def main() -> int:
    there = PAGE.read_text(encoding="utf-8")
    made = in_step(there)
    if "--check" in sys.argv[1:]:
        sys.stdout.write("" if made == there else f"{PAGE} is out of step: run python docs/records.py\n")
        return int(made != there)
    PAGE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
