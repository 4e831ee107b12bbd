"""The commands for several runs: sweep, compare; and `prefrl run --seeds`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from prefrl.report.groups import Contest
    from prefrl.sweeps.plan import SweepPlan

commands = typer.Typer()
TOLD = ("runs", "before", "gold", "wins against the start", "worst", "best", "labels", "time")
"""Columns of the comparison that a terminal has room for."""
Jobs = Annotated[int, typer.Option(min=1, help="How many runs at once.")]


@commands.command()
def sweep(
    file: Annotated[Path, typer.Argument(help="YAML: presets, seeds, first, set, grid.", exists=True, dir_okay=False)],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The folder of all runs; default: runs/ and the file's name.")
    ] = None,
    jobs: Jobs = 1,
    launcher: Annotated[str, typer.Option(help="local, submitit (Slurm) or ray.")] = "local",
) -> None:
    """Run presets over seeds and a grid of settings. Run it again to go on where it stopped."""
    from prefrl.sweeps.plan import SweepPlan

    drive_all(SweepPlan.load(file), out or Path("runs") / file.stem, jobs, launcher)


@commands.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(help="Runs' folders, or folders that contain runs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="A page (.html), a table (.md) or numbers (.json).")] = Path(
        "comparison.html"
    ),
) -> None:
    """Compare finished runs by task and settings, over their seeds."""
    from prefrl.cli.console import say
    from prefrl.report.comparison import write_comparison

    _tell(*write_comparison(runs, out))
    say(f"comparison: {out}")


def over_seeds(source: str, overrides: Sequence[str], seeds: int) -> SweepPlan:
    """The plan of one preset with several seeds, from the setting `seed` on."""
    from prefrl.config import Config
    from prefrl.sweeps.plan import SweepPlan

    first = Config.load(source, overrides).seed
    kept = tuple(one for one in overrides if not one.startswith("seed="))
    return SweepPlan(presets=(source,), seeds=seeds, first=first, set=kept)


def drive_all(plan: SweepPlan, folder: Path, at_once: int, where: str) -> None:
    """Run a sweep to its end, a line for each run, and compare what came of it. Raises `RunError` if a run failed."""
    from prefrl.cli.console import counted, say
    from prefrl.report.comparison import write_comparison
    from prefrl.rundir import RunError
    from prefrl.sweeps.drive import Sweep
    from prefrl.sweeps.launch import launcher

    sweep, failed = Sweep(plan, folder), list[Path]()
    started, left = launcher(where, folder / ".jobs"), len(sweep.jobs)
    say(f"the folder of the runs: {folder}")
    if left < len(sweep.members):
        say(f"{len(sweep.members) - left} of {len(sweep.members)} runs in {folder} are finished")
    try:
        for ended in counted(sweep.run(started, at_once), left, "runs"):
            failed += [ended.log] * bool(ended.status)
            say(f"{ended.folder}: {_outcome(ended.folder, ended.status)}")
    except KeyboardInterrupt:
        say(f"stopped; finished runs are kept. Go on with the same command and --out {folder}")
        raise
    if failed:
        raise RunError(f"{len(failed)} of {len(sweep.members)} runs failed; see their logs, for example {failed[0]}")
    page = folder / "comparison.html"
    _tell(*write_comparison([folder / member.name for member in sweep.members], page))
    say(f"comparison: {page}")


def _outcome(folder: Path, status: int) -> str:
    from prefrl.report.facts import gather
    from prefrl.report.records import read
    from prefrl.report.words import headline

    return f"failed, with status {status}" if status else headline(gather(read(folder, examples=False)))


def _tell(found: Sequence[Contest], left_out: Sequence[str]) -> None:
    from prefrl.cli.console import console, say, table
    from prefrl.report.comparison import rows_of

    for contest in found:
        rows = rows_of(contest)
        shown = [name for name in rows[0].columns if name in TOLD]
        for row in rows:
            say(f"{row.letter}  {row.name}")
        console.print(table(contest.task, ("", *shown), [(r.letter, *(r.columns[n] for n in shown)) for r in rows]))
    for line in left_out:
        say(line, "yellow")
