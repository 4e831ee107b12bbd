"""The command line. Every command is a few lines over a function that Python users call as well."""

from __future__ import annotations

import json
import os
import shlex
import sys
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from prefrl.cli.exchange import Labelers, Out, Split
from prefrl.cli.exchange import commands as exchange_commands
from prefrl.cli.film import commands as film_commands
from prefrl.cli.many import Jobs, drive_all, over_seeds
from prefrl.cli.many import commands as many_commands
from prefrl.cli.own import by_name, load
from prefrl.cli.several import Ranks, on
from prefrl.cli.store import commands as store_commands
from prefrl.cli.texts import Folder, refuse
from prefrl.cli.texts import commands as text_commands

if TYPE_CHECKING:  # heavy modules are imported by the command that needs them: --help must answer at once
    from prefrl.config import Config

app = typer.Typer(
    help="Learn what people prefer, and act on it: sample, label, fit, improve, evaluate.",
    epilog="Exit status: 0 done; 1 `verify` found something wrong; 2 a mistake, told on stderr; 130 stopped by Ctrl-C.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.add_typer(text_commands)
app.add_typer(exchange_commands)
app.add_typer(film_commands)
app.add_typer(many_commands)
app.add_typer(store_commands)
Source = Annotated[str, typer.Argument(help="A preset (see `prefrl presets`), a YAML file, or a run's folder.")]
Overrides = Annotated[list[str] | None, typer.Argument(help="Settings, as dotted.key=value.", show_default=False)]


FEW = 20
"""With fewer held-out comparisons than this an accuracy is mostly luck."""


@app.callback()
def own(
    plugin: Annotated[
        list[str] | None,
        typer.Option(help="A Python file (my_env.py) or module of your own to load first."),
    ] = None,
) -> None:
    load(plugin or [])


@app.command()
def run(
    source: Source,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The run's folder; a new one under runs/ if not given.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option(help="Build everything, run a small round, estimate time, write nothing.")
    ] = False,
    ranks: Ranks = 1,
    seeds: Annotated[int, typer.Option(min=1, help="Run this many seeds, from `seed` on, and compare the runs.")] = 1,
    jobs: Jobs = 1,
) -> None:
    """Run the whole loop. The same command on the same folder goes on where it stopped."""
    from prefrl.cli.console import drive, say
    from prefrl.rundir import Run

    overrides = by_name(overrides or [])
    config = _load(source, overrides)
    refuse(seeds > 1 and ranks > 1, "--seeds and --ranks are two ways to use several processes: choose one")
    refuse(jobs > 1 and seeds == 1, "--jobs goes with --seeds: how many of its runs go on at once")
    refuse(seeds > 1 and Path(source).is_dir(), "--seeds takes a preset or a YAML file, not a run's folder")
    if seeds > 1 and not dry_run:
        drive_all(over_seeds(source, overrides, seeds), out or _new_folder(source), jobs, "local")
        return
    if dry_run:
        _dry_run(config, seeds)
        return
    with on(ranks) as here:
        if here and out is None:
            out = _new_folder(source)
            say(f"the run's folder: {out}")
        if here and out is not None:
            drive(Run(config, out, asked=(source, overrides)))


@app.command()
def resume(folder: Folder, ranks: Ranks = 1) -> None:
    """Go on with a run that was stopped."""
    from prefrl.cli.console import drive
    from prefrl.rundir import Run

    with on(ranks) as here:
        if here:
            drive(Run.resume(folder))


@app.command()
def label(
    source: Annotated[
        str, typer.Argument(help="A preset, a YAML file, or the folder of a run whose policy is asked about.")
    ],
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The folder that is written; default: labels.")
    ] = None,
    given: Annotated[
        Path | None, typer.Option(help='JSON lines {"prompt", "responses"} to ask about.', exists=True)
    ] = None,
    policies: Annotated[
        list[Path] | None,
        typer.Option("--policy", help="A run of control or a zip whose segments are asked about; say it for each one."),
    ] = None,
    terminal: Annotated[bool, typer.Option(help="Short for labeler.kind=terminal.")] = False,
    serve: Annotated[
        bool,
        typer.Option(
            help="Short for labeler.kind=web; of a folder with a store its open queries are answered, or with --out "
            "new ones about its policy."
        ),
    ] = False,
    host: Annotated[str, typer.Option(help="With --serve: labeler.host.")] = "",
    port: Annotated[int | None, typer.Option(help="With --serve: labeler.port.")] = None,
) -> None:
    """Collect judgements: ask `loop.labels` queries and have the labeler answer them."""
    from prefrl import stages
    from prefrl.cli.console import say
    from prefrl.rundir import open_saved
    from prefrl.storage.log import has_store

    there = serve and has_store(Path(source)) and (out is None or out.resolve() == Path(source).resolve())
    refuse(terminal and serve, "--terminal and --serve are two ways of asking: choose one")
    refuse(not serve and (bool(host) or port is not None), "--host and --port go with --serve")
    own = there and (given is not None or bool(policies))
    refuse(own, f"{source} has queries of its own: --given and --policy are for new ones; say with --out where to")
    refuse(bool(policies) and given is not None, "--policy and --given are two sources of candidates: choose one")
    folder = Path(source) if there else out or Path("labels")
    extra = ["labeler.kind=terminal", f"labeler.clips={json.dumps(str(folder / 'clips'))}"] if terminal else []
    if serve:
        extra = ["labeler.kind=web", *[f"labeler.host={host}"] * bool(host)]
        extra += [f"labeler.port={port}"] * (port is not None)
    policy = open_saved(source) if Path(source).is_dir() and not there else None
    path = str(policy.folder) if policy else source
    settings = [*extra, *(overrides or [])]
    try:
        if there:
            stages.serve(folder, settings, say)
        else:
            stages.label(_load(path, settings), folder, policy, given, say, policies or ())
    except KeyboardInterrupt:
        say(f"stopped; what was answered is in {folder}. Go on with the same command")
        raise
    say(_progress(folder))


@app.command()
def demonstrate(
    source: Annotated[str, typer.Argument(help="A preset of control, or a YAML file: where the expert acts.")],
    overrides: Overrides = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder that is written.")] = Path("demonstrations"),
    expert: Annotated[
        Path | None,
        typer.Option(help="Who acts: a run of control, or a zip of any algorithm. Default: the task's own expert."),
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many whole episodes are shown.")] = 4,
    noise: Annotated[
        float,
        typer.Option(
            min=0, help="Noise in what is executed: a std in half the bounds, or a share of discrete actions."
        ),
    ] = 0.0,
) -> None:
    """Let an expert show whole episodes, which can be cloned: `learner.data=FOLDER` reads them."""
    from prefrl import stages
    from prefrl.cli.console import say
    from prefrl.components import ConfigError

    refuse(_holds_anything(out), f"{out} holds answers already: say with --out where new demonstrations go")
    policy = [f"labeler.policy={json.dumps(str(expert))}"] if expert else []
    shows = ["labeler.kind=expert", f"labeler.episodes={episodes}", f"labeler.noise={noise}", *policy]
    asks = ["select.kind=uniform", "select.candidates=1", "loop.labels=0"]
    try:
        stages.label(_load(source, [*shows, *asks, *(overrides or [])]), out, tell=lambda note: say(_as_options(note)))
    except ConfigError as error:
        raise ConfigError(_as_options(str(error))) from error
    same = [override for override in overrides or [] if override.startswith("task.")]
    clone = [source, *same, "learner.kind=clone", f"learner.data={out}", "loop.labels=0", "loop.rounds=1"]
    say(f"{_progress(out)}. Clone them with: {shlex.join(['prefrl', 'run', *clone])}")


def _as_options(text: str) -> str:
    """Words about an expert's settings, about the options that set them."""
    for option in ("policy", "episodes", "noise"):
        text = text.replace(f"labeler.{option}", f"--{option.replace('policy', 'expert')}")
    return text


@app.command()
def fit(
    source: Annotated[Path, typer.Argument(help="A folder with a store, or a file of judgements.")],
    overrides: Overrides = None,
    config: Annotated[str | None, typer.Option(help="Preset or YAML file; default: the folder's own.")] = None,
    labelers: Labelers = "",
    split: Split = "",
    out: Out = Path("reward"),
) -> None:
    """Fit a reward model on judgements, and save it."""
    from prefrl import stages
    from prefrl.cli.console import console, metrics_table, say
    from prefrl.exchange.layout import Which

    settings = _load(stages.config_of(source, config), overrides)
    fitted, notes = stages.fit_reward(settings, source, out, Which.of(labelers, split))
    console.print(metrics_table(f"reward model in {out}", fitted.metrics))
    count = len(fitted.predicted)
    few = f"only {count} comparisons were held out: their accuracy says little"
    few = few if fitted.metrics["held_out"] else "nothing was held out"
    for note in [*notes, *([few] if count < FEW else [])]:
        say(note, "yellow")


@app.command()
def improve(
    source: Source,
    overrides: Overrides = None,
    reward: Annotated[Path, typer.Option(help="A run, or what `prefrl fit` wrote.", exists=True)] = Path("reward"),
    out: Out = Path("policy"),
    ranks: Ranks = 1,
) -> None:
    """Improve a policy against a saved reward model."""
    from prefrl import stages
    from prefrl.cli.console import drive
    from prefrl.rundir import Run

    with on(ranks) as here:
        if here:
            drive(Run(stages.with_reward(_load(source, overrides), reward, overrides or ()), out, reward))


@app.command()
def evaluate(
    folder: Annotated[Path | None, typer.Argument(help="A run, whose policy is evaluated.", show_default=False)] = None,
    best: Annotated[
        bool, typer.Option("--best", help="The best policy by the newest reward, in place of the last one: control.")
    ] = False,
    reward: Annotated[
        Path | None, typer.Option(help="Grade this reward model instead: a run, or what `prefrl fit` wrote.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Judgements to grade it on; default: what the run held out.")
    ] = None,
    held_out: Annotated[bool, typer.Option("--held-out", help="Of the data, only what a fit leaves out.")] = False,
    labelers: Labelers = "",
    split: Split = "",
    json_: Annotated[Path | None, typer.Option("--json", help="Write the report card there.")] = None,
    html: Annotated[Path | None, typer.Option(help="Write it as a page there.")] = None,
    rewardbench: Annotated[
        Path | None, typer.Option(help="Write the scores of text pairs into this folder, as RewardBench does.")
    ] = None,
) -> None:
    """Evaluate the newest policy of a run, or grade a reward model."""
    from prefrl import stages
    from prefrl.cli.console import card_table, console, metrics_table
    from prefrl.exchange.layout import Which

    if reward is not None:
        card = stages.report_card(reward, data, held_out, rewardbench, Which.of(labelers, split))
        stages.write_card(card, json_, html)
        console.print(card_table(card))
    elif folder is not None:
        found, round = stages.evaluate(folder, best)
        said = "best" if best else "last"
        console.print(metrics_table(f"{said} policy of {folder}, after round {round}", found.metrics))
    else:
        raise typer.BadParameter("say what to evaluate: a run's FOLDER, or --reward FOLDER")


@app.command()
def report(folder: Folder) -> None:
    """Write a run's report.html again, also while it goes on."""
    from prefrl.cli.console import say
    from prefrl.report.report import write_report

    say(f"report: {write_report(folder)}")


@app.command()
def presets() -> None:
    """List the presets."""
    from prefrl.cli.console import console, table
    from prefrl.config import presets

    console.print(table("presets: prefrl run NAME --out DIR", ("name", "what it shows"), presets().items()))


@app.command()
def describe(
    kind: Annotated[str | None, typer.Argument(help="A component's kind, or a preset.")] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON Schema of config files instead.")] = False,
) -> None:
    """Explain a component's settings, or a preset; without a name, list the kinds."""
    from rich.text import Text

    from prefrl.cli.console import console
    from prefrl.cli.describe import explain

    if schema:
        from prefrl.cli.schema import text

        print(text(), end="")
        return
    for part in explain(kind):
        console.print(part, soft_wrap=isinstance(part, Text))


@app.command()
def doctor() -> None:
    """Say what is installed, what is missing, and what to do about it."""
    from prefrl.cli.console import console
    from prefrl.cli.doctor import diagnose

    console.print(diagnose())


def _progress(folder: Path) -> str:
    """How far the queries of a store are answered, by however many people."""
    from prefrl.store import Store

    with Store(folder, write=False) as store:
        asked, answered, skipped = store.progress()
    return f"{answered} of {asked} queries answered, {skipped} skipped, in {folder}"


def _new_folder(source: str) -> Path:
    """Of a run of control/hopper: runs/control-hopper-20261124-091500, with a 2 behind it where that is taken."""
    name = Path(source).stem if Path(source).exists() else source.replace("/", "-")
    first = Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    later = (first.with_name(f"{first.name}-{number}") for number in count(2))
    return next(folder for folder in chain([first], later) if not folder.exists())


def _load(source: str, overrides: list[str] | None) -> Config:
    """Settings from a preset, a file, or a folder that holds a config.yaml."""
    from prefrl.config import Config

    changes = by_name(overrides or [])
    if Path(source).is_dir():
        return Config.reopen(Path(source) / "config.yaml", changes)
    return Config.load(source, changes)


def _holds_anything(folder: Path) -> bool:
    """Whether a store lies there in which something was asked; one that a mistake left behind may be used."""
    from prefrl.storage.log import has_store
    from prefrl.store import Store

    if not has_store(folder):
        return False
    with Store(folder, write=False) as store:
        return store.sequence > 0


def _dry_run(config: Config, seeds: int) -> None:
    from prefrl.cli.console import duration, say
    from prefrl.report.costs import account, costs
    from prefrl.stages import estimate

    spent, whole = estimate(config, say), "the whole" if seeds == 1 else "each of the runs"
    say(f"everything builds and one small round runs; {whole} would take about {duration(spent.machine)}")
    say(f"what it would cost outside a simulator. {account(costs(spent))}")


MISTAKES = (ValueError, FloatingPointError, MemoryError, ModuleNotFoundError, OSError)
"""What a user can do something about."""


def main() -> None:
    """Turn a user's mistake into one line on stderr and exit status 2; PREFRL_DEBUG=1 shows where it came from."""
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        if _interrupted(error):
            sys.exit(130)
        if not isinstance(error, MISTAKES) or os.environ.get("PREFRL_DEBUG"):
            raise
        _tell(error)
        sys.exit(2)


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C began it: a library that is interrupted while it tidies up fails with an error of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _tell(mistake: Exception) -> None:
    from prefrl.cli.console import errors
    from prefrl.components import missing

    text = missing(mistake) if isinstance(mistake, ModuleNotFoundError) else str(mistake)
    for line in text.splitlines():
        errors.print(f"error: {line}", style="red", markup=False, soft_wrap=True)
