"""Commands for runs of text alone: win-rate, generate."""

from __future__ import annotations

import json
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

commands = typer.Typer()
Folder = Annotated[Path, typer.Argument(help="A run's folder.", exists=True, file_okay=False)]


class By(StrEnum):
    """Who says which response is better."""

    reward = "reward"
    gold = "gold"
    labeler = "labeler"


def refuse(wrong: bool, why: str) -> None:
    """Options that would be ignored are a mistake."""
    if wrong:
        raise ValueError(why)


@commands.command()
def win_rate(
    folder: Folder,
    overrides: Annotated[
        list[str] | None,
        typer.Argument(help="With --by labeler: its settings, as labeler.key=value.", show_default=False),
    ] = None,
    against: Annotated[
        Path | None, typer.Option(help="Another run; default: the policy that the run started from.", exists=True)
    ] = None,
    by: Annotated[By, typer.Option(help="Who says which response is better.")] = By.reward,
    reward: Annotated[
        Path | None, typer.Option(help="With --by reward: a run, or what `prefrl fit` wrote; default: the run's own.")
    ] = None,
    prompts: Annotated[
        Path | None,
        typer.Option(help="A file or a data set of prompts; default: the evaluation's.", exists=True),
    ] = None,
    count: Annotated[
        int | None, typer.Option(help="So many distinct prompts; default: 256, or all of a file.", min=1)
    ] = None,
    samples: Annotated[int, typer.Option(help="Responses to each prompt, on either side.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Of prompts and responses.", min=0)] = 0,
    json_: Annotated[Path | None, typer.Option("--json", help="Write the numbers there.")] = None,
) -> None:
    """Say how often the newest policy of a text run beats its start, or another run's policy."""
    from prefrl.cli.console import console, counted, say, win_rate_line, win_rate_table
    from prefrl.duel import Duel
    from prefrl.storage.files import write_file

    refuse(bool(overrides) and by is not By.labeler, "settings of a labeler go with --by labeler")
    refuse(reward is not None and by is not By.reward, "--reward goes with --by reward")
    settings = tuple(overrides or ())
    duel = Duel(folder, against, by.value, reward, settings, prompts, count, samples, seed)
    found = duel.outcome(lambda items, total: counted(items, total, "prompts"), say)
    say(win_rate_line(duel, found), "bold")
    console.print(win_rate_table(found))
    if json_ is not None:
        write_file(json_, json.dumps(duel.record(found), indent=1).encode())


@commands.command()
def generate(
    folder: Folder,
    prompts: Annotated[Path, typer.Option(help="A file or a data set with prompts or messages.", exists=True)],
    to: Annotated[Path, typer.Option(help="JSON lines: the prompt, and the responses.")] = Path("responses.jsonl"),
    samples: Annotated[int, typer.Option(help="Responses to each prompt.", min=1)] = 1,
    temperature: Annotated[float, typer.Option(help="0 takes the most probable token.", min=0)] = 1.0,
    top_k: Annotated[int, typer.Option(help="Draw among so many tokens; 0 for all.", min=0)] = 0,
    top_p: Annotated[float, typer.Option(help="Draw among tokens of this share.", min=0, max=1)] = 1.0,
    best_of: Annotated[
        int | None,
        typer.Option(help="Of so many responses write the one that the run's reward model scores highest.", min=1),
    ] = None,
) -> None:
    """Have the newest policy of a text run answer prompts; `prefrl label --given` reads what is written."""
    from prefrl import stages
    from prefrl.cli.console import counted, say

    refuse(to.exists(), f"{to} is there already: choose another name with --to")
    refuse(bool(best_of) and samples > 1, "--best-of keeps one of N responses to each prompt: leave --samples out")
    same = temperature == 0 or top_k == 1 or top_p == 0
    refuse(bool(best_of) and same, "--best-of wants responses that differ: raise --temperature, --top-k or --top-p")
    policy = stages.policy_of(folder)
    texts = stages.prompts_for(policy, prompts)
    how = stages.Drawn(best_of or samples, temperature, top_k, top_p)
    rows: Iterator[dict[str, object]]
    if best_of:
        chosen = stages.generate_best(policy, stages.reward_of(folder, policy.task), texts, how)
        rows = ({"prompt": prompt, "responses": [found], "scores": [score]} for prompt, found, score in chosen)
    else:
        rows = ({"prompt": prompt, "responses": found} for prompt, found in stages.generate(policy, texts, how))
    for row in counted(rows, len(texts), "prompts"):
        with to.open("a", encoding="utf-8") as file:  # line by line: what was written stays, whatever comes
            file.write(json.dumps(row, ensure_ascii=False) + "\n")
    say(f"{len(texts)} prompts answered in {to}")
